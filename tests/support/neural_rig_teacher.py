"""The teacher of neural_rig.py: a MakeHuman head whose rig is more than sliders, evaluated by `facepipe.rig`.

Controls are its 59 pose units (bones) and the 34 expression targets (shapes), each 0..1. Beside what they do alone,
pairs and triples of them bring correctives, the product of their values each, and the rotations of bones bring shapes
by their quaternions: the squares of the turn about an axis, and the product of two.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from facepipe.neural import Motion, SampleMotionOptions

FloatArray = npt.NDArray[np.floating]

HEAD = "makehuman/makehuman_head.npz"
GAIN = 2.0  # of correctives: a fifth of the motion is not straight, measured by neural_rig.py
EXPRESSIONS = "expression/caucasian/*"
SCULPTS = (
    "mouth/mouth-dimples-in, mouth/mouth-laugh-lines-in, mouth/mouth-laugh-lines-out, mouth/mouth-angles-up, "
    "mouth/mouth-angles-down, mouth/mouth-trans-forward, mouth/mouth-trans-up, mouth/mouth-trans-down, "
    "mouth/mouth-upperlip-volume-incr, mouth/mouth-lowerlip-volume-incr, "
    "mouth/mouth-scale-vert-incr, chin/chin-prominent-incr, chin/chin-width-incr, chin/chin-height-decr, "
    "cheek/l-cheek-volume-incr, cheek/r-cheek-volume-incr, cheek/l-cheek-trans-up, cheek/r-cheek-trans-up, "
    "forehead/forehead-scale-vert-decr, asym/asym-mouth-1-l, asym/asym-mouth-1-r, "
    "cheek/l-cheek-inner-incr, cheek/r-cheek-inner-incr"
)
PAIRS = (  # controls -> the sculpt that their product brings
    (("JawDrop", "mouth_corner_puller"), "mouth_laugh_lines_in"),
    (("JawDrop", "LipsKiss"), "mouth_trans_forward"),
    (("JawDrop", "mouth_open"), "mouth_scale_vert_incr"),
    (("JawDrop", "UpperLipUp"), "mouth_trans_up"),
    (("ChinDown", "mouth_depression"), "chin_height_decr"),
    (("ChinForward", "lowerLipForward"), "mouth_lowerlip_volume_incr"),
    (("ChinLeft", "mouth_retraction"), "asym_mouth_1_l"),
    (("ChinRight", "mouth_retraction"), "asym_mouth_1_r"),
    (("LeftCheekUp", "mouth_elevation"), "l_cheek_volume_incr"),
    (("RightCheekUp", "mouth_elevation"), "r_cheek_volume_incr"),
    (("LeftUpperLidClosed", "LeftCheekUp"), "l_cheek_trans_up"),
    (("RightUpperLidClosed", "RightCheekUp"), "r_cheek_trans_up"),
    (("eyebrows_left_up", "eyebrows_right_up"), "forehead_scale_vert_decr"),
    (("MouthLeftPullUp", "MouthRightPullUp", "CheeksPump"), "mouth_dimples_in"),
    (("LipsKiss", "mouth_pursing", "JawDrop"), "mouth_upperlip_volume_incr"),
)
TURNS = (  # bone, axes of its turn whose quaternion components are multiplied -> sculpt
    ("jaw", (2, 2), "mouth_trans_down"),
    ("jaw", (2, 1), "chin_width_incr"),
    ("special04", (2, 2), "mouth_laugh_lines_out"),
    ("oris05", (2, 2), "mouth_angles_up"),
    ("oris01", (2, 2), "chin_prominent_incr"),
    ("oris03_L", (0, 0), "l_cheek_inner_incr"),
    ("oris03_R", (0, 0), "r_cheek_inner_incr"),
    ("tongue01", (2, 2), "mouth_angles_down"),
)


@dataclass(frozen=True)
class Teacher:
    """A face, and what its rig makes of the controls."""

    parts: Any  # FaceParts; its shapes are expressions and sculpts
    names: tuple[str, ...]  # of the controls
    turns: FloatArray  # (pose units, j, 9) bone coefficients from rest
    gain: float  # of correctives and quaternion-driven shapes
    shape_gains: Mapping[str, float] = field(default_factory=dict)  # of a person who moves in an own way

    @property
    def controls(self) -> tuple[Any, ...]:
        """Each 0..1."""
        from facepipe.rig.neural_rig import Control

        return tuple(Control(name=name) for name in self.names)

    def __call__(self, values: FloatArray) -> tuple[FloatArray, dict[str, float]]:
        """Bone coefficients (j, 9) and shape weights of (c,) values."""
        from facepipe.rig import rest_coefficients
        from facepipe.rig.bone_coefficients import coefficient_matrices
        from facepipe.rig.trs import quaternions

        joints = self.parts.skeleton.joints
        units = len(self.turns)
        coefficients = rest_coefficients(len(joints)) + np.tensordot(values[:units], self.turns, axes=1)
        weights = dict(zip(self.names[units:], values[units:].tolist(), strict=True))
        own = dict(zip(self.names, values.tolist(), strict=True))
        for controls, sculpt in PAIRS:
            weights[sculpt] = self.gain * float(np.prod([own[name] for name in controls]))
        turned = quaternions(coefficient_matrices(coefficients)[:, :3, :3])
        short = [joint.rpartition("/")[2] for joint in joints]
        for bone, (one, other), sculpt in TURNS:
            q = turned[short.index(bone)]
            weights[sculpt] = weights.get(sculpt, 0.0) + self.gain * float(4.0 * q[one] * q[other])
        return coefficients, {name: self.shape_gains.get(name, 1.0) * weight for name, weight in weights.items()}

    def motion(self, options: SampleMotionOptions) -> Motion:
        """Frames of it."""
        from facepipe.neural.motion import evaluated, plan

        values, blocks = plan(self.controls, options)
        return evaluated(self.parts, "teacher", self.controls, values, blocks, self)


def person(base: Teacher, data: Path, targets: Mapping[str, float], seed: int) -> Teacher:
    """The rig on another identity, who moves each shape 0.5 to 1.5 and each pose unit 0.6 to 1.4 times as far."""
    random = np.random.default_rng(seed)
    other = teacher(data, base.gain, targets)
    names = sorted(other.parts.shapes)
    return replace(
        other,
        turns=base.turns * random.uniform(0.6, 1.4, (len(base.turns), 1, 1)),
        shape_gains=dict(zip(names, random.uniform(0.5, 1.5, len(names)).tolist(), strict=True)),
    )


def teacher(data: Path, gain: float = GAIN, targets: Mapping[str, float] | None = None) -> Teacher:
    """The rig on the head with some targets applied.

    :raises InputError: the MakeHuman head is not there
    """
    from facepipe.importers.makehuman import Options, read
    from facepipe.rig import rest_coefficients
    from facepipe.rig.bone_coefficients import matrix_coefficients
    from facepipe.rig.trs import compose

    parts = read(data / HEAD, Options(shapes=f"{EXPRESSIONS},{SCULPTS.replace(' ', '')}", targets=targets or {})).parts
    posed = [animation for animation in parts.animations if animation.name != "Rest"]
    local = np.stack([compose(one.translations[0], one.rotations[0], one.scales[0]) for one in posed])
    turns = matrix_coefficients(np.linalg.solve(parts.skeleton.rest_transforms, local))
    sculpts = {sculpt for *_, sculpt in (*PAIRS, *TURNS)}
    shapes = parts.shapes
    expressions = [name for name in shapes if name not in sculpts]
    names = (*(one.name for one in posed), *expressions)
    return Teacher(
        parts=replace(parts, animations=()),
        names=names,
        turns=turns - rest_coefficients(len(parts.skeleton.joints)),
        gain=gain,
    )
