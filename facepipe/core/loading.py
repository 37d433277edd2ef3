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

import ast
import functools
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable
from typing import Any


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


def _homes(package: str) -> dict[str, tuple[str, str]]:
    """Name -> module that it is in, and its name there, as the source of the package says."""
    source = ast.parse(inspect.getsource(sys.modules[package]))
    checked = [part for part in source.body if isinstance(part, ast.If)]
    imports = [line for part in checked for line in part.body if isinstance(line, ast.ImportFrom)]
    return {alias.asname or alias.name: (str(line.module), alias.name) for line in imports for alias in line.names}
