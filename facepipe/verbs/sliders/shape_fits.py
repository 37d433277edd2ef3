"""Calm poses of few bones that come near to shapes: free, symmetric, or as the mirror image of the other side's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import FitError, InputError
from facepipe.rig import CHANNELS, Rig, rest_coefficients
from facepipe.rig.bone_coefficients import coefficient_derivatives
from facepipe.verbs.fit_bones.bone_fit import BoneFit
from facepipe.verbs.fit_bones.options import STRICTER
from facepipe.verbs.fit_bones.skinning import Symmetry
from facepipe.verbs.sliders.options import ShapeSliderOptions
from facepipe.verbs.sliders.shape_names import ShapeSlider

_TOGETHER = 32  # poses at a time
_SAME = 0.02  # of the reach: what a symmetric pose may lose


class MirroredJoints:
    """Where the coefficients of m joints go when a pose is mirrored, and their signs there."""

    def __init__(self, symmetry: Symmetry) -> None:
        self.joints = symmetry.joints
        count = len(symmetry.leaders)
        follower = np.flatnonzero(symmetry.leaders != np.arange(count))
        leader = symmetry.leaders[follower]
        self._from, self._signs = np.arange(count), np.where(symmetry.still, -1.0, 1.0)
        self._from[follower], self._from[leader] = leader, follower
        self._signs[follower] = self._signs[leader] = symmetry.signs[follower]
        self._single = np.repeat([joint in symmetry.single for joint in symmetry.joints], 9)

    def coefficients(self, values: FloatArray) -> FloatArray:
        """(m, 9) of the mirrored pose; joints without a partner must be at rest."""
        return np.asarray((self._signs * values.ravel()[self._from]).reshape(values.shape))

    def tied(self, kept: BoolArray) -> BoolArray:
        """(m, 9) channels that are kept, or whose mirror images are."""
        return np.asarray((kept.ravel() | kept.ravel()[self._from]).reshape(kept.shape))

    def limits(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(m, 9) limits within which a pose's mirror image is too; joints without a partner rest.

        :raises InputError: limits of two sides that have nothing in common
        """
        low, high, turned = lower.ravel(), upper.ravel(), self._signs < 0
        other = (
            np.where(turned, -high[self._from], low[self._from]),
            np.where(turned, -low[self._from], high[self._from]),
        )
        rest = rest_coefficients(len(self.joints)).ravel()
        low = np.where(self._single, rest, np.maximum(low, other[0]))
        high = np.where(self._single, rest, np.minimum(high, other[1]))
        if (low > high).any():
            joint, channel = divmod(int(np.argmax(low > high)), 9)
            what = "limits whose mirror images have nothing in common with them, expected some that both sides can have"
            raise InputError(f"limits -> {self.joints[joint]} -> {CHANNELS[channel]}", what)
        return low.reshape(lower.shape), high.reshape(upper.shape)


@dataclass(frozen=True)
class ShapePose:
    """Where bones take the face for one shape."""

    gains: FloatArray  # (m, 9) float32 coefficients less rest: what a slider adds
    points: FloatArray  # (n, 3) of them
    symmetric: bool


@dataclass(frozen=True)
class _Found:
    coefficients: FloatArray
    points: FloatArray
    symmetric: bool = False


