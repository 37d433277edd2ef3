"""Packages that load what they give when it is first asked for (PEP 562), so that importing one costs next to nothing.

What a package gives stands in its `__init__` once, where type checkers read it too:

    if TYPE_CHECKING:
        from facepipe.stage.face import Face
    else:
        __getattr__, __dir__ = lazy(__name__)

    __all__ = ["Face"]

No module of a package may be called as a name that it gives: once imported, it would stand in its place.

And the names that modules had in the release before: they can be imported for one release more, with a warning.
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import inspect
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_ROOMS = {"sample": "heads", "validate": "checks", "render": "pictures", "pipeline": "cooking"}  # old -> new
_TO_CORE: tuple[str, ...] = ("atomic", "digests", "errors", "hidden_folders", "images", "loading", "locks")
_TO_CORE += ("names", "placing", "reading", "reports", "threads", "tokens", "trust")
_TO_READ: tuple[str, ...] = ("accessors", "animations", "assemble", "document", "files", "key_times", "landmarks")
_TO_READ += ("losses", "materials", "meshes", "morphs", "names", "nodes", "placement", "primitives", "record")
_TO_READ += ("record_joints", "record_materials", "samplers", "skins", "vertices", "weld")
_CALLED = {  # new name -> the function that has the old one
    "facepipe.heads": ("facepipe.api", "sample"),
    "facepipe.checks": ("facepipe.checks", "validate"),
    "facepipe.pictures": ("facepipe", "render"),
}
_TO_HOSTING = ("deliver", "edited_face", "edited_mesh", "host_face", "live_blend", "reblended")
MOVED = {f"facepipe.pipeline.{name}": f"facepipe.hosting.{name}" for name in _TO_HOSTING}
MOVED |= {f"facepipe.{old}": f"facepipe.{new}" for old, new in _ROOMS.items()}
MOVED |= {f"facepipe.{name}": f"facepipe.core.{name}" for name in _TO_CORE}
MOVED |= {f"facepipe.importers.gltf_{name}": f"facepipe_gltf.read.{name}" for name in _TO_READ}
MOVED |= {
    "facepipe.finite": "facepipe.core.arrays",
    "facepipe.importers.gltf": "facepipe_gltf.read",
    "facepipe.importers.gltf_json": "facepipe_gltf.read.values",
    "facepipe.importers.imported": "facepipe.stage.imported",
    "facepipe.meshopt": "facepipe_gltf.read.meshopt",
    "facepipe_onnx.nodes": "facepipe.onnx_graph",
    "facepipe.records.arrays": "facepipe.records.fields",
    "facepipe_gltf.space": "facepipe_gltf.placement",
    "facepipe.records.gltf": "facepipe_gltf.record_format",
}


def lazy(package: str, others: str = "") -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package for what its `__init__` imports under ``if TYPE_CHECKING``.

    :param others: module that gives what else the package has: ``given(name)``, None for nothing, and ``names()``
    """

    @functools.cache
    def homes() -> dict[str, tuple[str, str]]:
        return _homes(package)

    def load(name: str) -> Any:
        value = None
        if not name.startswith("__") and name in homes():
            module, original = homes()[name]
            value = getattr(importlib.import_module(module), original)
        elif others and not name.startswith("_") and not _is_module(f"{package}.{name}"):
            value = importlib.import_module(others).given(name)
        if value is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        setattr(sys.modules[package], name, value)  # asked for once
        return value

    def names() -> list[str]:
        more = importlib.import_module(others).names() if others else ()
        return sorted({*vars(sys.modules[package]), *homes(), *more})

    return load, names


def _is_module(name: str) -> bool:
    """Whether a module is called so today."""
    return name not in MOVED and importlib.util.find_spec(name) is not None


def _homes(package: str) -> dict[str, tuple[str, str]]:
    """Name -> module that it is in, and its name there, as the source of the package says."""
    source = ast.parse(inspect.getsource(sys.modules[package]))
    checked = [part for part in source.body if isinstance(part, ast.If)]
    imports = [line for part in checked for line in part.body if isinstance(line, ast.ImportFrom)]
    return {one.asname or one.name: (str(line.module), one.name) for line in imports for one in line.names}


class _Alias(Loader):
    """Gives the module that another name has."""

    def __init__(self, name: str) -> None:
        self._module = importlib.import_module(name)
        self._spec = self._module.__spec__

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return self._module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._spec  # the import system has put the old name's there
        if module.__name__ in _CALLED:
            module.__class__ = _CalledRoom  # it is about to stand in the place of a function of its old name


class _CalledRoom(ModuleType):
    """A room whose old name is a function's now."""

    def __call__(self, *given: Any, **named: Any) -> Any:
        home, name = _CALLED[self.__name__]
        return getattr(importlib.import_module(home), name)(*given, **named)


class _Finder(MetaPathFinder):
    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not name.startswith("facepipe"):
            return None
        old = next((old for old in MOVED if name == old or name.startswith(f"{old}.")), None)
        if old is None:
            return None
        new = MOVED[old] + name.removeprefix(old)
        warnings.warn(f"{name} is called {new} now", DeprecationWarning, stacklevel=2)
        return ModuleSpec(name, _Alias(new))


def keep_old_names() -> None:
    """Let Python find modules under their old names too."""
    if not any(isinstance(one, _Finder) for one in sys.meta_path):
        sys.meta_path.insert(0, _Finder())  # before others find a file of the new room under the old name
