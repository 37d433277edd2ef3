"""How far expressions on top of a person put into the rest of a face are from those on the face with the person on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.parts import FaceParts
from facepipe.rig.bone_coefficients import coefficient_matrices, rest_coefficients
from facepipe.rig.rig import Rig, Target
from facepipe.rig.sliders import slide

Changes = list[tuple[int, float]]  # targets, and how much more of each is on
Poses = list[tuple[dict[str, float], FloatArray]]  # shape weights and bone coefficients (j, 9)

RANDOM_POSES = 50
_SETTINGS = 10  # of the sliders, all moved at once, which takes longest: fifty are off by 1.07 times as much at most
_POSE_TURN = 0.2  # radians
_POSE_MOVE_MM = 1.0
_SHAPES_A_POSE = 3  # on in each pose
_POSE_SEED = 0
_ROUNDED = 12  # decimals of activations
_ROWS = 2048  # points that are turned at once


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

    :param stretch: (j, 3, 3) of translations of coefficients for `after`
    :param parts: that `before` was built of
    :param result: that `after` was built of
    """
    poses = random_poses(before.rig, parts)
    sides, alike = (before, after), SameMotion.of(before, after, stretch)
    if alike is None:
        largest = apart(sides, stretch, poses)
        with_sliders = None
    else:
        largest, with_sliders = alike.apart(poses), alike.apart_with_sliders(parts, result)
    if with_sliders is None:
        with_sliders = apart_with_sliders(before.rig, after.rig, parts, result)
    millimetres = 1000 * parts.meters_per_unit
    largest *= millimetres
    return SetError(
        mean_mm=float(largest.mean()) if len(largest) else 0.0,
        max_mm=float(largest.max(initial=0.0)),
        shapes=len(before.rig.shapes),
        poses=len(poses),
        sliders_max_mm=millimetres * with_sliders,
    )


def apart(sides: tuple[Side, Side], stretch: FloatArray, poses: Poses) -> FloatArray:
    """(n,) the farthest that points are apart, over shapes and poses.

    Where joints stay as they are points are linear in what moves them: a shape is looked at where it moves points, on
    top of the person that both have on already. Evaluating all of both faces for each took seven times as long.
    """
    before, whole = sides[0], slice(None)
    largest = np.linalg.norm(np.subtract(*(side.at_rest(side.points, whole) for side in sides)), axis=1)
    for name in before.rig.shapes:
        changes = [side.changes({name: 1.0}) for side in sides]
        moved = [side.moved_by(own) for side, own in zip(sides, changes, strict=True)]
        rows = np.flatnonzero(np.any(moved, axis=0))
        off = np.subtract(*(side.at_rest(side.morphed(own), rows) for side, own in zip(sides, changes, strict=True)))
        largest[rows] = np.maximum(largest[rows], np.linalg.norm(off, axis=1))
    for weights, expression in poses:
        # new joints lack the person's scales, which stretched an expression's translations
        change = coefficient_matrices(expression)
        stretched = change.copy()
        stretched[:, :3, 3] = np.einsum("jab,jb->ja", stretch, change[:, :3, 3])
        posed = [
            side.rig.skin(side.morphed(side.changes(weights)), side.matrices(own))
            for side, own in zip(sides, (change, stretched), strict=True)
        ]
        np.maximum(largest, np.linalg.norm(np.subtract(*posed), axis=1), out=largest)
    return np.asarray(largest)


