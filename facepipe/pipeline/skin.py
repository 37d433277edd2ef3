"""Skinned faces: made by `facepipe skin`, and made again from their recipes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from facepipe.pipeline.verbs import Cooked, Watch, under_source
from facepipe.processors.skin import (
    SkinFace,
    SkinOptions,
    SkinReport,
    read_joints,
    read_skin_recipe,
    skin_recipe,
)
from facepipe.stage import Face, open_face


@dataclass(frozen=True, kw_only=True)
class SkinJob:
    """A face to skin."""

    face: Path
    joints: Path | None  # the file of joints; or
    source: Path | None  # the other face
    out: Path
    optimise: bool = False
    options: SkinOptions = field(default_factory=SkinOptions)
    flatten: bool = False


def cook(path: Path, watch: Watch) -> Cooked:
    """Skin again in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read, or that can't be skinned
    """
    recipe = read_skin_recipe(path)
    job = SkinJob(
        face=recipe.face,
        joints=recipe.joints,
        source=recipe.source,
        out=path,
        optimise=recipe.optimise,
        options=recipe.options,
        flatten=recipe.standalone,
    )
    return Cooked(report=make(job, watch))


def make(job: SkinJob, watch: Watch, seen: Callable[[Face], object] = lambda face: None) -> SkinReport:
    """Skin, author, save.

    :param seen: called with the result before it is saved
    :raises FacepipeError: what can't be read, skinned or written
    """
    skin = SkinFace(
        joints=None if job.joints is None else read_joints(job.joints),
        source=None if job.source is None else open_face(job.source),
        optimise=job.optimise,
        options=job.options,
    )
    way = {"joints": job.joints, "source": job.source}
    recipe = skin_recipe(job.face, job.out, **way, optimise=job.optimise, options=job.options)
    steps = job.options.iterations if job.optimise else 0
    with open_face(job.face).deriving(job.out, flatten=job.flatten) as derived:
        with under_source(job.face), watch("optimise", steps) as bar:
            report = skin(derived, bar.update, recipe=recipe)
        seen(Face(derived.stage, derived.prim))
    return report