class ShapeFits:
    """Fits of one rig.

    :param lower: (m, 9) limits, with rest inside them
    :param upper: (m, 9)
    :param mm: millimetres in a stage unit
    :raises InputError: limits without rest, or what `BoneFit` refuses
    """

    def __init__(self, rig: Rig, lower: FloatArray, upper: FloatArray, options: ShapeSliderOptions, mm: float) -> None:
        self.rig, self.lower, self.upper, self.options = rig, lower, upper, options
        self.rest = rest_coefficients(len(rig.joints))
        self.points = rig.evaluate()
        self._threshold = STRICTER * options.threshold_mm / mm
        self._free = self._session(lower, upper)
        out = (self.lower > self.rest) | (self.upper < self.rest)
        if out.any():
            joint, channel = np.argwhere(out)[0]
            where = f"limits -> {self.rig.joints[joint]} -> {CHANNELS[channel]}"
            raise InputError(where, f"without {self.rest[joint, channel]:g}, expected rest inside: sliders start there")
        # how joints mirror; None, and a warning, where they don't
        self.mirror: MirroredJoints | None = None
        self.warnings: tuple[str, ...] = ()
        self._symmetric = self._side = None
        try:
            symmetry = self._session(lower, upper, symmetric=True).symmetry
        except InputError as error:
            self.warnings = (f"each side is fitted alone: {error}",)
        else:
            assert symmetry is not None
            self.mirror = MirroredJoints(symmetry)
            within = self.mirror.limits(lower, upper)
            self._symmetric, self._side = self._session(*within, symmetric=True), self._session(*within)
        self._effects = channel_effects(rig)

    def middle(self, targets: Sequence[FloatArray], done: Callable[[], object]) -> list[ShapePose]:
        """Poses for (n, 3) points each: symmetric where that comes as near."""
        free = self._together(self._free, targets)
        both = [] if self._symmetric is None else self._together(self._symmetric, targets)
        chosen = free
        if both:
            losses = [
                self.reach(own.points, target) - self.reach(tied.points, target)
                for target, own, tied in zip(targets, free, both, strict=True)
            ]
            chosen = [tied if loss <= _SAME else own for loss, own, tied in zip(losses, free, both, strict=True)]
        return [self._finished(*pair, done) for pair in zip(targets, chosen, strict=True)]

    def side(self, targets: Sequence[FloatArray], done: Callable[[], object]) -> list[ShapePose]:
        """Poses for (n, 3) points each whose mirror images the other side's joints can take too."""
        found = self._together(self._side or self._free, targets)
        return [self._finished(*pair, done) for pair in zip(targets, found, strict=True)]

    def mirrored(self, pose: ShapePose) -> ShapePose:
        """The mirror image of a pose of `side`, where joints have partners."""
        assert self.mirror is not None
        gains = self.mirror.coefficients(pose.gains)
        return ShapePose(gains, self.rig.evaluate(coefficients=self.rest + gains), pose.symmetric)

    def reach(self, points: FloatArray, target: FloatArray) -> float:
        """How much of the motion from rest to (n, 3) points another (n, 3) makes: 0 (none) to 1."""
        motion = float(np.linalg.norm(target - self.points))
        return max(0.0, 1.0 - float(np.linalg.norm(points - target)) / motion) if motion else 0.0

    def _finished(self, target: FloatArray, pose: _Found, done: Callable[[], object]) -> ShapePose:
        """The pose with the channels alone that do something, as float32."""
        if self.options.least_effect > 0:
            pose = self._fewer(target, pose)
        # less rest, as float32 numbers, which leave no limit by their rounding
        gains = (pose.coefficients - self.rest).astype(np.float32)
        beyond = self.rest + gains.astype(np.float64)
        over = (beyond > self.upper) | (beyond < self.lower)
        gains[over] = np.nextafter(gains[over], np.float32(0.0))
        gains = gains.astype(np.float64)
        done()
        return ShapePose(gains, self.rig.evaluate(coefficients=self.rest + gains), pose.symmetric)

    def _fewer(self, target: FloatArray, pose: _Found) -> _Found:
        """The pose of those channels that move points, fitted again."""
        largest = float(np.linalg.norm(pose.points - self.points, axis=1).max(initial=0.0))
        moved = np.abs(pose.coefficients - self.rest) * self._effects
        kept = (moved > 0) & (moved >= max(self.options.least_effect * largest, self._threshold))
        if pose.symmetric and self.mirror is not None:
            kept = self.mirror.tied(kept)
        if not kept.any() or kept.all():
            return pose if kept.any() else _Found(self.rest, self.points, pose.symmetric)
        own = self._symmetric if pose.symmetric else self._free
        assert own is not None
        within = np.where(kept, own.lower, self.rest), np.where(kept, own.upper, self.rest)
        session = self._session(*within, symmetric=pose.symmetric)
        (fewer,) = self._together(session, [target], np.where(kept, pose.coefficients, self.rest))
        return fewer

    def _together(
        self, session: BoneFit, targets: Sequence[FloatArray], start: FloatArray | None = None
    ) -> list[_Found]:
        poses = []
        for first in range(0, len(targets), _TOGETHER):
            try:
                poses += session.fit_all(targets[first : first + _TOGETHER], start)
            except np.linalg.LinAlgError:
                what = "the scale of a joint fell to 0, expected limits that keep it away from there"
                raise FitError(self.rig.name, what) from None
        return [_Found(pose.coefficients, pose.points, session.symmetry is not None) for pose in poses]

    def _session(self, lower: FloatArray, upper: FloatArray, *, symmetric: bool = False) -> BoneFit:
        return BoneFit(
            self.rig,
            lower=lower,
            upper=upper,
            threshold=self._threshold,
            rounds=0,
            regularise=self.options.regularise,
            symmetric=symmetric,
        )


