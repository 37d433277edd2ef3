"""Fits of one face to its targets: many poses at a time, clips frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FitError, InputError
from facepipe.core.names import unique_identifiers
from facepipe.processors.fit_bones.limits import LimitRules
from facepipe.processors.fit_bones.options import FitBonesOptions
from facepipe.processors.fit_bones.report import FitBonesReport
from facepipe.processors.fit_bones.rig_checks import check_rig, rest_shear
from facepipe.processors.fit_bones.sessions import Session, Sessions
from facepipe.processors.fit_bones.target_checks import check_targets
from facepipe.processors.fit_bones.target_results import FoundTarget, Frames, TargetResults
from facepipe.processors.fit_bones.targets import Target
from facepipe.rig import Rig, rest_coefficients
from facepipe.stage import Face

_TOGETHER = 32  # poses at a time: more gain little, and the next report of progress waits for them
_SHOWN = 4  # names of a list


class TargetFits:
    """The face, its limits and weights, and sessions over it."""

    def __init__(
        self,
        face: Face,
        targets: Sequence[Target],
        options: FitBonesOptions,
        *,
        limits: LimitRules,
        weights: FloatArray,
        initial: FloatArray | None,
    ) -> None:
        self.options, self.parts, self.rig, self.targets = options, face.parts(), face.rig(), targets
        check_rig(face.where, self.parts, self.rig)
        lower, upper = limits.resolve(self.rig.joints, face.meters_per_unit, self.parts.bone_limits)
        start = np.clip(_initial(initial, self.rig), lower, upper)
        rest = self.rig.evaluate()
        check_targets(targets, rest, weights)
        taken = [one.name for one in self.parts.animations]
        self.names = unique_identifiers([*taken, *(target.name for target in targets)])[len(taken) :]
        own = {"lower": lower, "upper": upper, "weights": weights, "initial": start}
        self._sessions = Sessions(self.rig, options, **own, mm=face.mm_per_unit)
        self._session = self._sessions.of(None)
        self._results = TargetResults(self.parts, self.rig, options, rest, face.shapes, face.mm_per_unit)

    def fit_all(self, done: Callable[[], object]) -> list[FoundTarget]:
        """All targets, in their order.

        :param done: called after every frame
        :raises FitError: limits that let a joint shrink to nothing, and a fit that did
        """
        return [
            self._results.found(self._sessions.of(target.known), target, name, frames)
            for target, name, frames in zip(self.targets, self.names, self._frames(done), strict=True)
        ]

    def _frames(self, done: Callable[[], object]) -> Iterator[Frames]:
        """The frames of each target."""
        ahead: dict[int, tuple[FloatArray, int]] = {}
        for number, target in enumerate(self.targets):
            if len(target.points) > 1:
                yield self._clip(number, done)
                continue
            if number not in ahead:
                ahead |= self._together(number)
            coefficients, steps = ahead.pop(number)
            yield self._results.frames(self._sessions.of(target.known), target, coefficients[None], steps)
            done()

    def _together(self, first: int) -> dict[int, tuple[FloatArray, int]]:
        """Number -> coefficients (m, 9) and steps of a pose and those after it that share its session."""
        session, numbers = self._sessions.of(self.targets[first].known), []
        for number in range(first, len(self.targets)):
            target = self.targets[number]
            if len(target.points) == 1 and self._sessions.of(target.known) is session:
                numbers.append(number)
            if len(numbers) == _TOGETHER:
                break
        try:
            fits = session.fit.fit_all([self.targets[number].points[0] for number in numbers], session.start)
        except np.linalg.LinAlgError:
            return {number: self._one(session, number, 0, session.start) for number in numbers}
        return {number: (one.coefficients, one.steps) for number, one in zip(numbers, fits, strict=True)}

    def _clip(self, number: int, done: Callable[[], object]) -> Frames:
        """The frames of a clip, each from the one before."""
        target, frames, steps = self.targets[number], [], 0
        session = self._sessions.of(target.known)
        start = session.start
        for frame in range(len(target.points)):
            start, taken = self._one(session, number, frame, start)
            frames.append(start)
            steps += taken
            done()
        return self._results.frames(session, target, np.stack(frames), steps)

    def _one(self, session: Session, number: int, frame: int, start: FloatArray) -> tuple[FloatArray, int]:
        try:
            fitted = session.fit.fit(self.targets[number].points[frame], start)
        except np.linalg.LinAlgError:
            what = "the scale of a joint fell to 0, expected limits that keep it away from there"
            raise FitError(f"{self.rig.name} -> {self.names[number]}", what) from None
        return fitted.coefficients, fitted.steps

    def report(self, found: Sequence[FoundTarget]) -> FitBonesReport:
        """The report of all targets."""
        joints, session = self.rig.joints, self._session.fit
        own = (*rest_shear(self.rig), *_single(session.symmetry.single if session.symmetry else ()))
        return FitBonesReport(
            threshold_mm=self.options.threshold_mm,
            points=len(self.rig.points),
            joints=len(joints),
            free=len(session.free),
            weightless=tuple(joints[i] for i in np.flatnonzero(session.weightless)),
            targets={one.animation.name: one.report for one in found},
            warnings=(*own, *dict.fromkeys(line for one in found for line in one.warnings)),
        )


def _single(joints: Sequence[str]) -> list[str]:
    """A warning of joints that have no partner in a symmetric fit."""
    if not joints:
        return []
    names = ", ".join(joint.rpartition("/")[2] for joint in joints[:_SHOWN]) + (" ..." if len(joints) > _SHOWN else "")
    if len(joints) == 1:
        return [f"1 joint of one side has no partner and moves as it likes: {names}"]
    return [f"{len(joints)} joints of one side have no partner and move as they like: {names}"]


def _initial(given: FloatArray | None, rig: Rig) -> FloatArray:
    rest = rest_coefficients(len(rig.joints))
    if given is None:
        return rest
    initial = np.asarray(given, dtype=np.float64)
    if initial.shape != rest.shape or not np.isfinite(initial).all():
        raise InputError("initial", f"coefficients {initial.shape}, expected {rest.shape} finite numbers")
    return initial
