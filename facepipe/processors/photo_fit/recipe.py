"""The recipe of a photo fit: what it takes to fit again after a change."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from facepipe import __version__
from facepipe.core.errors import InputError, SchemaError
from facepipe.core.finite import require_finite
from facepipe.declare import json_value
from facepipe.parts import Recipe
from facepipe.stage.files import relative_path
from facepipe.stage.recipes import changed_sources, existing_source, recipe_of, source_digest

VERB = "fit-photo"

_KEYS = {"photos", "landmarks", "files", "options"}
_FACE, _PHOTOS, _LANDMARKS = "FACE", "PHOTO", "--landmarks"

AnyPath = str | os.PathLike[str]


@dataclass(frozen=True, kw_only=True)
class PhotoRecipe:
    """A recipe read back: the same fit of the opened `face` to `photos` makes the same person again."""

    face: Path  # absolute, as all files
    photos: tuple[Path, ...]
    landmarks: tuple[Path | None, ...]  # one a photo; None where they were found in the photo
    files: Mapping[str, Path]  # option -> file: feature models, landmarker ...
    options: Mapping[str, Any]  # as given to `photo_recipe`; the fit checks them
    standalone: bool = False  # the result was saved without reference to its face
    warnings: tuple[str, ...] = ()  # sources that have changed since, one line each


@dataclass(frozen=True, kw_only=True)
class _Settings:
    """Options of a recipe; files as they stand there."""

    photos: tuple[str, ...]
    landmarks: tuple[str | None, ...]
    files: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)

    def arguments(self) -> dict[str, str]:
        """File -> the argument that it was first given as, in the order of the sources after the face."""
        found = dict.fromkeys(self.photos, _PHOTOS)
        for file in self.landmarks:
            if file is not None:
                found.setdefault(file, _LANDMARKS)
        for name in sorted(self.files):
            found.setdefault(self.files[name], f"--{name.replace('_', '-')}")
        return found


def photo_recipe(
    face: AnyPath,
    photos: Sequence[AnyPath],
    out: AnyPath,
    *,
    landmarks: Sequence[AnyPath | None] = (),
    files: Mapping[str, AnyPath] | None = None,
    options: Mapping[str, object] | None = None,
) -> Recipe:
    """The recipe to author on the fit of a face at a path to photos, saved as `out`.

    Sources are the face, the photos, and the files of landmarks and options, as seen from the folder of `out`.

    :param landmarks: none, or a file for each photo, None where they were found in the photo
    :param files: option -> file
    :param options: all else that the fit was told, as JSON holds it
    :raises InputError: no photos, one given twice, landmarks of other photos, options that JSON can't hold, or a source
        that can't be read
    """
    folder = Path(out).absolute().parent

    def seen(file: AnyPath) -> str:
        return relative_path(os.fspath(file), folder)

    if landmarks and len(landmarks) != len(photos):
        raise InputError(VERB, f"{len(landmarks)} files of landmarks of {len(photos)} photos, expected one each")
    settings = _Settings(
        photos=tuple(map(seen, photos)),
        landmarks=tuple(None if one is None else seen(one) for one in landmarks) or (None,) * len(photos),
        files={name: seen(file) for name, file in (files or {}).items()},
        options=_json(options or {}),
    )
    _check_photos(VERB, settings.photos)
    sources = dict.fromkeys([seen(face), *settings.arguments()])
    return Recipe(
        verb=VERB,
        sources=tuple(sources),
        digests=tuple(source_digest(folder / one) for one in sources),
        options={
            "photos": list(settings.photos),
            "landmarks": list(settings.landmarks),
            "files": {name: settings.files[name] for name in sorted(settings.files)},
            "options": settings.options,
        },
        version=__version__,
    )


def read_photo_recipe(path: AnyPath, *, replaced: Collection[str] = ()) -> PhotoRecipe:
    """The recipe on the fitted face of a USD file; its other layers may be lost.

    :param replaced: arguments (``FACE``, ``PHOTO``, ``--landmarks``, ``--landmarker`` ...) that the caller takes others
        for: their files may be lost or changed
    :raises InputError: no recipe of `facepipe fit-photo`, or a source that is not where it was
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    file = Path(path)
    recipe, standalone = recipe_of(file, VERB)
    where, folder = f"{file} -> recipe", file.absolute().parent
    settings = _settings(where, recipe.options)
    arguments = {recipe.sources[0]: _FACE, **settings.arguments()}
    if tuple(arguments) != recipe.sources:
        what = f"sources {', '.join(recipe.sources)[:60]}, expected the face and the files that its options name"
        raise SchemaError(where, what)
    found = {
        source: folder / source
        if argument in replaced
        else existing_source(f"{where} -> source {number}", folder / source, argument)
        for number, (source, argument) in enumerate(arguments.items(), 1)
    }
    kept = [
        (found[source], old)
        for source, old in zip(recipe.sources, recipe.digests, strict=True)
        if arguments[source] not in replaced
    ]
    return PhotoRecipe(
        face=found[recipe.sources[0]],
        photos=tuple(found[one] for one in settings.photos),
        landmarks=tuple(None if one is None else found[one] for one in settings.landmarks),
        files={name: found[one] for name, one in settings.files.items()},
        options=settings.options,
        standalone=standalone,
        warnings=changed_sources(file, kept),
    )


def _json(options: Mapping[str, object]) -> dict[str, Any]:
    """The options as JSON gives them back.

    :raises InputError: what JSON can't hold
    """
    try:
        require_finite(options)
        found = json.loads(json.dumps(json_value(options), allow_nan=False))
    except InputError as error:
        raise error.under(f"{VERB} -> options") from None
    except (TypeError, ValueError) as error:
        raise InputError(f"{VERB} -> options", f"no JSON: {error}") from None
    return dict(found)


def _check_photos(where: str, photos: Sequence[str]) -> None:
    twice = next((one for number, one in enumerate(photos) if one in photos[:number]), None)
    if not photos or twice is not None:
        raise InputError(where, "no photos, expected one or more" if not photos else f"photo {twice} given twice")


def _settings(where: str, content: object) -> _Settings:
    if not isinstance(content, Mapping) or set(content) != _KEYS:
        raise SchemaError(where, f"options are damaged, expected an object of {', '.join(sorted(_KEYS))}")
    photos, landmarks, files, options = (content[key] for key in ("photos", "landmarks", "files", "options"))
    texts = isinstance(photos, list) and all(isinstance(one, str) and one for one in photos)
    if not texts or not photos or len(set(photos)) != len(photos):
        raise SchemaError(f"{where} -> photos", "damaged, expected a list of different files")
    given = isinstance(landmarks, list) and all(one is None or (isinstance(one, str) and one) for one in landmarks)
    if not given or len(landmarks) != len(photos):
        raise SchemaError(f"{where} -> landmarks", "damaged, expected a file or null for each photo")
    if not isinstance(files, Mapping) or not all(isinstance(one, str) and one for one in files.values()):
        raise SchemaError(f"{where} -> files", "damaged, expected an object of files")
    if not isinstance(options, Mapping):
        raise SchemaError(f"{where} -> options", "damaged, expected an object")
    return _Settings(photos=tuple(photos), landmarks=tuple(landmarks), files=dict(files), options=dict(options))
