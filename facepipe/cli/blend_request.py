"""What a `facepipe blend` line asks for: sources, weights, options, output, from flags, files and recipes."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from facepipe.cli.parser import given_options, output_or_edited, picture_of
from facepipe.core.errors import InputError

if TYPE_CHECKING:
    from facepipe.processors.blend import BlendOptions, BlendRecipe, Weights

Key = TypeVar("Key")
Value = TypeVar("Value")


@dataclass(frozen=True, kw_only=True)
class Request:
    """A blend to make."""

    sources: tuple[Path, ...]
    weights: Weights
    options: BlendOptions
    out: Path
    flatten: bool
    target: Path | None  # find the weights that come nearest to it
    picture: Path | None  # of the seam residual
    warnings: tuple[str, ...] = ()


def request_of(arguments: argparse.Namespace) -> Request:
    """The request of parsed arguments; no face has been read.

    :raises InputError: flags that don't go together, files that can't be read or written, weights of no meaning
    """
    from facepipe.declare import check_ranges
    from facepipe.processors.blend import BlendOptions
    from facepipe.stage.files import check_suffix

    _check_flags(arguments)
    recipe = _recipe(arguments)
    sources = recipe.sources if recipe else tuple(arguments.sources)
    _check_sources(sources)
    extra = [path for path in (arguments.weights, arguments.match) if path is not None]
    out = output_or_edited(arguments, [*sources, *extra])
    check_suffix(out)
    inputs = [*sources, *extra, *([arguments.edit] if recipe else [])]
    picture = None if arguments.heatmap is None else picture_of(arguments.heatmap, arguments, inputs, out)
    options = replace(recipe.options if recipe else BlendOptions(), **given_options(arguments, BlendOptions))
    check_ranges(options)
    return Request(
        sources=sources,
        weights=_weights(arguments, recipe),
        options=options,
        out=out,
        flatten=arguments.flatten or (recipe is not None and recipe.standalone),
        target=arguments.match,
        picture=picture,
        warnings=recipe.warnings if recipe else (),
    )


def _check_flags(arguments: argparse.Namespace) -> None:
    if arguments.edit is None and arguments.replace:
        raise InputError("--replace", "given without --edit, expected both or neither")
    if arguments.edit is None and not arguments.sources:
        raise InputError("SOURCE", "none given, expected faces to blend (or --edit RESULT)")
    if arguments.edit is not None and arguments.sources:
        what = "given with --edit, expected the sources of its recipe (--replace N=FACE takes another)"
        raise InputError(arguments.sources[0], what)
    if arguments.match is not None:
        for flag in ("edit", "weights", "set", "default", "gains", "unlock"):
            if getattr(arguments, flag):
                raise InputError(f"--{flag}", "given with --match, which finds the weights: expected only one of them")


def _check_sources(sources: Sequence[Path]) -> None:
    for number, path in enumerate(sources):
        for other in sources[:number]:
            if other == path or (other.exists() and path.exists() and other.samefile(path)):
                raise InputError(path, "is a source twice, expected different faces")


def _recipe(arguments: argparse.Namespace) -> BlendRecipe | None:
    from facepipe.processors.blend import read_blend_recipe

    if arguments.edit is None:
        return None
    return read_blend_recipe(arguments.edit, _once("--replace", map(_replacement, arguments.replace)))


def _replacement(word: str) -> tuple[int, Path]:
    number, equals, path = word.partition("=")
    if not (equals and path and number.isascii() and number.isdecimal() and len(number) < 7):
        raise InputError(f"--replace {word}", "expected N=FACE, N the number of a source from 1")
    return int(number), Path(path)


def _weights(arguments: argparse.Namespace, recipe: BlendRecipe | None) -> Weights:
    """The recipe's weights, over them those of the file, over them those of flags."""
    from facepipe.processors.blend import Weights
    from facepipe.processors.blend.weights_json import read_weights

    weights = recipe.weights if recipe else Weights()
    file = read_weights(arguments.weights) if arguments.weights else Weights()
    for name in arguments.unlock:
        if name not in weights.locked and name not in file.locked:
            raise InputError(f"--unlock {name}", "is not locked")
    flags = Weights(
        regions=_once("--set", map(_named, arguments.set)),
        default=None if arguments.default is None else _numbers(arguments.default, f"--default {arguments.default}"),
        gains=None if arguments.gains is None else _numbers(arguments.gains, f"--gains {arguments.gains}"),
        locked=_once("--lock", map(_lock, arguments.lock)),
    )
    return _over(_over(weights, file, arguments.unlock), flags, arguments.unlock)


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
