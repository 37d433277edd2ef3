"""A blended face made again from its recipe, as parts: for hosts that hold the face themselves."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

from facepipe.parts import FaceParts
from facepipe.processors.blend import Blend, blend_recipe, read_blend_recipe
from facepipe.stage import Face, open_face


@dataclass(frozen=True, kw_only=True)
class Reblended:
    """A blended face, and one line for each source that has changed since."""

    parts: FaceParts
    warnings: tuple[str, ...] = ()


def reblended(path: Path) -> Reblended:
    """Blend again what `facepipe blend` wrote as `path`, which stays as it is.

    :raises InputError: no recipe of a blend, a source that is gone
    :raises SchemaError, TopologyError: a damaged recipe, or sources that can't be blended any more
    """
    recipe = read_blend_recipe(path)
    sources = [open_face(one) for one in recipe.sources]
    made = blend_recipe([str(one) for one in recipe.sources], path, recipe.weights, recipe.options)
    with (
        tempfile.TemporaryDirectory() as folder,
        sources[0].deriving(Path(folder) / "blended.usda", flatten=recipe.standalone) as face,
    ):
        report = Blend(weights=recipe.weights, options=recipe.options)(face, sources, recipe=made)
        parts = Face(face.stage, face.prim).parts()
    return Reblended(parts=parts, warnings=(*recipe.warnings, *report.warnings))
