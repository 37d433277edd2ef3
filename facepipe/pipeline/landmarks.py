"""Named landmarks: authored by `facepipe landmarks`, and again from its recipes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.core.reports import Report
from facepipe.declare import from_json, to_json
from facepipe.importers.landmark_file import read_landmarks
from facepipe.kinds import Watch
from facepipe.pipeline.verbs import Cooked
from facepipe.processors.landmarks import SetLandmarks, mesh_of
from facepipe.stage import open_face
from facepipe.stage.author_skeleton import author_recipe
from facepipe.stage.source_recipes import read_source_recipe, source_recipe

VERB = "landmarks"


@dataclass(frozen=True, kw_only=True)
class LandmarkOptions:
    """How a file of landmarks is authored."""

    scheme: str | None = None  # its name, where the file holds one; default the file's
    mesh: str | None = None  # that they lie on; default the one with most points


@dataclass(frozen=True, kw_only=True)
class LandmarkFileReport(Report):
    """What was authored."""

    schemes: dict[str, int]  # scheme -> its landmarks
    mesh: str


def cook(path: Path, watch: Watch) -> Cooked:
    """Author landmarks again in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read or used
    """
    recipe = read_source_recipe(path, VERB, ("FACE", "--from"))
    options = from_json(LandmarkOptions, recipe.options, recipe.where)
    face, file = recipe.files
    return Cooked(report=make(face, file, path, options, flatten=recipe.standalone))


def make(face: Path, file: Path, out: Path, options: LandmarkOptions, *, flatten: bool = False) -> LandmarkFileReport:
    """The landmarks of a file on the face at a path, saved as `out`.

    :raises FacepipeError: what can't be read, authored or written
    """
    source = open_face(face)
    schemes = read_landmarks(file, len(mesh_of(source, options.mesh).points))
    if options.scheme and len(schemes) > 1:
        raise InputError(file, f"{len(schemes)} schemes, expected one where --scheme names it")
    with source.deriving(out, flatten=flatten) as derived:
        reports = [
            SetLandmarks(scheme=options.scheme or scheme, landmarks=landmarks, mesh=options.mesh)(derived)
            for scheme, landmarks in schemes.items()
        ]
        author_recipe(derived.prim, source_recipe(VERB, (face, file), out, to_json(options)))
    return LandmarkFileReport(schemes={one.scheme: one.count for one in reports}, mesh=reports[0].mesh)
