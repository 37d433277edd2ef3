"""Names that modules had in version 0.1.0: for one version they give what is elsewhere now, and say where."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

# what docs and samples imported: a name, or the start of one -> where it is, the most likely place first
_MOVED = {
    "facepipe.core.trust": ("facepipe.core.policy.paths",),
    "facepipe.learn": (),
    "facepipe.learn.features": ("facepipe.photo.features",),
    "facepipe.learn.features.crops": ("facepipe.networks.crops",),
    "facepipe.learn.photo": ("facepipe.photo.descent",),
    "facepipe.learn.photo.amortised": ("facepipe.photo.amortised",),
    "facepipe.photo_options": ("facepipe.photo.options",),
    "facepipe.processors": ("facepipe.verbs",),
    "facepipe.processors.clean_scan": ("facepipe.scanning.clean_scan",),
    "facepipe.processors.database": ("facepipe.scanning.database", "facepipe.verbs.whole_faces"),
    "facepipe.processors.neural_rig": ("facepipe.neural",),
    "facepipe.processors.photo_fit": ("facepipe.photo.fit", "facepipe.networks.masks"),
    "facepipe.processors.photo_texture": ("facepipe.photo.texture",),
    "facepipe.processors.rebuild": ("facepipe.scanning.rebuild", "facepipe.verbs.author_neutral"),
    "facepipe.processors.rebuild.author_neutral": ("facepipe.verbs.author_neutral",),
    "facepipe.processors.scan_landmarks": ("facepipe.scanning.landmarks",),
    "facepipe.processors.scan_photos": ("facepipe.scanning.photos",),
    "facepipe.processors.scan_texture": ("facepipe.scanning.texture",),
}


class FormerNames(MetaPathFinder, Loader):
    """Finds modules by the names that they had."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """A module in its stead; None for names that no module had."""
        start = name
        while start not in _MOVED and "." in start:
            start = start.rpartition(".")[0]
        return ModuleSpec(name, self, is_package=True) if start in _MOVED else None

    def create_module(self, spec: ModuleSpec) -> None:
        """An ordinary one."""

    def exec_module(self, module: ModuleType) -> None:
        """Let it give what the modules have that it stands for.

        :raises ModuleNotFoundError: there is none of that name there
        """
        name = start = module.__name__
        while start not in _MOVED:
            start = start.rpartition(".")[0]
        homes = [home + name.removeprefix(start) for home in _MOVED[start]]
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
