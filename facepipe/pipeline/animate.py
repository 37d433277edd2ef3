"""Performances put on faces: by `facepipe animate`, and again from its recipes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from facepipe.core.errors import InputError, SchemaError
from facepipe.core.names import identifier
from facepipe.declare import check_ranges, from_json, to_json
from facepipe.kinds import Watch, unwatched
from facepipe.pipeline.verbs import Cooked, under_source
from facepipe.processors.animate import AnimateFace, AnimateOptions, AnimateReport, read_performance
from facepipe.stage import open_face
from facepipe.stage.source_recipes import read_source_recipe, source_recipe

VERB = "animate"


@dataclass(frozen=True, kw_only=True)
class AnimateJob:
    """A performance to put on a face."""

    face: Path
    clip: Path  # .csv or .json
    out: Path
    name: str | None = None  # of the animation; None: the clip's
    options: AnimateOptions = field(default_factory=AnimateOptions)
    flatten: bool = False


def cook(path: Path, watch: Watch) -> Cooked:
    """Put a performance on its face again in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read or used
    """
    recipe = read_source_recipe(path, VERB, ("FACE", "CLIP"))
    face, clip = recipe.files
    values = dict(recipe.options)
    name = values.pop("name", None)
    if not isinstance(name, str):
        raise SchemaError(f"{recipe.where} -> name", f"{str(name)[:40]}, expected a text")
    options = from_json(AnimateOptions, values, recipe.where)
    job = AnimateJob(face=face, clip=clip, out=path, name=name, options=options, flatten=recipe.standalone)
    return Cooked(report=make(job, watch))


def make(job: AnimateJob, watch: Watch = unwatched) -> AnimateReport:
    """Read, author, save.

    :raises FacepipeError: what can't be read, put on the face or written
    """
    name = identifier(job.clip.stem) if job.name is None else job.name
    if identifier(name) != name:
        raise InputError(f"--name {name}", f"no name of a prim, expected one like {identifier(name)}")
    check_ranges(job.options)
    performance = read_performance(job.clip, job.options.fps, degrees=job.options.angles == "deg")
    animate = AnimateFace(performance=performance, name=name, options=job.options)
    recipe = source_recipe(VERB, (job.face, job.clip), job.out, {"name": name, **to_json(job.options)})
    face = open_face(job.face)
    frames, derive = len(performance.values), face.deriving(job.out, flatten=job.flatten)
    with watch("animate", frames) as bar, derive as derived, under_source(job.face):
        return animate(derived, recipe=recipe, done=bar.update)
