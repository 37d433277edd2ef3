"""Weights on the command line: flags over those of a file, over those of a recipe."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TypeVar

from facepipe.core.errors import InputError
from facepipe.processors.blend.weights import Weights
from facepipe.processors.blend.weights_json import read_weights

Key = TypeVar("Key")
Value = TypeVar("Value")


def weights_of(arguments: argparse.Namespace, kept: Weights) -> Weights:
    """The recipe's weights, over them those of the file, over them those of flags.

    :raises InputError: words that are no weights, a region or lock given twice, or weights for what is locked
    """
    file = read_weights(arguments.weights) if arguments.weights else Weights()
    for name in arguments.unlock:
        if name not in kept.locked and name not in file.locked:
            raise InputError(f"--unlock {name}", "is not locked")
    flags = Weights(
        regions=_once("--set", map(_named, arguments.set)),
        default=None if arguments.default is None else _numbers(arguments.default, f"--default {arguments.default}"),
        gains=None if arguments.gains is None else _numbers(arguments.gains, f"--gains {arguments.gains}"),
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
    found: dict[Key, Value] = {}
    for key, value in pairs:
        if key in found:
            raise InputError(f"{flag} {key}=...", "given twice, expected it once")
        found[key] = value
    return found


def _named(word: str) -> tuple[str, tuple[float, ...]]:
    name, equals, text = word.rpartition("=")
    if not equals or not name:
        raise InputError(f"--set {word}", "expected REGION=W,W,... with one number per source")
    return name, _numbers(text, f"--set {word}")


def _numbers(text: str, where: str) -> tuple[float, ...]:
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
