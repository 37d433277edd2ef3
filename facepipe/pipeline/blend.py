"""Blends: made by `facepipe blend`, and made again from their recipes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from facepipe.core.errors import FacepipeError
from facepipe.kinds import Watch
from facepipe.pipeline.verbs import Cooked
from facepipe.processors.blend import Blend, BlendReport, BlendSession, Weights, blend_recipe, read_blend_recipe
from facepipe.stage import Face, open_face


def cook(path: Path, watch: Watch) -> Cooked:
    """Blend again in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read, or that can't be blended
    """
    recipe = read_blend_recipe(path)
    session = BlendSession([open_face(one) for one in recipe.sources], recipe.options, live=False)
    return Cooked(report=make(session, recipe.sources, recipe.weights, path, watch, flatten=recipe.standalone))


def make(
    session: BlendSession,
    sources: Sequence[Path],
    weights: Weights,
    out: Path,
    watch: Watch,
    *,
    flatten: bool = False,
    seen: Callable[[Face], object] = lambda face: None,
) -> BlendReport:
    """Blend, author, save as `out`.

    :param sources: files of the faces of `session`
    :param seen: called with the result before it is saved
    :raises FacepipeError: what can't be blended or written
    """
    recipe = blend_recipe(sources, out, weights, session.options)
    blend = Blend(weights=weights, options=session.options)
    with session.faces[0].deriving(out, flatten=flatten) as face, watch("blend", len(session.sculpts)) as bar:
        try:
            report = blend(face, session, recipe=recipe, done=bar.update)
        except FacepipeError as error:  # the layer being made has no file yet
            raise error.under(out) if error.where.startswith("<") else error from None
        seen(Face(face.stage, face.prim))
    return report
