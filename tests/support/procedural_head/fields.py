"""Soft masks over the head's points that shapes and skin weights are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from procedural_head import layout, mouth, topology
from procedural_head.identity import Identity
from procedural_head.layout import smoothstep

_TAIL = 0.004  # cut off Gaussians, so that shapes stay sparse
HINGE = np.array([0.0, -2.2, 0.6])  # axis of the jaw


@dataclass(frozen=True)
class Fields:
    """Masks (n,) over the head, 0..1."""

    points: FloatArray  # (n, 3) the neutral head
    lips: mouth.Lips
    jaw: FloatArray  # how far a point follows the lower jaw
    upper: FloatArray  # 1 above the lips' slit, 0 below, blending at the corners and in the cheeks
    lip: FloatArray  # 1 on the lips and their inner side, falling to 0 at the patch's outline and in the bag
    skin: FloatArray  # 1 on the outside, 0 inside the mouth bag
    follow: FloatArray  # 1 where the mouth's motion reaches: the outside and the front of the bag, falling behind it

    def spot(self, center: tuple[float, float], radii: tuple[float, float]) -> FloatArray:
        """A Gaussian in the frontal plane around a centre on the subject's left, on the front of the head."""
        x, y, z = self.points.T
        squared = ((x - center[0]) / radii[0]) ** 2 + ((y - center[1]) / radii[1]) ** 2
        inside = np.maximum(np.exp(-squared) - _TAIL, 0.0) / (1 - _TAIL)
        return np.asarray(inside * smoothstep(0.0, 3.0, z))


def build(points: FloatArray, who: Identity) -> Fields:
    """The masks of a head."""
    labels = layout.build()
    shape = mouth.lips(who)
    ring = labels.ring["mouth"]
    inside = ring > mouth.CONTACT + 1
    upper = smoothstep(-0.9, 0.9, points[:, 1] - shape.line(points[:, 0]))
    patch = labels.upper["mouth"]
    share = np.interp(ring, [0, mouth.OUTLINE - 1], [0.0, 1.0])
    upper = np.where(ring >= 0, upper + share * (np.nan_to_num(patch) - upper), upper)
    lip = np.interp(ring, [0, mouth.OUTLINE, mouth.RINGS - 3, mouth.RINGS - 1], [0.0, 1.0, 1.0, 0.0], left=0.0)
    lip = np.where(ring >= 0, smoothstep(0.0, 1.0, lip), 0.0)
    skin = np.where(inside, 0.0, 1.0)
    follow = np.interp(ring, [mouth.RINGS - 2, mouth.RINGS], [1.0, 0.2])
    for side in ("Left", "Right"):
        skin = np.where(labels.ring["nostril" + side] >= 2, 0.5, skin)
    return Fields(points=points, lips=shape, jaw=_jaw(), upper=upper, lip=lip, skin=skin, follow=follow)


def _jaw() -> FloatArray:
    """Harmonic between what the lower jaw carries (1) and what the skull carries (0); it can't pass the lips' slit."""
    from scipy.sparse import eye_array
    from scipy.sparse.linalg import spsolve

    top, labels = topology.build(), layout.build()
    fixed, value = _jaw_bounds(labels)
    system = (eye_array(top.point_count) - top.averaging()).tocsr()
    free = ~fixed
    right = -(system[free][:, fixed] @ value[fixed])
    solved = value.copy()
    solved[free] = spsolve(system[free][:, free].tocsc(), right)
    solved = (solved + solved[top.mirror]) / 2
    return np.asarray(smoothstep(0.0, 1.0, solved) * 0.5 + np.clip(solved, 0, 1) * 0.5)


def _jaw_bounds(labels: layout.Layout) -> tuple[BoolArray, FloatArray]:
    """(n,) bool where the jaw's share is known, and (n,) that share."""
    level = topology.row_levels()[labels.row]
    column = np.abs(labels.column)
    ring, across = labels.ring["mouth"], labels.across["mouth"]
    patch = ring >= 1
    middle = (across > layout.CORNER) & (across < 1 - layout.CORNER)
    lip_side = patch & middle & (ring < mouth.RINGS - 1)
    above = (lip_side & (labels.upper["mouth"] > 0.5)) | (~patch & ((level <= 9.03) | (column >= 29) | (level >= 16.6)))
    for side in ("Left", "Right"):
        above |= (
            (labels.ring["ear" + side] >= 0) | (labels.ring["eye" + side] >= 0) | (labels.ring["nostril" + side] >= 0)
        )
    below = lip_side & (labels.upper["mouth"] < 0.5)
    chin = ~patch & (level > 11.1) & (level < 13.05) & (column <= 13)
    edge = ~patch & (level > 12.3) & (level < 12.8) & (column > 13) & (column < 25)
    # The lower lip follows less towards its corners, so that an open mouth is an oval.
    rounded = 0.45 + 0.55 * smoothstep(0.0, 0.4, np.nan_to_num(np.minimum(across, 1 - across)))
    value = np.where(below, rounded, np.where(chin, 1.0, 0.0))
    value = np.where(edge, 0.9 * smoothstep(29.0, 13.0, column.astype(np.float64)), value)
    return above | below | chin | edge, value
