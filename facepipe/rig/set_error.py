"""How far expressions on top of a person put into the rest of a face are from those on the face with the person on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.parts import FaceParts
from facepipe.rig.bone_coefficients import coefficient_matrices, rest_coefficients
from facepipe.rig.rig import Rig
from facepipe.rig.sliders import slide

Changes = list[tuple[int, float]]  # targets, and how much more of each is on

RANDOM_POSES = 50
_SETTINGS = 10  # of the sliders, all moved at once, which takes longest: fifty are off by 1.07 times as much at most
_POSE_TURN = 0.2  # radians
_POSE_MOVE_MM = 1.0
_SHAPES_A_POSE = 3  # on in each pose
_POSE_SEED = 0


@dataclass(frozen=True, kw_only=True)
class SetError:
    """Distances between points in mm, over all shapes at 1 and random poses of all joints within their limits."""

    mean_mm: float  # of the points' largest distances
    max_mm: float
    shapes: int
    poses: int
    sliders_max_mm: float  # over random settings of the sliders, within their ranges; 0 without sliders


def set_error(before: Side, after: Side, stretch: FloatArray, parts: FaceParts, result: FaceParts) -> SetError:
    """Compare both, each shape at 1 and each pose of joints and shapes on top of the person.

    Where joints stay as they are points are linear in what moves them: a shape is looked at where it moves points, on
    top of the person that both have on already. Evaluating all of both faces for each took seven times as long.

    :param stretch: (j, 3, 3) of translations of coefficients for `after`
    :param parts: that `before` was built of
    :param result: that `after` was built of
    """
    sides, whole = (before, after), slice(None)
    largest = np.linalg.norm(np.subtract(*(side.at_rest(side.points, whole) for side in sides)), axis=1)
    alike = np.array_equal(before.blended, after.blended)
    for name in before.rig.shapes:
        changes = [side.changes({name: 1.0}) for side in sides]
        if alike and _same_targets(sides, changes):
            continue  # as far apart as without the shape
        moved = [side.moved_by(own) for side, own in zip(sides, changes, strict=True)]
        rows = np.flatnonzero(np.any(moved, axis=0))
        apart = np.subtract(*(side.at_rest(side.morphed(own), rows) for side, own in zip(sides, changes, strict=True)))
        largest[rows] = np.maximum(largest[rows], np.linalg.norm(apart, axis=1))
    poses = random_poses(before.rig, parts)
    for weights, expression in poses:
        # new joints lack the person's scales, which stretched an expression's translations
        change = coefficient_matrices(expression)
        stretched = change.copy()
        stretched[:, :3, 3] = np.einsum("jab,jb->ja", stretch, change[:, :3, 3])
        morphed = [side.morphed(side.changes(weights)) for side in sides]
        matrices = [side.matrices(own) for side, own in zip(sides, (change, stretched), strict=True)]
        if alike and np.array_equal(matrices[0], matrices[1]):
            blended = before.rig.blended(matrices[0])
            apart = np.einsum("nij,nj->ni", blended[:, :, :3], morphed[1] - morphed[0])
        else:
            posed = zip(sides, morphed, matrices, strict=True)
            apart = np.subtract(*(side.rig.skin(points, own) for side, points, own in posed))
        np.maximum(largest, np.linalg.norm(apart, axis=1), out=largest)
    largest *= 1000 * parts.meters_per_unit
    return SetError(
        mean_mm=float(largest.mean()) if len(largest) else 0.0,
        max_mm=float(largest.max(initial=0.0)),
        shapes=len(before.rig.shapes),
        poses=len(poses),
        sliders_max_mm=1000 * parts.meters_per_unit * _apart_with_sliders(before.rig, after.rig, parts, result),
    )


class Side:
    """A face with the person on, and what weights and joints on top make of it.

    :param weights: of the person
    :param matrices: (j, 4, 4) of the person, relative to rest; None: the person is the rest
    """

    def __init__(self, rig: Rig, weights: Mapping[str, float], matrices: FloatArray | None = None) -> None:
        self.rig, self._person = rig, rig.weight_vector(weights)
        self._local = rig.rest if matrices is None else rig.rest @ matrices
        self._on = rig.activations(self._person)
        self.points = rig.morph(self._person)  # (n, 3) of the person, before skinning
        self.blended = rig.blended(rig.skinning_matrices(self._local))

    def changes(self, weights: Mapping[str, float]) -> Changes:
        """What weights on top of the person turn on."""
        change = self.rig.activations(self._person + self.rig.weight_vector(weights)) - self._on
        return [(int(number), float(change[number])) for number in np.flatnonzero(change)]

    def moved_by(self, changes: Changes) -> BoolArray:
        """(n,) points that they move."""
        moved = np.zeros(len(self.points), bool)
        for number, _ in changes:
            moved[self.rig.targets[number].point_indices] = True
        return moved

    def morphed(self, changes: Changes) -> FloatArray:
        """(n, 3) points with them on top of the person, before skinning."""
        points = self.points.copy()
        for number, change in changes:
            target = self.rig.targets[number]
            points[target.point_indices] += change * target.offsets
        return points

    def at_rest(self, points: FloatArray, rows: IntArray | slice) -> FloatArray:
        """(m, 3) places of some of the points (n, 3), joints as the person has them."""
        blended = self.blended[rows]
        return np.asarray(np.einsum("nij,nj->ni", blended[:, :, :3], points[rows]) + blended[:, :, 3])

    def matrices(self, change: FloatArray) -> FloatArray:
        """(j + 1, 4, 4) skinning matrices with those (j, 4, 4) of an expression on top of the person's."""
        return self.rig.skinning_matrices(self._local @ change)


