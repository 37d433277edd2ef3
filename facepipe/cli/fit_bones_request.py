"""What a `facepipe fit-bones` line asks for: rig, targets, options, outputs, from flags, files and recipes."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.cli.parser import given_options, output_of, output_or_edited, pairs, picture_of
from facepipe.core.errors import InputError

if TYPE_CHECKING:
    from facepipe.pipeline.fit_bones import FitJob
    from facepipe.processors.fit_bones import FitBones, FitBonesRecipe
    from facepipe.processors.fit_bones.recipe import Part


@dataclass(frozen=True, kw_only=True)
class Request:
    """A fit to make."""

    job: FitJob
    payload: Path | None  # of the coefficients
    picture: Path | None  # of the targets that are missed most
    warnings: tuple[str, ...] = ()


def request_of(arguments: argparse.Namespace) -> Request:
    """The request of parsed arguments; no face has been read.

    :raises InputError: flags that don't go together, files that can't be read or written, options out of range
    """
    from facepipe.pipeline.fit_bones import FitJob
    from facepipe.stage.files import check_suffix

    recipe = _recipe(arguments)
    rig, targets = _sources(arguments, recipe)
    initial = _given(arguments, "initial", recipe.initial if recipe else None)
    inputs = _inputs(rig, targets, initial, _given(arguments, "limits", None))
    out = output_or_edited(arguments, inputs)
    check_suffix(out)
    inputs += [arguments.edit] if recipe else []
    payload, picture = _extras(arguments, inputs, out)
    job = FitJob(
        rig=rig,
        targets=targets,
        fit=_fit(arguments, recipe),
        initial=initial,
        out=out,
        flatten=arguments.flatten or (recipe is not None and recipe.standalone),
    )
    return Request(
        job=job,
        payload=payload,
        picture=picture,
        warnings=recipe.warnings if recipe else (),
    )


def _given(arguments: argparse.Namespace, name: str, otherwise: Any) -> Any:
    """The value of a flag that may be absent."""
    return getattr(arguments, name, otherwise)


def _recipe(arguments: argparse.Namespace) -> FitBonesRecipe | None:
    from facepipe.processors.fit_bones import read_fit_bones_recipe

    if arguments.edit is None:
        return None
    replaced: list[Part] = ["rig"] if arguments.rig is not None else []
    replaced += ["targets"] if arguments.target else []
    replaced += ["initial"] if hasattr(arguments, "initial") else []
    return read_fit_bones_recipe(arguments.edit, replaced=replaced)


def _sources(arguments: argparse.Namespace, recipe: FitBonesRecipe | None) -> tuple[Path, tuple[str, ...]]:
    """The rig and the targets."""
    if recipe is not None:
        return arguments.rig or recipe.rig, tuple(arguments.target) or recipe.targets
    if arguments.rig is None:
        raise InputError("RIG", "none given, expected a face stage with joints (or --edit FITTED)")
    if not arguments.target:
        raise InputError("--target", "none given, expected what to reach (or --edit FITTED)")
    return arguments.rig, tuple(arguments.target)


def _inputs(rig: Path, targets: Sequence[str], initial: str | None, limits: Path | None) -> list[Path]:
    """The files to read."""
    from facepipe.processors.fit_bones.initial import is_payload
    from facepipe.processors.fit_bones.target_files import split_file

    files = [Path(file) for file, _ in map(split_file, targets) if file is not None]
    files += [Path(initial)] if is_payload(initial) else []
    return [rig, *files, *([limits] if limits is not None else [])]


def _extras(arguments: argparse.Namespace, inputs: list[Path], out: Path) -> tuple[Path | None, Path | None]:
    """The paths of payload and picture."""
    from facepipe.processors.bone_payload import check_payload_suffix

    picture = None if arguments.heatmap is None else picture_of(arguments.heatmap, arguments, inputs, out)
    if arguments.coefficients is None:
        return None, picture
    payload = output_of(argparse.Namespace(output=arguments.coefficients, force=arguments.force), inputs)
    check_payload_suffix(payload)
    return payload, picture


def _fit(arguments: argparse.Namespace, recipe: FitBonesRecipe | None) -> FitBones:
    """The recipe's fit, with what the line changes."""
    from facepipe.processors.fit_bones import FitBones, FitBonesOptions, LimitRules, read_limits

    fit = recipe.fit if recipe else FitBones()
    changes = given_options(arguments, FitBonesOptions)
    if hasattr(arguments, "limits"):
        changes["limits"] = LimitRules() if arguments.limits is None else read_limits(arguments.limits)
    if hasattr(arguments, "mask"):
        changes["mask"] = tuple(arguments.mask)
    regions = {**fit.regions, **pairs(arguments.region, "--region")}
    return replace(fit, regions=regions, **changes)