@dataclass(frozen=True)
class SameMotion:
    """Two faces whose joints and offsets are the same, as with a person of shapes alone: they differ by what points
    differ in at rest, and shapes add nothing but where their curves bend. What differs is turned by all poses in one
    product: evaluating both faces took ten times as long.
    """

    before: Side
    after: Side

    @classmethod
    def of(cls, before: Side, after: Side, stretch: FloatArray) -> SameMotion | None:
        """None: their joints or offsets differ."""
        one, other = before.rig, after.rig
        pairs = (
            (before.local, after.local),
            (one.inverse_bind, other.inverse_bind),
            (one.parent_world, other.parent_world),
            (one.skinning.starts, other.skinning.starts),
            (one.skinning.columns, other.skinning.columns),
            (one.skinning.values, other.skinning.values),
            (stretch, np.broadcast_to(np.eye(3), stretch.shape)),
        )
        same = one.dual is None and other.dual is None and all(np.array_equal(*pair) for pair in pairs)
        same = same and len(one.targets) == len(other.targets) and all(map(_same_target, one.targets, other.targets))
        return cls(before, after) if same else None

    def apart(self, poses: Poses) -> FloatArray:
        """(n,) the farthest that points are apart, over shapes and poses."""
        rig, sides = self.before.rig, (self.before, self.after)
        alone = np.vstack([np.zeros((1, len(rig.shapes))), np.eye(len(rig.shapes))])
        mixed = np.array([rig.weight_vector(weights) for weights, _ in poses]).reshape(-1, len(rig.shapes))
        on = [side.rig.activations(side.person + weights) for side in sides for weights in (alone, mixed)]
        rests = np.unique(self._differing(on[0], on[2]), axis=0)
        turned = self.before.local @ coefficient_matrices(np.array([expression for _, expression in poses]))
        at_rest = np.broadcast_to(self.before.local, (len(rests), *self.before.local.shape))
        return self._farthest(np.concatenate([at_rest, turned]), np.vstack([rests, self._differing(on[1], on[3])]))

    def apart_with_sliders(self, parts: FaceParts, result: FaceParts) -> float | None:
        """Over random settings of the sliders; None where they move joints otherwise."""
        settings = _settings(parts)
        if not settings:
            return 0.0
        slid = [
            [slide(face.sliders, side.rig.joints, values, face.slider_network) for values in settings]
            for side, face in ((self.before, parts), (self.after, result))
        ]
        coefficients, theirs = (np.array([own for own, _ in one]) for one in slid)
        if not np.array_equal(coefficients, theirs):
            return None
        rig = self.before.rig
        on = [rig.activations(np.array([rig.weight_vector(weights) for _, weights in one])) for one in slid]
        return float(self._farthest(rig.rest @ coefficient_matrices(coefficients), self._differing(*on)).max())

    def _differing(self, before: FloatArray, after: FloatArray) -> FloatArray:
        """How much more of the targets (p, t) is on after, without what rounding makes."""
        return np.asarray(np.round(after - before, _ROUNDED))

    def _farthest(self, locals_: FloatArray, more: FloatArray) -> FloatArray:
        """(n,) the farthest that points are apart, over local transforms (p, j, 4, 4) and what more is on (p, t)."""
        rig, between = self.before.rig, self.after.rig.points - self.before.rig.points
        farthest, matrices = np.zeros(len(between)), rig.skinning_matrices(locals_)[..., :3, :3]
        distinct, group = np.unique(more, axis=0, return_inverse=True)
        for number, on in enumerate(distinct):
            offsets = between.copy()
            for target in np.flatnonzero(on):
                moved = rig.targets[target]
                offsets[moved.point_indices] += on[target] * moved.offsets
            chosen = np.moveaxis(matrices[group.ravel() == number], 0, 1)  # (j + 1, p, 3, 3)
            rows = np.flatnonzero(offsets.any(axis=1))
            for part in np.array_split(rows, len(rows) // _ROWS + 1):
                weights = rig.skinning.dense(part)
                turned = sum(  # axis by axis: (m, 3 p) in place of transforms (m, p, 3, 3)
                    (weights * offsets[part, axis, None]) @ chosen[..., axis].reshape(len(chosen), -1)
                    for axis in range(3)
                )
                lengths = np.linalg.norm(np.reshape(turned, (len(part), chosen.shape[1], 3)), axis=2)
                farthest[part] = np.maximum(farthest[part], lengths.max(axis=1, initial=0.0))
        return farthest


class Side:
    """A face with the person on, and what weights and joints on top make of it.

    :param weights: of the person
    :param matrices: (j, 4, 4) of the person, relative to rest; None: the person is the rest
    """

    def __init__(self, rig: Rig, weights: Mapping[str, float], matrices: FloatArray | None = None) -> None:
        self.rig, self.person = rig, rig.weight_vector(weights)
        self.local = rig.rest if matrices is None else rig.rest @ matrices
        self._on = rig.activations(self.person)
        self.points = rig.morph(self.person)  # (n, 3) of the person, before skinning
        self.blended = rig.blended(rig.skinning_matrices(self.local))

    def changes(self, weights: Mapping[str, float]) -> Changes:
        """What weights on top of the person turn on."""
        change = self.rig.activations(self.person + self.rig.weight_vector(weights)) - self._on
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
        return self.rig.skinning_matrices(self.local @ change)


def _same_target(one: Target, other: Target) -> bool:
    return (
        one.curve == other.curve
        and np.array_equal(one.point_indices, other.point_indices)
        and (one.offsets is other.offsets or np.array_equal(one.offsets, other.offsets))
    )


def _settings(parts: FaceParts) -> list[dict[str, float]]:
    random = np.random.default_rng(_POSE_SEED)
    return [
        {slider.name: float(random.uniform(slider.minimum, slider.maximum)) for slider in parts.sliders}
        for _ in range(_SETTINGS if parts.sliders else 0)
    ]


def apart_with_sliders(before: Rig, after: Rig, parts: FaceParts, result: FaceParts) -> float:
    """Over some random settings of the sliders the farthest that a point of one is from that of the other."""
    settings = _settings(parts)
    if not settings:
        return 0.0
    off = np.subtract(_with_sliders(before, parts, settings), _with_sliders(after, result, settings))
    return float(np.linalg.norm(off, axis=2).max(initial=0.0))


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


def random_poses(rig: Rig, parts: FaceParts) -> Poses:
    """Shape weights and bone coefficients (j, 9) of random poses: up to 0.2 radians and 1 mm within the limits."""
    random = np.random.default_rng(_POSE_SEED)
    reach = np.zeros(9)
    reach[:3], reach[3:6] = _POSE_MOVE_MM / (1000 * parts.meters_per_unit), _POSE_TURN
    rest = rest_coefficients(len(rig.joints))
    low, high = rest - reach, rest + reach
    if parts.bone_limits is not None:
        low, high = np.maximum(low, parts.bone_limits.lower), np.minimum(high, parts.bone_limits.upper)
        low, high = np.minimum(low, rest), np.maximum(high, rest)
    poses: Poses = []
    for _ in range(RANDOM_POSES):
        chosen = random.permutation(len(rig.shapes))[:_SHAPES_A_POSE]
        weights = {rig.shapes[i]: float(random.random()) for i in chosen}
        poses.append((weights, low + random.random(rest.shape) * (high - low)))
    return poses
