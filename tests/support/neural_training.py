"""Faces that neural rigs learn soon, and the options of quick trainings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scan_domes

from facepipe.neural import SampleMotionOptions, TrainNeuralRigOptions
from facepipe.parts import Animation, FaceParts, Slider

SAMPLES = SampleMotionOptions(spread=200, sweep=9, together=100)
OPTIONS = TrainNeuralRigOptions(width=24, steps=1500, patience=1500)


def turning_face() -> FaceParts:
    """Sliders that turn the jaw and the eye far, and shapes without a slider."""
    jaw = Slider(name="open", minimum=-0.2, channels=(("head/jaw", "rx", 1.0),))
    eye = Slider(name="look", minimum=-1.0, channels=(("head/eye", "ry", 0.6), ("head/jaw", "sz", 0.3)))
    return replace(scan_domes.face(), sliders=(jaw, eye), animations=())


class KilledError(Exception):
    pass


_OWN = {"smile": 1.6 * np.eye(3), "jawOpen": np.array([[1.0, 0.0, 0.0], [0.4, 0.8, 0.0], [0.0, 0.0, 1.0]])}


def second_face() -> FaceParts:
    """Another person, whose smile is stronger, and whose mouth opens to one side."""
    parts = turning_face()
    meshes = []
    for mesh in parts.meshes:
        wide = mesh.points * np.array([1.15, 0.95, 1.05])
        shapes = tuple(
            replace(blendshape, offsets=blendshape.offsets @ _OWN[blendshape.name]) for blendshape in mesh.blendshapes
        )
        meshes.append(replace(mesh, points=wide, blendshapes=shapes))
    return replace(parts, meshes=tuple(meshes))


FEW = SampleMotionOptions(spread=20, sweep=5, together=30)


def chewing_face() -> FaceParts:
    """Two shapes, and a slider that turns the jaw and adds half of one of them."""
    parts = scan_domes.face()
    slider = Slider(
        name="chew", minimum=-0.5, maximum=1.0, channels=(("head/jaw", "rx", 0.3),), shapes=(("jawOpen", 0.5),)
    )
    return replace(parts, sliders=(slider,), animations=())


AMOUNTS = np.linspace(0.0, 1.0, 40)


def acted() -> FaceParts:
    """A face with a clip of 40 frames and a pose, both of shapes."""
    names = ("jawOpen", "smile")  # a slider of the face drives the first
    clip = Animation(
        name="talk",
        times=np.arange(len(AMOUNTS)) / 24.0,
        shapes=names,
        shape_weights=np.stack([0.1 * AMOUNTS, AMOUNTS], axis=1),
    )
    pose = Animation(name="grin", shapes=("smile",), shape_weights=np.array([[0.75]]))
    return replace(chewing_face(), animations=(clip, pose))


FEW_SAMPLES = SampleMotionOptions(spread=60, sweep=5, together=20)
FEW_STEPS = TrainNeuralRigOptions(width=8, steps=130)
