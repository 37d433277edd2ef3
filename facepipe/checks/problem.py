"""What a check yields."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from pxr import Usd


class Problem(NamedTuple):
    """A defect: the path of the prim or property that has it, and one line that says what was found and expected."""

    path: str
    message: str


def at(culprit: Usd.Prim | Usd.Property | str, message: str) -> Problem:
    """The problem of a prim, property or path."""
    return Problem(culprit if isinstance(culprit, str) else str(culprit.GetPath()), message)


def some(values: Iterable[Any], limit: int = 5) -> str:
    """A few of `values`, and how many there are in all."""
    listed = [str(value) for value in values]
    return ", ".join(listed[:limit]) + (f" ... ({len(listed)} in all)" if len(listed) > limit else "")


def outside(values: Any, count: int) -> str | None:
    """Says which indices are not in 0..count-1; None where all are."""
    wrong = np.unique(values[(values < 0) | (values >= count) | (values != np.floor(values))])
    if not len(wrong):
        return None
    expected = f"0 to {count - 1}" if count else "none, since there is nothing to index"
    return f"index {some(f'{one:g}' for one in wrong)} out of range, expected {expected}"
