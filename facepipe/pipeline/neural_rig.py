"""Faces with a neural rig: made by `facepipe neural-rig apply`, and made again from their recipes."""

from __future__ import annotations

from pathlib import Path

from facepipe.kinds import Watch
from facepipe.pipeline.verbs import Cooked, under_source
from facepipe.processors.neural_rig import (
    ApplyNeuralRig,
    ApplyNeuralRigReport,
    AttachOptions,
    neural_rig_recipe,
    read_neural_rig_recipe,
)
from facepipe.stage import open_face


def cook(path: Path, watch: Watch) -> Cooked:
    """Apply the rig again in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read, or a rig of other meshes, joints or skin
    """
    recipe = read_neural_rig_recipe(path)
    return Cooked(report=make(recipe.face, recipe.rig, recipe.options, path, flatten=recipe.standalone))


def make(face: Path, rig: Path, options: AttachOptions, out: Path, *, flatten: bool = False) -> ApplyNeuralRigReport:
    """Apply, author, save as `out`.

    :param rig: .fpnr
    :raises FacepipeError: what can't be read or written, or a rig of other meshes, joints or skin
    """
    recipe = neural_rig_recipe(face, rig, out, options)
    with open_face(face).deriving(out, flatten=flatten) as derived, under_source(face):
        return ApplyNeuralRig(file=rig, options=options)(derived, out, recipe=recipe)