def fit_poses(
    fits: ShapeFits,
    sliders: Sequence[ShapeSlider],
    targets: Mapping[str, FloatArray],
    done: Callable[[], object] = lambda: None,
) -> dict[str, ShapePose]:
    """Shape -> its pose; of a slider and its mirror the first is fitted, and the other is its mirror image.

    :param targets: shape -> (n, 3) points
    :param done: called after every shape
    """
    by_name = {slider.name: slider for slider in sliders}
    twins: dict[str, str] = {}  # shape of the first slider of a pair -> that of its mirror
    for slider in sliders if fits.mirror is not None else ():
        if slider.mirror is not None and slider.ends[0][1] not in twins.values():
            pairs = zip(slider.ends, by_name[slider.mirror].ends, strict=True)
            twins |= {shape: other for (_, shape), (_, other) in pairs}
    sides = [shape for shape in targets if shape in twins]
    middle = [shape for shape in targets if shape not in twins and shape not in twins.values()]
    poses = dict(zip(middle, fits.middle([targets[shape] for shape in middle], done), strict=True))
    poses |= zip(sides, fits.side([targets[shape] for shape in sides], done), strict=True)
    for shape in sides:
        # not a fit of its own: two descents end at poses that only nearly mirror each other
        poses[twins[shape]] = fits.mirrored(poses[shape])
        done()
    return poses


def channel_effects(rig: Rig) -> FloatArray:
    """(m, 9) the largest motion of a point by a unit of each coefficient, near rest.

    A joint's motion takes all points that hang at it or at joints below it, each as much as these weigh. Exact where
    the rest pose is the bind pose.
    """
    count = len(rig.joints)
    worlds = rig.joint_worlds(rig.rest)
    # dp / dc = W (dM / dc) W^-1 p, W the joint's world at rest, M = 1 there
    motions = worlds[:, None] @ coefficient_derivatives(rest_coefficients(count)) @ np.linalg.inv(worlds)[:, None]
    points = np.column_stack([rig.evaluate(), np.ones(len(rig.points))])
    weights = np.asarray(rig.influences[:, :count].todense())
    for joint in range(count - 1, -1, -1):  # children come after their parents
        if rig.parents[joint] >= 0:
            weights[:, rig.parents[joint]] += weights[:, joint]
    effects = np.zeros((count, 9))
    for joint in range(count):
        held = np.flatnonzero(np.abs(weights[:, joint]) > 0)
        moved = np.einsum("cij,nj->cni", motions[joint][:, :3], points[held])
        lengths = np.linalg.norm(moved, axis=2) * np.abs(weights[held, joint])
        effects[joint] = lengths.max(axis=1, initial=0.0)
    return effects
