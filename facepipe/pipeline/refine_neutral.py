"""Refined neutrals: made by `facepipe refine-neutral`, and made again from their recipes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from facepipe.core.errors import SchemaError
from facepipe.importers.scan_file import read_scan
from facepipe.kinds import Watch
from facepipe.parts import FaceParts, FloatArray
from facepipe.pipeline.rebuild_stage import Made, StageRecipe, read_stage_recipe
from facepipe.pipeline.verbs import Cooked
from facepipe.processors.database import QualityLimits, misses, whole_face
from facepipe.processors.rebuild import (
    RefinedNeutral,
    RefineNeutral,
    RefineNeutralOptions,
    RefineReport,
    Template,
    resolved,
)
from facepipe.processors.rebuild.author_neutral import AuthorNeutral
from facepipe.processors.rebuild.neutral_recipe import REFINED, flipped_before, refined_recipe, shown_before
from facepipe.processors.rebuild.region_weights import region_weights
from facepipe.processors.rebuild.scan_input import landmarks_of, named
from facepipe.processors.rebuild.shown_shapes import ShownShapes
from facepipe.scans import Scan
from facepipe.stage import open_face

_STEPS = 16  # of a refinement, at most


@dataclass(frozen=True, kw_only=True)
class RefineJob:
    """A neutral to refine."""

    neutral: Path
    scan: Path
    landmarks: Path | None  # None: to be found on the scan
    out: Path
    regions: tuple[str, ...] = ()  # that may follow; none: all
    weights: Mapping[str, float] = field(default_factory=dict)  # of what the scan shows besides; none: as it was fitted
    options: RefineNeutralOptions = field(default_factory=RefineNeutralOptions)
    flatten: bool = False


class Refined(NamedTuple):
    """A refinement that is authored and not yet saved."""

    template: Template
    scan: Scan
    found: RefinedNeutral
    expression: FloatArray  # (n, 3) whole delta of what the scan shows besides


def cook(path: Path, watch: Watch) -> Cooked:
    """Refine again in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read, or that can't be fitted
    """
    recipe = read_stage_recipe(path, REFINED)
    job = RefineJob(
        neutral=recipe.file("neutral"),
        scan=recipe.file("scan"),
        landmarks=recipe.optional("landmarks"),
        out=path,
        regions=_regions(recipe),
        weights=recipe.weights("weights"),
        options=recipe.options(RefineNeutralOptions),
        flatten=recipe.standalone,
    )
    made = make(job, watch)
    return Cooked(report=made.report, missed=bool(made.missed))


def _regions(recipe: StageRecipe) -> tuple[str, ...]:
    names = recipe.content.get("regions")
    if not isinstance(names, list) or not all(isinstance(one, str) for one in names):
        raise SchemaError(f"{recipe.where} -> regions", f"{str(names)[:40]}, expected a list of names")
    return tuple(names)


def make(job: RefineJob, watch: Watch, seen: Callable[[Refined], object] = lambda refined: None) -> Made[RefineReport]:
    """Read, refine, author, save.

    :param seen: called with the result before it is saved
    :raises FacepipeError: what can't be read, fitted or written
    """
    refine, face = RefineNeutral(options=job.options), open_face(job.neutral)
    parts = face.parts()
    weights = region_weights(parts, job.regions, str(job.neutral))
    template = Template.of(parts, str(job.neutral))
    scan = read_scan(job.scan)
    landmarks, told = landmarks_of(job.landmarks, scan)
    expression, shown = _expression(parts, job)
    with named(job.scan), watch("refine", _STEPS) as bar:
        found = refine(
            template,
            template.points,
            scan,
            landmarks,
            weights=weights,
            expression=expression,
            flipped=flipped_before(parts.recipe),
            progress=lambda step: bar.update(),
        )
    report, files = found.report, (job.neutral, job.scan, job.landmarks)
    recipe = refined_recipe(*files, job.out, job.regions, job.options, report.quality, shown, job.weights)
    with face.deriving(job.out, flatten=job.flatten) as derived:
        with named(job.neutral):
            authored = AuthorNeutral()(derived, found.points, recipe=recipe)
        seen(Refined(template, scan, found, expression))
    missed = misses(report.quality, QualityLimits())
    return Made(replace(report, warnings=(*told, *report.warnings, *authored.warnings, *missed)), missed)


def _expression(parts: FaceParts, job: RefineJob) -> tuple[FloatArray, dict[str, float]]:
    """(n, 3) whole delta of what the scan shows besides, and its weights by the names of the face's shapes."""
    shown = job.weights or shown_before(parts.recipe)
    own = whole_face(parts, str(job.neutral))
    weights = resolved(shown, tuple(own.deltas), f"{job.neutral} -> --weights") if shown else {}
    return ShownShapes(deltas=own.deltas, weights=weights).expression(weights, len(own.points)), weights
