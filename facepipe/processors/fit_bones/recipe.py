"""The recipe of a bone fit: what it takes to fit again after a change."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from facepipe import __version__
from facepipe.core.errors import InputError, SchemaError
from facepipe.declare import from_json, json_value
from facepipe.parts import Recipe
from facepipe.processors.fit_bones.fit_bones import FitBones
from facepipe.processors.fit_bones.initial import is_payload
from facepipe.processors.fit_bones.limits import limits_from_json
from facepipe.processors.fit_bones.options import FitBonesOptions
from facepipe.processors.fit_bones.point_weights import LARGEST_WEIGHT
from facepipe.processors.fit_bones.target_files import split_file
from facepipe.stage.files import relative_path
from facepipe.stage.recipes import changed_sources, existing_source, recipe_of, source_digest

VERB = "fit-bones"

Part = Literal["rig", "targets", "initial"]

_ARGUMENTS: Mapping[Part, str] = {"rig": "RIG", "targets": "--target", "initial": "--initial"}
_KEYS = {"targets", "options", "limits", "regions", "mask", "initial"}


@dataclass(frozen=True, kw_only=True)
class FitBonesRecipe:
    """A recipe read back: its fit on the opened `rig` makes the same face again.

    >>> recipe = read_fit_bones_recipe("fitted.usda")
    >>> face = facepipe.open(recipe.rig)
    >>> with face.deriving("again.usda") as result:
    ...     recipe.fit(result, read_targets(face, recipe.targets))
    """

    rig: Path  # absolute, as all files
    targets: tuple[str, ...]  # as `read_targets` takes them
    fit: FitBones  # without coefficients to start from, which need the face:
    initial: str | None  # `initial_coefficients` reads them
    standalone: bool  # the face was saved without reference to its rig
    warnings: tuple[str, ...] = ()  # sources that have changed since, one line each


class _Settings(NamedTuple):
    """Options of a recipe; files as they stand there."""

    targets: tuple[str, ...]
    fit: FitBones
    initial: str | None


def fit_bones_recipe(
    rig: str | os.PathLike[str],
    words: Sequence[str],
    out: str | os.PathLike[str],
    fit: FitBones,
    initial: str | None = None,
) -> Recipe:
    """The recipe to author on a fit of the rig at a path that is saved as `out`.

    Sources are the rig, the files of targets and that of `initial`, as seen from the folder of `out`.

    :param words: the targets, as `read_targets` takes them
    :param initial: what `initial_coefficients` made ``fit.initial`` from
    :raises InputError: a source can't be read, or a target is there twice
    """
    folder = Path(out).absolute().parent
    files = {relative_path(os.fspath(rig), folder): os.fspath(rig)}
    targets = []
    for word in words:
        file, name = split_file(word)
        if file is not None:
            files.setdefault(relative_path(file, folder), file)
        targets.append(word if file is None else _word(relative_path(file, folder), name))
        if targets[-1] in targets[:-1]:
            raise InputError(f"target {word}", "given twice, expected it once")
    if initial is not None and is_payload(initial):
        files.setdefault(relative_path(initial, folder), initial)
        initial = relative_path(initial, folder)
    return Recipe(
        verb=VERB,
        sources=tuple(files),
        digests=tuple(source_digest(Path(file)) for file in files.values()),
        options={
            "targets": targets,
            "options": {one.name: json_value(getattr(fit, one.name)) for one in dataclasses.fields(FitBonesOptions)},
            "limits": fit.limits.to_json(),
            "regions": {name: float(fit.regions[name]) for name in sorted(fit.regions)},
            "mask": list(fit.mask),
            "initial": initial,
        },
        version=__version__,
    )


def _word(file: str, name: str) -> str:
    return f"{file}:{name}" if name else file


def read_fit_bones_recipe(path: str | os.PathLike[str], *, replaced: Collection[Part] = ()) -> FitBonesRecipe:
    """The recipe on the fitted face of a USD file; its other layers may be lost.

    :param replaced: what the caller takes others for: its files may be lost or changed
    :raises InputError: no recipe of a bone fit, or a source that is not where it was
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    file = Path(path)
    recipe, standalone = recipe_of(file, VERB)
    where, folder = f"{file} -> recipe", file.absolute().parent
    try:
        settings = _settings(where, recipe.options)
    except InputError as error:
        raise SchemaError(error.where, error.what) from None
    parts = _parts(where, recipe, settings)
    needed = {source: [part for part in own if part not in replaced] for source, own in parts.items()}
    found = {
        source: existing_source(f"{where} -> source {number}", folder / source, _ARGUMENTS[own[0]])
        if own
        else folder / source
        for number, (source, own) in enumerate(needed.items(), 1)
    }
    kept = [(found[source], old) for source, old in zip(needed, recipe.digests, strict=True) if needed[source]]
    split = [(word, *split_file(word)) for word in settings.targets]
    return FitBonesRecipe(
        rig=found[recipe.sources[0]],
        targets=tuple(word if file is None else _word(str(found[file]), name) for word, file, name in split),
        fit=settings.fit,
        initial=str(found[settings.initial]) if is_payload(settings.initial) else settings.initial,
        standalone=standalone,
        warnings=changed_sources(file, kept),
    )


def _parts(where: str, recipe: Recipe, settings: _Settings) -> dict[str, list[Part]]:
    """Source -> what it is for, in the order of the sources."""
    parts: dict[str, list[Part]] = {recipe.sources[0]: ["rig"]}
    for word in settings.targets:
        file, _ = split_file(word)
        if file is not None:
            parts.setdefault(file, []).append("targets")
    if is_payload(settings.initial):
        parts.setdefault(settings.initial, []).append("initial")
    if tuple(parts) != recipe.sources:
        what = f"sources {', '.join(recipe.sources)[:60]}, expected the rig and the files that its options name"
        raise SchemaError(where, what)
    return parts


def _settings(where: str, content: object) -> _Settings:
    if not isinstance(content, Mapping) or set(content) != _KEYS:
        raise InputError(where, f"options are damaged, expected an object of {', '.join(sorted(_KEYS))}")
    targets = _texts(f"{where} -> targets", content["targets"])
    if not targets:
        raise InputError(f"{where} -> targets", "none, expected at least one")
    initial = content["initial"]
    if initial is not None and not (isinstance(initial, str) and initial):
        raise InputError(f"{where} -> initial", f"{str(initial)[:40]}, expected a text or null")
    options = from_json(FitBonesOptions, content["options"], f"{where} -> options")
    fit = FitBones(
        **dataclasses.asdict(options),
        limits=limits_from_json(content["limits"], f"{where} -> limits"),
        regions=_weights(f"{where} -> regions", content["regions"]),
        mask=_texts(f"{where} -> mask", content["mask"]),
    )
    return _Settings(targets, fit, initial)


def _texts(where: str, value: object) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(one, str) and one for one in value):
        raise InputError(where, f"{str(value)[:40]}, expected a list of texts")
    return tuple(value)


def _weights(where: str, value: object) -> dict[str, float]:
    if not isinstance(value, Mapping):
        raise InputError(where, f"{str(value)[:40]}, expected an object of weights")
    for name, weight in value.items():
        if type(weight) not in (int, float) or not 0 <= weight <= LARGEST_WEIGHT:  # NaN too
            raise InputError(f"{where} -> {name[:60]}", f"{str(weight)[:40]}, expected a number of 0 or more")
    return {name: float(weight) for name, weight in value.items()}
