"""Neutrals: fitted by `facepipe fit-neutral`, and again from their recipes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from facepipe.importers.scan_file import read_scan
from facepipe.kinds import Watch
from facepipe.pipeline.rebuild_stage import Made, read_stage_recipe
from facepipe.pipeline.scan_input import landmarks_of, named
from facepipe.pipeline.verbs import Cooked
from facepipe.processors.database import QualityLimits, load_database, misses
from facepipe.processors.rebuild import FitNeutral, FitNeutralOptions, NeutralFit, NeutralReport, Template
from facepipe.processors.rebuild.author_neutral import AuthorNeutral
from facepipe.processors.rebuild.neutral_recipe import VERB, neutral_recipe
from facepipe.scans import Scan
from facepipe.stage import open_face

_STEPS = 18  # of a fit, at most


@dataclass(frozen=True, kw_only=True)
class NeutralJob:
    """A neutral to fit."""

    scan: Path
    template: Path
    database: Path
    landmarks: Path | None  # None: to be found on the scan
    out: Path
    weights: Mapping[str, float] = field(default_factory=dict)  # of shapes that the scan shows besides
    options: FitNeutralOptions = field(default_factory=FitNeutralOptions)
    flatten: bool = False


Seen = Callable[[Template, Scan, NeutralFit], object]


def cook(path: Path, watch: Watch) -> Cooked:
    """Fit again in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read, or that can't be fitted
    """
    recipe = read_stage_recipe(path, VERB)
    job = NeutralJob(
        scan=recipe.file("scan"),
        template=recipe.file("template"),
        database=recipe.file("database"),
        landmarks=recipe.optional("landmarks"),
        out=path,
        weights=recipe.weights("weights"),
        options=recipe.options(FitNeutralOptions),
        flatten=recipe.standalone,
    )
    made = make(job, watch)
    return Cooked(report=made.report, missed=bool(made.missed))


def make(job: NeutralJob, watch: Watch, seen: Seen = lambda template, scan, fit: None) -> Made[NeutralReport]:
    """Read, fit, author, save.

    :param seen: called with the result before it is saved
    :raises FacepipeError: what can't be read, fitted or written
    """
    fit_neutral, face = FitNeutral(options=job.options), open_face(job.template)
    template = Template.of(face.parts(), str(job.template))
    database, scan = load_database(job.database), read_scan(job.scan)
    landmarks, found = landmarks_of(job.landmarks, scan)
    with named(job.scan), watch("fit", _STEPS) as bar:
        fit = fit_neutral(template, scan, landmarks, database, lambda step: bar.update(), job.weights)
    report = fit.report
    recipe = neutral_recipe(
        job.template,
        job.scan,
        job.database,
        job.out,
        job.options,
        report.quality,
        job.landmarks,
        job.weights,
        report.weights,
    )
    with face.deriving(job.out, flatten=job.flatten) as derived:
        with named(job.template):
            authored = AuthorNeutral()(derived, fit.points, recipe=recipe)
        seen(template, scan, fit)
    missed = misses(report.quality, QualityLimits())
    told = (*found, *report.warnings, *authored.warnings, *missed)
    return Made(replace(report, warnings=told), missed)
