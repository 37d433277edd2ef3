"""Who gives how much where: weights per region and source."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import suggestion

_NO_REGIONS = "none: the first source has no regions"


class Shares(NamedTuple):
    """Shares (regions + 1, sources), each row summing to 1, the default row last, and what the user should know."""

    table: FloatArray
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Weights of the K sources, one per source, in their order.

    :param regions: region name -> K weights, at least 0 and not all 0; they are normalised to sum 1
    :param default: K weights of every region not named, and of points in no region; None: all the same
    :param gains: K factors, one per source, on its weights everywhere
    :param locked: region name -> number of a source (from 1) that it takes whole, whatever its weights say
    """

    regions: Mapping[str, Sequence[float]] = field(default_factory=dict)
    default: Sequence[float] | None = None
    gains: Sequence[float] | None = None
    locked: Mapping[str, int] = field(default_factory=dict)

    def shares(self, regions: Sequence[str], sources: int) -> Shares:
        """The normalised shares of the face's `regions`.

        :raises InputError: an unknown region, a wrong number of weights, or weights that can't be normalised
        """
        for name in (*self.regions, *self.locked):
            if name not in regions:
                raise InputError(f"weights -> {name}", f"no such region{suggestion(name, regions, _NO_REGIONS)}")
        given = {name: _checked(name, row, sources) for name, row in self.regions.items()}
        default = np.ones(sources) if self.default is None else _checked("default", self.default, sources)
        gains = np.ones(sources) if self.gains is None else _checked("gains", self.gains, sources)
        notes = [note for name, row in given.items() for note in _note(name, row)]
        notes += _note("default", default) if self.default is not None else []
        rows = [_normalised(name, given.get(name, default), gains) for name in (*regions, "default")]
        for name, number in self.locked.items():
            rows[list(regions).index(name)] = _one_hot(name, number, sources)
        return Shares(np.array(rows), tuple(notes))


def _checked(name: str, values: Sequence[float] | FloatArray, sources: int) -> FloatArray:
    where = f"weights -> {name}"
    if not isinstance(values, list | tuple | np.ndarray) or len(values) != sources:
        found = f"{len(values)} weights" if isinstance(values, list | tuple | np.ndarray) else repr(values)[:40]
        raise InputError(where, f"{found}, expected {sources}, one per source")
    for number, value in enumerate(values, 1):
        if not (isinstance(value, int | float | np.number) and 0 <= value <= sys.float_info.max):
            raise InputError(f"{where} -> source {number}", f"weight {value!r}, expected a number of 0 or more")
    if not any(value > 0 for value in values):
        raise InputError(where, "all weights are 0, expected one above 0")
    return np.array(values, dtype=np.float64)


def _normalised(name: str, row: FloatArray, gains: FloatArray) -> FloatArray:
    together = (row / row.max()) * (gains / gains.max())  # products and sums of huge weights would overflow
    if not together.max() > 0:
        raise InputError(f"weights -> {name}", "the gains leave all weights at 0, expected one above 0")
    return np.asarray(together / together.sum())


def _note(name: str, row: FloatArray) -> list[str]:
    total = sum(row.tolist())  # infinite where huge weights overflow
    return [] if abs(total - 1.0) < 1e-6 else [f"weights of {name} sum to {total:g}, normalised to 1"]


def _one_hot(name: str, number: int, sources: int) -> FloatArray:
    if not (isinstance(number, int) and 1 <= number <= sources):
        raise InputError(f"lock -> {name}", f"source {number}, expected a number from 1 to {sources}")
    return np.asarray(np.eye(sources)[number - 1])
