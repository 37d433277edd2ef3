"""Who gives how much where: weights per region and source, as JSON of users and recipes, and on the command line.

``{"regions": {"eyes": [0.8, 0.2]}, "default": [0.5, 0.5], "gains": [1, 0.5], "locked": {"mouth": 2}}``, each key
optional; or flat, the regions beside the other keys: ``{"eyes": [0.8, 0.2], "default": [0.5, 0.5]}``.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import suggestion
from facepipe.core.reading import read_json_object
from facepipe.declare import from_json

_NO_REGIONS = "none: the first source has no regions"
_MOST_BYTES = 1 << 20
_LEAST, _MOST = -1.0, 2.0  # of a share: as far beyond one source again as it lies from the other
_ROUNDING = 1e-9
_HUGEST = sys.float_info.max
_KEYS = ("regions", "default", "gains", "locked")
Key = TypeVar("Key")
Value = TypeVar("Value")


class Shares(NamedTuple):
    """Shares (regions + 1, sources), each row summing to 1, the default row last, and what the user should know."""

    table: FloatArray
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Weights of the K sources, one per source, in their order.

    :param regions: region name -> K weights; they are normalised to sum 1, and then lie within -1..2: beyond 0..1 what
        sources differ by is exaggerated
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
        gains = np.ones(sources) if self.gains is None else _checked("gains", self.gains, sources, least=0.0)
        notes = [note for name, row in given.items() for note in _note(name, row)]
        notes += _note("default", default) if self.default is not None else []
        rows = []
        for name in (*regions, "default"):
            row = given.get(name, default)
            together = (row / row.max()) * (gains / gains.max())  # products and sums of huge weights would overflow
            if not together.max() > 0:
                raise InputError(f"weights -> {name}", "the gains leave all weights at 0, expected one above 0")
            rows.append(_normalised(name, together))
            if (name in given or name == "default") and (rows[-1] < 0).any():
                notes.append(f"weights of {name} go beyond 0..1: caricature")
        for name, number in self.locked.items():
            if not (isinstance(number, int) and 1 <= number <= sources):
                raise InputError(f"lock -> {name}", f"source {number}, expected a number from 1 to {sources}")
            rows[list(regions).index(name)] = np.eye(sources)[number - 1]
        return Shares(np.array(rows), tuple(notes))


def _checked(
    name: str, values: Sequence[float] | FloatArray, sources: int, least: float = -sys.float_info.max
) -> FloatArray:
    where = f"weights -> {name}"
    if not isinstance(values, list | tuple | np.ndarray) or len(values) != sources:
        given = f"{len(values)} weights" if isinstance(values, list | tuple | np.ndarray) else repr(values)[:40]
        raise InputError(where, f"{given}, expected {sources}, one per source")
    for number, value in enumerate(values, 1):
        if not (isinstance(value, int | float | np.number) and value >= least and value <= _HUGEST):
            expected = "a finite number" if least < 0 else "a number of 0 or more"
            raise InputError(f"{where} -> source {number}", f"weight {value!r}, expected {expected}")
    if not any(value > 0 for value in values):
        raise InputError(where, "no weight above 0, expected one")
    return np.array(values, dtype=np.float64)


def _normalised(name: str, row: FloatArray) -> FloatArray:
    """(K,) the row with sum 1.

    :raises InputError: a sum of 0 or less, or weights beyond -1..2, where faces are torn
    """
    total, where = row.sum(), f"weights -> {name}"
    if not total > 0:
        raise InputError(where, "weights that sum to 0 or less, expected a sum above 0")
    shares = row / total
    beyond = np.flatnonzero((shares < _LEAST - _ROUNDING) | (shares > _MOST + _ROUNDING))
    if len(beyond):
        value = f"{shares[beyond[0]]:g} where weights sum to 1"
        raise InputError(f"{where} -> source {beyond[0] + 1}", f"{value}, expected {_LEAST:g} to {_MOST:g}")
    return np.asarray(shares)


def _note(name: str, row: FloatArray) -> list[str]:
    total = sum(row.tolist())  # infinite where huge weights overflow
    return [] if abs(total - 1.0) < 1e-6 else [f"weights of {name} sum to {total:g}, normalised to 1"]


@dataclass(frozen=True, kw_only=True)
class _Kept:
    regions: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    default: tuple[float, ...] | None = None
    gains: tuple[float, ...] | None = None
    locked: Mapping[str, int] | None = None


def weights_to_json(weights: Weights) -> dict[str, Any]:
    """The weights as `weights_from_json` reads them."""
    return {
        "regions": {name: [float(one) for one in weights.regions[name]] for name in sorted(weights.regions)},
        "default": None if weights.default is None else [float(one) for one in weights.default],
        "gains": None if weights.gains is None else [float(gain) for gain in weights.gains],
        "locked": {name: int(weights.locked[name]) for name in sorted(weights.locked)},
    }


def weights_from_json(content: object, where: str) -> Weights:
    """The weights of parsed JSON.

    :raises InputError: another structure, or values of other types
    """
    if isinstance(content, Mapping) and not isinstance(content.get("regions"), Mapping):
        regions = {key: value for key, value in content.items() if key not in _KEYS[1:]}
        content = {"regions": regions, **{key: content[key] for key in _KEYS[1:] if key in content}}
    kept = from_json(_Kept, content, where)
    return Weights(regions=kept.regions, default=kept.default, gains=kept.gains, locked=kept.locked or {})


def weights_of(arguments: argparse.Namespace, kept: Weights) -> Weights:
    """The recipe's weights, over them those of the file, over them those of flags.

    :raises InputError: words that are no weights, a region or lock given twice, or weights for what is locked
    """
    file = (
        weights_from_json(read_json_object(arguments.weights, _MOST_BYTES), str(arguments.weights))
        if arguments.weights
        else Weights()
    )
    for name in arguments.unlock:
        if name not in kept.locked and name not in file.locked:
            near = suggestion(name, {**kept.locked, **file.locked}, "a region that is")
            raise InputError(f"--unlock {name}", f"is not locked{near}")
    flags = Weights(
        regions=_once("--set", map(_named, arguments.set)),
        default=None
        if arguments.default is None
        else _flag_numbers(arguments.default, f"--default {arguments.default}"),
        gains=None if arguments.gains is None else _flag_numbers(arguments.gains, f"--gains {arguments.gains}"),
        locked=_once("--lock", map(_lock, arguments.lock)),
    )
    return _over(_over(kept, file, arguments.unlock), flags, arguments.unlock)


def _over(weights: Weights, changes: Weights, unlocked: Sequence[str]) -> Weights:
    """`weights` with those that `changes` has."""
    locked = {name: number for name, number in weights.locked.items() if name not in unlocked}
    for name in changes.regions:
        if name in locked:
            what = f"is locked to source {locked[name]}, expected no weights for it (or --unlock {name})"
            raise InputError(f"weights -> {name}", what)
    return replace(
        weights,
        regions={**weights.regions, **changes.regions},
        default=weights.default if changes.default is None else changes.default,
        gains=weights.gains if changes.gains is None else changes.gains,
        locked={**locked, **changes.locked},
    )


def _once(flag: str, pairs: Iterable[tuple[Key, Value]]) -> dict[Key, Value]:
    given: dict[Key, Value] = {}
    for key, value in pairs:
        if key in given:
            raise InputError(f"{flag} {key}=...", "given twice, expected it once")
        given[key] = value
    return given


def _named(word: str) -> tuple[str, tuple[float, ...]]:
    name, equals, text = word.rpartition("=")
    if not equals or not name:
        raise InputError(f"--set {word}", "expected REGION=W,W,... with one number per source")
    return name, _flag_numbers(text, f"--set {word}")


def _flag_numbers(text: str, where: str) -> tuple[float, ...]:
    try:
        values = tuple(float(one) for one in text.split(","))
    except ValueError:
        values = (math.nan,)
    if not all(map(math.isfinite, values)):
        raise InputError(where, "expected finite numbers with a comma between, one per source")
    return values


def _lock(word: str) -> tuple[str, int]:
    name, equals, number = word.rpartition("=")
    if not (equals and name and number.isascii() and number.isdecimal() and len(number) < 7):
        raise InputError(f"--lock {word}", "expected REGION=N, N the number of a source from 1")
    return name, int(number)
