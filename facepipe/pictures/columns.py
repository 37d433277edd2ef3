"""Dataclasses whose fields are arrays with a row an item, or such dataclasses: rows put together, and chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np

from facepipe.core.arrays import IntArray

D = TypeVar("D")


def joined(parts: Sequence[D]) -> D:
    """The rows of several of a kind, one after the other."""
    columns = {each.name: [getattr(part, each.name) for part in parts] for each in fields(_any(parts[0]))}
    values = {
        name: joined(those) if is_dataclass(those[0]) else np.concatenate(those) for name, those in columns.items()
    }
    return type(parts[0])(**values)


def chosen(whole: D, at: IntArray) -> D:
    """The rows numbered `at`."""
    columns = {each.name: getattr(whole, each.name) for each in fields(_any(whole))}
    return type(whole)(**{name: chosen(one, at) if is_dataclass(one) else one[at] for name, one in columns.items()})


def _any(value: object) -> Any:
    return value
