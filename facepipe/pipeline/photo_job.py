"""What a photo fit is asked for, and how its recipe keeps that."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.declare import from_json, to_json
from facepipe.parts import Recipe
from facepipe.photo_options import MODELS, PhotoFitOptions
from facepipe.processors.photo_fit import PhotoRecipe, photo_recipe, read_photo_recipe

LANDMARKER, START = "landmarker", "start"
_THRESHOLD = 8.0  # percent of the distance of the outer eye corners
_SETTINGS = ("faces", "expressions", "landmark_threshold", "fit")


@dataclass(frozen=True, kw_only=True)
class PhotoJob:
    """A fit to make."""

    face: Path
    photos: tuple[Path, ...]
    landmarks: tuple[Path | None, ...]  # one a photo; None: found in it
    landmarker: Path | None  # MediaPipe's model; None: facepipe's own network
    models: Mapping[str, Path]  # by their options
    start: Path | None  # network that guesses where to start; None: the defaults
    faces: tuple[int | None, ...]  # one a photo: which of several
    expressions: tuple[str, ...] | None  # None: those with ARKit's names
    options: PhotoFitOptions
    threshold: float  # of the mean landmark error, percent of the distance of the outer eye corners
    out: Path
    flatten: bool

    def recipe(self) -> Recipe:
        """The recipe to author on the result.

        :raises InputError: a source can't be read
        """
        named = {LANDMARKER: self.landmarker, START: self.start}
        files = {**self.models, **{name: path for name, path in named.items() if path is not None}}
        settings = {
            "faces": list(self.faces),
            "expressions": None if self.expressions is None else list(self.expressions),
            "landmark_threshold": self.threshold,
            "fit": to_json(self.options),
        }
        return photo_recipe(self.face, self.photos, self.out, landmarks=self.landmarks, files=files, options=settings)


@dataclass(frozen=True, kw_only=True)
class PhotoSettings:
    """What a recipe keeps beside files."""

    faces: tuple[int | None, ...] = ()
    expressions: tuple[str, ...] | None = None
    threshold: float = _THRESHOLD
    options: PhotoFitOptions


def recipe_job(path: Path) -> PhotoJob:
    """The job of the recipe on a result, to be made in its place.

    :raises InputError: no recipe of a photo fit, or a source that is not where it was
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    recipe = read_photo_recipe(path)
    settings = recipe_settings(path, recipe)
    return PhotoJob(
        face=recipe.face,
        photos=recipe.photos,
        landmarks=recipe.landmarks,
        landmarker=recipe.files.get(LANDMARKER),
        models={name: recipe.files[name] for name in MODELS if name in recipe.files},
        start=recipe.files.get(START),
        faces=settings.faces,
        expressions=settings.expressions,
        options=settings.options,
        threshold=settings.threshold,
        out=path,
        flatten=recipe.standalone,
    )


def recipe_settings(path: Path, recipe: PhotoRecipe) -> PhotoSettings:
    """:raises InputError: settings that no photo fit wrote"""
    where, kept = f"{path} -> recipe", recipe.options
    if tuple(sorted(kept)) != tuple(sorted(_SETTINGS)):
        raise InputError(where, f"options {', '.join(sorted(kept))[:60]}, expected {', '.join(_SETTINGS)}")
    faces, expressions, threshold, fit = (kept[name] for name in _SETTINGS)
    if not isinstance(faces, list) or not all(one is None or type(one) is int for one in faces):
        raise InputError(f"{where} -> faces", "damaged, expected a list of indices")
    if len(faces) != len(recipe.photos):
        raise InputError(f"{where} -> faces", f"{len(faces)}, expected one for each of {len(recipe.photos)} photos")
    if expressions is not None and not (
        isinstance(expressions, list) and all(isinstance(one, str) for one in expressions)
    ):
        raise InputError(f"{where} -> expressions", "damaged, expected a list of shapes")
    if type(threshold) not in (int, float):
        raise InputError(f"{where} -> landmark_threshold", "damaged, expected a number")
    return PhotoSettings(
        faces=tuple(faces),
        expressions=None if expressions is None else tuple(expressions),
        threshold=threshold,
        options=from_json(PhotoFitOptions, fit, f"{where} -> fit"),
    )
