"""Calm poses of few bones that come near to shapes: free, symmetric, or as the mirror image of the other side's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FitError, InputError
from facepipe.processors.fit_bones.bone_fit import BoneFit
from facepipe.processors.fit_bones.options import STRICTER
from facepipe.processors.sliders.effects import channel_effects
from facepipe.processors.sliders.mirrored import MirroredJoints
from facepipe.processors.sliders.shape_options import ShapeSliderOptions
from facepipe.rig import CHANNELS, Rig, rest_coefficients

_TOGETHER = 32  # poses at a time
_SAME = 0.02  # of the reach: what a symmetric pose may lose


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
        self._check_rest()
        self.mirror, self.warnings = self._mirror()
        self._symmetric = self._side = None
        if self.mirror is not None:
            within = self.mirror.limits(lower, upper)
            self._symmetric, self._side = self._session(*within, symmetric=True), self._session(*within)
        self._effects = channel_effects(rig)

    def middle(self, targets: Sequence[FloatArray], done: Callable[[], object]) -> list[ShapePose]:
        """Poses for (n, 3) points each: symmetric where that comes as near."""
        free = self._together(self._free, targets)
        both = [] if self._symmetric is None else self._together(self._symmetric, targets)
        chosen = [self._as_near(*pair) for pair in zip(targets, free, both, strict=True)] if both else free
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

    def _as_near(self, target: FloatArray, free: _Found, symmetric: _Found) -> _Found:
        loss = self.reach(free.points, target) - self.reach(symmetric.points, target)
        return symmetric if loss <= _SAME else free

    def _finished(self, target: FloatArray, found: _Found, done: Callable[[], object]) -> ShapePose:
        """The pose with the channels alone that do something, as float32."""
        if self.options.least_effect > 0:
            found = self._fewer(target, found)
        gains = self._gains(found.coefficients)
        done()
        return ShapePose(gains, self.rig.evaluate(coefficients=self.rest + gains), found.symmetric)

    def _fewer(self, target: FloatArray, found: _Found) -> _Found:
        """The pose of those channels that move points, fitted again."""
        largest = float(np.linalg.norm(found.points - self.points, axis=1).max(initial=0.0))
        moved = np.abs(found.coefficients - self.rest) * self._effects
        kept = (moved > 0) & (moved >= max(self.options.least_effect * largest, self._threshold))
        if found.symmetric and self.mirror is not None:
            kept = self.mirror.tied(kept)
        if not kept.any() or kept.all():
            return found if kept.any() else _Found(self.rest, self.points, found.symmetric)
        own = self._symmetric if found.symmetric else self._free
        assert own is not None
        within = np.where(kept, own.lower, self.rest), np.where(kept, own.upper, self.rest)
        session = self._session(*within, symmetric=found.symmetric)
        (fewer,) = self._together(session, [target], np.where(kept, found.coefficients, self.rest))
        return fewer

    def _gains(self, coefficients: FloatArray) -> FloatArray:
        """Less rest, as float32 numbers, which leave no limit by their rounding."""
        gains = (coefficients - self.rest).astype(np.float32)
        beyond = self.rest + gains.astype(np.float64)
        over = (beyond > self.upper) | (beyond < self.lower)
        gains[over] = np.nextafter(gains[over], np.float32(0.0))
        return gains.astype(np.float64)

    def _together(
        self, session: BoneFit, targets: Sequence[FloatArray], start: FloatArray | None = None
    ) -> list[_Found]:
        found = []
        for first in range(0, len(targets), _TOGETHER):
            try:
                found += session.fit_all(targets[first : first + _TOGETHER], start)
            except np.linalg.LinAlgError:
                what = "the scale of a joint fell to 0, expected limits that keep it away from there"
                raise FitError(self.rig.name, what) from None
        return [_Found(one.coefficients, one.points, session.symmetry is not None) for one in found]

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

    def _check_rest(self) -> None:
        out = (self.lower > self.rest) | (self.upper < self.rest)
        if out.any():
            joint, channel = np.argwhere(out)[0]
            where = f"limits -> {self.rig.joints[joint]} -> {CHANNELS[channel]}"
            raise InputError(where, f"without {self.rest[joint, channel]:g}, expected rest inside: sliders start there")

    def _mirror(self) -> tuple[MirroredJoints | None, tuple[str, ...]]:
        """How joints mirror; None, and a warning, where they don't."""
        try:
            symmetry = self._session(self.lower, self.upper, symmetric=True).symmetry
        except InputError as error:
            return None, (f"each side is fitted alone: {error}",)
        assert symmetry is not None
        return MirroredJoints(symmetry), ()
