"""What cooks each verb: a module here with ``cook(path, watch) -> Cooked``, loaded when it is needed."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from facepipe.actions import find_action, summaries
from facepipe.core.errors import FacepipeError
from facepipe.core.reports import Report
from facepipe.kinds import Watch
from facepipe.older_recipes import verb_now
from facepipe.performing import again

# verb of a recipe -> its module
VERBS = {
    "fit-photo": "facepipe.pipeline.fit_photo",
}


@dataclass(frozen=True)
class Cooked:
    """What was written anew."""

    report: Report
    missed: bool = False  # a check or threshold


def cooker(verb: str) -> Callable[[Path, Watch], Cooked] | None:
    """What cooks files with recipes of `verb`; None where nothing does."""
    if verb in VERBS:
        found: Callable[[Path, Watch], Cooked] = importlib.import_module(VERBS[verb]).cook
        return found
    kind = find_action(verb_now(verb))
    return None if kind is None else lambda path, watch: Cooked(*again(path, kind, watch))


def verbs() -> tuple[str, ...]:
    """Those that can be cooked."""
    return tuple(sorted({*VERBS, *summaries()}))


@contextmanager
def under_source(path: Path) -> Iterator[None]:
    """Errors of a layer that is being made name its source: it has no file yet."""
    try:
        yield
    except FacepipeError as error:
        raise error.under(path) if error.where.startswith(("<", "/")) else error from None
