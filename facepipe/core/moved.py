"""Names that modules had in the release before: they can be imported for one release more, with a warning."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

_ROOMS = {"sample": "heads", "validate": "checks", "render": "pictures"}  # old -> new
_TO_CORE = (
    "atomic digests errors finite hidden_folders images loading locks names placing reading reports threads tokens trust"
).split()
MOVED = {f"facepipe.{old}": f"facepipe.{new}" for old, new in _ROOMS.items()}
MOVED |= {f"facepipe.{name}": f"facepipe.core.{name}" for name in _TO_CORE}


class _Alias(Loader):
    """Gives the module that another name has."""

    def __init__(self, name: str) -> None:
        self._module = importlib.import_module(name)
        self._spec = self._module.__spec__

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return self._module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._spec  # the import system has put the old name's there


class _Finder(MetaPathFinder):
    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        old = next((old for old in MOVED if name == old or name.startswith(f"{old}.")), None)
        if old is None:
            return None
        new = MOVED[old] + name.removeprefix(old)
        warnings.warn(f"{name} is called {new} now", DeprecationWarning, stacklevel=2)
        return ModuleSpec(name, _Alias(new))


def keep_old_names() -> None:
    """Let Python find modules under their old names too."""
    if not any(isinstance(one, _Finder) for one in sys.meta_path):
        sys.meta_path.append(_Finder())
