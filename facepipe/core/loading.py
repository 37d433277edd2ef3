"""Packages that load what they give when it is first asked for (PEP 562), so that importing one costs next to nothing.

What a package gives stands in its `__init__` once, where type checkers read it too:

    if TYPE_CHECKING:
        from facepipe.stage.face import Face
    else:
        __getattr__, __dir__ = lazy(__name__)

    __all__ = ["Face"]

No module of a package may be called as a name that it gives: once imported, it would stand in its place.
"""

from __future__ import annotations

import builtins
import functools
import importlib
import importlib.util
import sys
from collections.abc import Callable
from typing import Any, NamedTuple


class Home(NamedTuple):
    """Where a name is that a package gives: the module, and its name there."""

    module: str
    name: str


def lazy(package: str, others: str = "") -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package for what its `__init__` imports under ``if TYPE_CHECKING``.

    :param others: module that gives what else the package has: ``given(name)``, None for nothing, and ``names()``
    """

    @functools.cache
    def homes() -> dict[str, Home]:
        return homes_of(package)

    def load(name: str) -> Any:
        value = None
        if not name.startswith("__") and name in homes():
            home = homes()[name]
            value = getattr(importlib.import_module(home.module), home.name)
        elif others and not name.startswith("_") and not importlib.util.find_spec(f"{package}.{name}"):
            value = importlib.import_module(others).given(name)
        if value is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        setattr(sys.modules[package], name, value)  # asked for once
        return value

    def names() -> list[str]:
        more = importlib.import_module(others).names() if others else ()
        return sorted({*vars(sys.modules[package]), *homes(), *more})

    return load, names


def homes_of(package: str) -> dict[str, Home]:
    """Where the names are that the `__init__` of an imported package imports, those for type checkers too.

    Its code runs again, with an import that loads nothing and gives a `Home` for each name. One is true, and so is that
    of ``TYPE_CHECKING``: the imports below it are made, and `lazy` is not called. Source is not needed, bytecode does.
    """
    loader: Any = sys.modules[package].__loader__
    noted: dict[str, Any] = {"__builtins__": {**vars(builtins), "__import__": lambda name, *_: _Unloaded(name)}}
    exec(loader.get_code(package), noted)
    return {name: home for name, home in noted.items() if isinstance(home, Home)}


class _Unloaded:
    """Stands for a module."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Home:
        return Home(self._name, name)