def _same_targets(sides: tuple[Side, Side], changes: Sequence[Changes]) -> bool:
    """Whether both sides' changes move the same points by the same offsets."""
    targets = [[side.rig.targets[number] for number, _ in own] for side, own in zip(sides, changes, strict=True)]
    return [much for _, much in changes[0]] == [much for _, much in changes[1]] and all(
        np.array_equal(one.point_indices, other.point_indices) and np.array_equal(one.offsets, other.offsets)
        for one, other in zip(*targets, strict=True)
    )


def _apart_with_sliders(before: Rig, after: Rig, parts: FaceParts, result: FaceParts) -> float:
    """Over some random settings of the sliders the farthest that a point of one is from that of the other."""
    random = np.random.default_rng(_POSE_SEED)
    settings = [
        {slider.name: float(random.uniform(slider.minimum, slider.maximum)) for slider in parts.sliders}
        for _ in range(_SETTINGS if parts.sliders else 0)
    ]
    if not settings:
        return 0.0
    apart = np.subtract(_with_sliders(before, parts, settings), _with_sliders(after, result, settings))
    return float(np.linalg.norm(apart, axis=2).max(initial=0.0))


def _with_sliders(rig: Rig, parts: FaceParts, settings: Sequence[Mapping[str, float]]) -> FloatArray:
    """(s, n, 3) places of the points with settings of the sliders.

    All settings are morphed by one product, which takes half as long as one after the other.
    """
    slid = [slide(parts.sliders, rig.joints, values, parts.slider_network) for values in settings]
    on = np.column_stack([rig.activations(rig.weight_vector(weights)) for _, weights in slid])
    moved = (rig.delta_columns @ on).T.reshape(len(slid), -1, 3)
    locals_ = (rig.local_transforms(coefficients) for coefficients, _ in slid)
    places = [
        rig.skin(rig.points + own, rig.skinning_matrices(local)) for own, local in zip(moved, locals_, strict=True)
    ]
    return np.stack(places)


def random_poses(rig: Rig, parts: FaceParts) -> list[tuple[dict[str, float], FloatArray]]:
    """Shape weights and bone coefficients (j, 9) of random poses: up to 0.2 radians and 1 mm within the limits."""
    random = np.random.default_rng(_POSE_SEED)
    reach = np.zeros(9)
    reach[:3], reach[3:6] = _POSE_MOVE_MM / (1000 * parts.meters_per_unit), _POSE_TURN
    rest = rest_coefficients(len(rig.joints))
    low, high = rest - reach, rest + reach
    if parts.bone_limits is not None:
        low, high = np.maximum(low, parts.bone_limits.lower), np.minimum(high, parts.bone_limits.upper)
        low, high = np.minimum(low, rest), np.maximum(high, rest)
    poses: list[tuple[dict[str, float], FloatArray]] = []
    for _ in range(RANDOM_POSES):
        chosen = random.permutation(len(rig.shapes))[:_SHAPES_A_POSE]
        weights = {rig.shapes[i]: float(random.random()) for i in chosen}
        poses.append((weights, low + random.random(rest.shape) * (high - low)))
    return poses
