"""Bone fits: made by `facepipe fit-bones`, and made again from their recipes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from facepipe.kinds import Watch
from facepipe.parts import FaceParts
from facepipe.pipeline.verbs import Cooked, under_source
from facepipe.processors.fit_bones import (
    FitBones,
    FitBonesReport,
    Target,
    fit_bones_recipe,
    initial_coefficients,
    read_fit_bones_recipe,
    read_targets,
)
from facepipe.stage import Face, open_face


@dataclass(frozen=True, kw_only=True)
class FitJob:
    """A fit to make."""

    rig: Path
    targets: tuple[str, ...]  # as `read_targets` takes them
    fit: FitBones  # without coefficients to start from, which need the rig:
    initial: str | None  # `initial_coefficients` reads them
    out: Path
    flatten: bool


def cook(path: Path, watch: Watch) -> Cooked:
    """Fit again in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read, or that can't be fitted
    """
    recipe = read_fit_bones_recipe(path)
    job = FitJob(
        rig=recipe.rig,
        targets=recipe.targets,
        fit=recipe.fit,
        initial=recipe.initial,
        out=path,
        flatten=recipe.standalone,
    )
    face = open_face(job.rig)
    report = make(job, face, targets_of(face, job.targets), watch)
    return Cooked(report=report, missed=bool(report.missed))


def targets_of(face: Face, words: Sequence[str]) -> tuple[Target, ...]:
    """The targets that words name, for the rig `face`.

    :raises FacepipeError: what can't be read, or is of other meshes
    """
    return tuple(read_targets(face, words, lambda path: _load(path, face)))


def _load(path: Path, face: Face) -> FaceParts:
    """An OBJ in the units and axes of the face, or a glTF in its own."""
    from facepipe.importers import load, obj

    if path.suffix.lower() == ".obj":
        up_axis = "Z" if face.up_axis == "Z" else "Y"
        return load("obj", path, obj.Options(meters_per_unit=face.meters_per_unit, up_axis=up_axis)).parts  # type: ignore[arg-type]
    return load("gltf", path).parts


def make(
    job: FitJob,
    face: Face,
    targets: Sequence[Target],
    watch: Watch,
    seen: Callable[[Face, FitBonesReport], object] = lambda face, report: None,
) -> FitBonesReport:
    """Fit, author, save.

    :param face: the opened rig
    :param seen: called with the result before it is saved
    :raises FacepipeError: what can't be fitted or written
    """
    initial = None if job.initial is None else initial_coefficients(face, job.initial)
    fit = replace(job.fit, initial=initial)
    recipe = fit_bones_recipe(job.rig, job.targets, job.out, fit, job.initial)
    frames = sum(len(target.points) for target in targets)
    with face.deriving(job.out, flatten=job.flatten) as derived:
        with under_source(job.rig), watch("fit", frames) as bar:
            report = fit(derived, targets, recipe=recipe, done=bar.update)
        seen(Face(derived.stage, derived.prim), report)
    return report
