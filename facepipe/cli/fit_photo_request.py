"""What a `facepipe fit-photo` line asks for: photos, face, landmarks, networks, options, from flags and recipes."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.fit_photo_folder import check_folder
from facepipe.cli.parser import given_options, output_or_edited
from facepipe.core.errors import InputError

if TYPE_CHECKING:
    from facepipe.pipeline.photo_job import PhotoJob, PhotoSettings
    from facepipe.processors.photo_fit import PhotoRecipe


@dataclass(frozen=True, kw_only=True)
class Request:
    """A fit to make, and its report."""

    job: PhotoJob
    report: Path | None  # folder
    warnings: tuple[str, ...] = ()


def request_of(arguments: argparse.Namespace) -> Request:
    """The request of parsed arguments; nothing but a recipe has been read.

    :raises InputError: flags that don't go together, files that can't be written, options out of range
    """
    from facepipe.pipeline.photo_job import START, PhotoJob
    from facepipe.stage.files import check_suffix

    recipe = _recipe(arguments)
    face, photos = _sources(arguments, recipe)
    landmarks, landmarker = _landmarks(arguments, recipe, len(photos))
    models = _models(arguments, recipe)
    start = arguments.start or (recipe.files.get(START) if recipe else None)
    files = [*landmarks, landmarker, start, *models.values()]
    inputs = [face, *photos, *(one for one in files if one is not None)]
    out = output_or_edited(arguments, inputs)
    check_suffix(out)
    if arguments.report is not None:
        taken = [*inputs, out, *([arguments.edit] if recipe else [])]
        check_folder(arguments.report, force=arguments.force, taken=taken)
    settings = _changed(arguments, _settings(arguments.edit, recipe), len(photos))
    job = PhotoJob(
        face=face,
        photos=photos,
        landmarks=landmarks,
        landmarker=landmarker,
        models=models,
        start=start,
        faces=settings.faces,
        expressions=settings.expressions,
        options=settings.options,
        threshold=settings.threshold,
        out=out,
        flatten=arguments.flatten or (recipe is not None and recipe.standalone),
    )
    return Request(job=job, report=arguments.report, warnings=recipe.warnings if recipe else ())


def _recipe(arguments: argparse.Namespace) -> PhotoRecipe | None:
    from facepipe.photo_options import MODELS
    from facepipe.pipeline.photo_job import LANDMARKER, START
    from facepipe.processors.photo_fit import read_photo_recipe

    if arguments.edit is None:
        return None
    others = len(arguments.files) > 1
    replaced = ["FACE"] if arguments.files else []
    replaced += ["PHOTO"] if others else []
    replaced += ["--landmarks"] if others or arguments.landmark_files or arguments.landmarker else []
    given = [name for name in (LANDMARKER, START, *MODELS) if getattr(arguments, name) is not None]
    replaced += [f"--{name.replace('_', '-')}" for name in given]
    replaced += ["--landmarker"] if arguments.landmark_files else []
    return read_photo_recipe(arguments.edit, replaced=replaced)


def _sources(arguments: argparse.Namespace, recipe: PhotoRecipe | None) -> tuple[Path, tuple[Path, ...]]:
    """The face and the photos."""
    *photos, face = arguments.files or [recipe.face if recipe else None]
    if recipe is not None:
        return face, tuple(photos) or recipe.photos
    if face is None:
        raise InputError("PHOTO ... FACE", "none given, expected photos and a face stage (or --edit FITTED)")
    if not photos:
        raise InputError("PHOTO ... FACE", f"{face} alone, expected one photo or more, then a face stage")
    return face, tuple(photos)


def _landmarks(
    arguments: argparse.Namespace, recipe: PhotoRecipe | None, count: int
) -> tuple[tuple[Path | None, ...], Path | None]:
    """The files of landmarks, one a photo, and MediaPipe's model where one is to find them."""
    from facepipe.pipeline.photo_job import LANDMARKER

    files, landmarker = arguments.landmark_files, arguments.landmarker
    if files and landmarker is not None:
        raise InputError("--landmarks", "given with --landmarker, expected only one of them")
    if files and len(files) != count:
        raise InputError("--landmarks", f"{len(files)} given, expected {count}: one for each photo, in their order")
    if files:
        return tuple(files), None
    if landmarker is not None or recipe is None or len(arguments.files) > 1:
        return (None,) * count, landmarker or (recipe.files.get(LANDMARKER) if recipe else None)
    return recipe.landmarks, recipe.files.get(LANDMARKER)


def _models(arguments: argparse.Namespace, recipe: PhotoRecipe | None) -> dict[str, Path]:
    from facepipe.photo_options import MODELS

    kept = recipe.files if recipe else {}
    found = {name: getattr(arguments, name) or kept.get(name) for name in MODELS}
    return {name: path for name, path in found.items() if path is not None}


def _settings(path: Path | None, recipe: PhotoRecipe | None) -> PhotoSettings:
    """Those of the recipe, or the defaults."""
    from facepipe.photo_options import PhotoFitOptions
    from facepipe.pipeline.photo_job import PhotoSettings, recipe_settings

    return PhotoSettings(options=PhotoFitOptions()) if path is None or recipe is None else recipe_settings(path, recipe)


def _changed(arguments: argparse.Namespace, settings: PhotoSettings, photos: int) -> PhotoSettings:
    """The settings with what the line says."""
    from facepipe.photo_options import PhotoFitOptions

    threshold = getattr(arguments, "landmark_threshold", settings.threshold)
    if not (math.isfinite(threshold) and threshold > 0):
        raise InputError("--landmark-threshold", f"{threshold:g}, expected a number above 0")
    kept = settings.faces if len(arguments.files) < 2 else ()
    faces = _faces(getattr(arguments, "faces", kept), photos)
    expressions = getattr(arguments, "expressions", settings.expressions)
    return replace(
        settings,
        faces=faces,
        expressions=None if expressions is None else tuple(expressions),
        threshold=float(threshold),
        options=replace(settings.options, **given_options(arguments, PhotoFitOptions)),
    )


def _faces(indices: Sequence[int | None], photos: int) -> tuple[int | None, ...]:
    """An index for each photo; one alone is that of every photo."""
    if len(indices) < 2:
        return (tuple(indices) or (None,)) * photos
    if len(indices) != photos:
        raise InputError("--face", f"{len(indices)} given, expected one, or {photos}: one for each photo")
    return tuple(indices)
