"""Regions of a painted map: authored by `facepipe regions`, and again from its recipes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from facepipe.declare import from_json
from facepipe.geometry.map_sampling import MapSampling
from facepipe.importers.region_image import read_region_image
from facepipe.kinds import Watch
from facepipe.pipeline.verbs import Cooked, under_source
from facepipe.processors.region_legend import read_legend
from facepipe.processors.regions import RegionsReport, SetRegions
from facepipe.stage import Face, open_face
from facepipe.stage.author_skeleton import author_recipe
from facepipe.stage.source_recipes import read_source_recipe, source_recipe

VERB = "regions"
_PLACE = ("mesh", "uv_set")


@dataclass(frozen=True, kw_only=True)
class RegionPlace:
    """Where a map lies."""

    mesh: str | None = None  # meshes that it covers, globs; default that of most points
    uv_set: str | None = None  # that it was painted over; default st, or the first


@dataclass(frozen=True, kw_only=True)
class RegionJob:
    """Regions to author."""

    face: Path
    map: Path
    legend: Path
    out: Path
    place: RegionPlace = field(default_factory=RegionPlace)
    sampling: MapSampling = field(default_factory=MapSampling)
    flatten: bool = False


def cook(path: Path, watch: Watch) -> Cooked:
    """Author regions again in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read or used
    """
    recipe = read_source_recipe(path, VERB, ("FACE", "--map", "--legend"))
    face, image, legend = recipe.files
    sampling = {name: value for name, value in recipe.options.items() if name not in _PLACE}
    place = {name: value for name, value in recipe.options.items() if name in _PLACE}
    job = RegionJob(
        face=face,
        map=image,
        legend=legend,
        out=path,
        place=from_json(RegionPlace, place, recipe.where),
        sampling=from_json(MapSampling, sampling, recipe.where),
        flatten=recipe.standalone,
    )
    return Cooked(report=make(job))


def make(job: RegionJob, seen: Callable[[Face], object] = lambda face: None) -> RegionsReport:
    """Look the regions up, author, save.

    :param seen: called with the result before it is saved
    :raises FacepipeError: what can't be read, authored or written
    """
    set_regions = SetRegions(
        image=read_region_image(job.map),
        legend=read_legend(job.legend),
        mesh=job.place.mesh,
        uv_set=job.place.uv_set,
        where=str(job.map),
        sampling=job.sampling,
    )
    options = {**dataclasses.asdict(job.place), **dataclasses.asdict(job.sampling)}
    with open_face(job.face).deriving(job.out, flatten=job.flatten) as derived:
        with under_source(job.face):
            report = set_regions(derived)
        author_recipe(derived.prim, source_recipe(VERB, (job.face, job.map, job.legend), job.out, options))
        seen(Face(derived.stage, derived.prim))
    return report
