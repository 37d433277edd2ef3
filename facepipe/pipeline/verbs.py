"""What cooks each verb: a module here with ``cook(path, watch) -> Cooked``, loaded when it is needed."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from facepipe.core.errors import FacepipeError
from facepipe.core.reports import Report

# verb of a recipe -> its module
VERBS = {
    "animate": "facepipe.pipeline.animate",
    "apply-bones": "facepipe.pipeline.apply_bones",
    "blend": "facepipe.pipeline.blend",
    "fit-bones": "facepipe.pipeline.fit_bones",
    "fit-neutral": "facepipe.pipeline.fit_neutral",
    "fit-photo": "facepipe.pipeline.fit_photo",
    "landmarks": "facepipe.pipeline.landmarks",
    "neural-rig": "facepipe.pipeline.neural_rig",
    "personal-template": "facepipe.pipeline.personal_template",
    "rebuild": "facepipe.pipeline.rebuild",
    "refine-neutral": "facepipe.pipeline.refine_neutral",
    "regions": "facepipe.pipeline.regions",
    "register-scan": "facepipe.pipeline.register_scan",
    "skin": "facepipe.pipeline.skin",
    "sliders": "facepipe.pipeline.sliders",
    "split-shapes": "facepipe.pipeline.split_shapes",
}


class Bar(Protocol):
    """Progress of one task."""

    def update(self) -> object:
        """One step is done."""


Watch = Callable[[str, int], AbstractContextManager[Any]]  # label, steps -> the task's `Bar`


@dataclass(frozen=True, kw_only=True)
class Cooked:
    """What was written anew."""

    report: Report
    missed: bool = False  # a check or threshold


def cooker(verb: str) -> Callable[[Path, Watch], Cooked]:
    """What cooks files with recipes of `verb`, one of `VERBS`."""
    found: Callable[[Path, Watch], Cooked] = importlib.import_module(VERBS[verb]).cook
    return found


class _Unseen:
    """A bar that shows nothing."""

    def update(self) -> None:
        """One step is done."""


@contextmanager
def unwatched(label: str, steps: int) -> Iterator[Bar]:
    """Progress that nobody looks at."""
    yield _Unseen()


@contextmanager
def under_source(path: Path) -> Iterator[None]:
    """Errors of a layer that is being made name its source: it has no file yet."""
    try:
        yield
    except FacepipeError as error:
        raise error.under(path) if error.where.startswith(("<", "/")) else error from None
