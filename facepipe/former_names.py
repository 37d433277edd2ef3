"""Names that modules had in version 0.1.0: for one version they give what is elsewhere now, and say where."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, cast

# what docs and samples imported: a name, or the start of one -> where it is; what went to a wing, its door says
_MOVED = {
    "facepipe.core.trust": ("facepipe.core.policy.paths",),
    "facepipe.learn": (),
    "facepipe.learn.features.crops": ("facepipe.networks.files",),
    "facepipe.processors": ("facepipe.verbs",),
}
_STARTS = ("facepipe.core.trust", "facepipe.learn", "facepipe.processors", "facepipe.photo_options")


def _moved(name: str) -> tuple[str, Sequence[str]]:
    """The start of a name that has moved, and where to, the most likely place first; an empty start for others."""
    from facepipe.registry import manifest

    moved: Mapping[str, Sequence[str]] = {**manifest()["former"], **_MOVED}
    while name and name not in moved:
        name = name.rpartition(".")[0]
    return name, moved.get(name, ())


class FormerNames:  # no subclass of those in importlib.abc, which bring importlib.resources and tempfile
    """Finds modules by the names that they had."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """A module in its stead; None for names that no module had."""
        return (
            ModuleSpec(name, cast("Any", self), is_package=True)
            if name.startswith(_STARTS) and _moved(name)[0]
            else None
        )

    def create_module(self, spec: ModuleSpec) -> None:
        """An ordinary one."""

    def exec_module(self, module: ModuleType) -> None:
        """Let it give what the modules have that it stands for.

        :raises ModuleNotFoundError: there is none of that name there
        """
        name = module.__name__
        start, places = _moved(name)
        homes = [place + name.removeprefix(start) for place in places]
        if homes and importlib.util.find_spec(homes[0]) is None:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

        def given(attribute: str) -> Any:
            for home in homes if not attribute.startswith("__") else ():
                found = importlib.import_module(home)
                if hasattr(found, attribute):
                    message = f"{name} is {home} now, and goes with the next version"
                    warnings.warn(message, DeprecationWarning, stacklevel=2)
                    return getattr(found, attribute)
            raise AttributeError(f"module {name!r} has no attribute {attribute!r}")

        module.__getattr__ = given  # type: ignore[method-assign]


def install() -> None:
    """Once, before what Python itself finds: folders that a checkout's old bytecode keeps alive would be packages."""
    if not any(isinstance(finder, FormerNames) for finder in sys.meta_path):
        sys.meta_path.insert(0, FormerNames())
