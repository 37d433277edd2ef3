"""Faces rebuilt from bone coefficients: by `facepipe apply-bones`, and again from its recipes."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from facepipe.declare import from_json
from facepipe.kinds import Watch
from facepipe.payload import PayloadContent, decode
from facepipe.pipeline.verbs import Cooked, under_source
from facepipe.processors.apply_bones import ApplyBones, ApplyBonesReport
from facepipe.processors.bone_payload import payload_bytes
from facepipe.stage import Face, open_face
from facepipe.stage.source_recipes import read_source_recipe, source_recipe

VERB = "apply-bones"


@dataclass(frozen=True, kw_only=True)
class ApplyOptions:
    """How coefficients are authored."""

    name: str = "pose"  # of the animation
    clamp: bool = False  # bring coefficients into the limits of the face


@dataclass(frozen=True, kw_only=True)
class ApplyJob:
    """Coefficients to author."""

    face: Path
    coefficients: Path  # .fpb
    out: Path
    options: ApplyOptions
    flatten: bool = False


def cook(path: Path, watch: Watch) -> Cooked:
    """Author coefficients again in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read or used
    """
    recipe = read_source_recipe(path, VERB, ("FACE", "COEFFICIENTS"))
    source, coefficients = recipe.files
    options = from_json(ApplyOptions, recipe.options, recipe.where)
    job = ApplyJob(face=source, coefficients=coefficients, out=path, options=options, flatten=recipe.standalone)
    face = open_face(source)
    report = make(job, face, decode(payload_bytes(coefficients), face.skeleton.joints, coefficients))
    return Cooked(report=report, missed=missed(report, options))


def make(job: ApplyJob, face: Face, content: PayloadContent) -> ApplyBonesReport:
    """Author, save.

    :param face: the opened face, and `content` that of the file of coefficients
    :raises FacepipeError: what can't be authored or written
    """
    apply = ApplyBones(content=content, name=job.options.name, clamp=job.options.clamp)
    recipe = source_recipe(VERB, (job.face, job.coefficients), job.out, dataclasses.asdict(job.options))
    with face.deriving(job.out, flatten=job.flatten) as derived, under_source(job.face):
        return apply(derived, recipe=recipe)


def missed(report: ApplyBonesReport, options: ApplyOptions) -> bool:
    """Whether coefficients stay beyond the limits of the face."""
    return bool(report.beyond_limits) and not options.clamp
