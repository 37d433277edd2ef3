"""Fits of one face to its targets, frame by frame, with what they leave."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.errors import FitError, InputError
from facepipe.names import unique_identifiers
from facepipe.parts import Animation, Blendshape, FloatArray, all_regions
from facepipe.processors.fit_bones.half_scales import with_half_scales
from facepipe.processors.fit_bones.limits import LimitRules
from facepipe.processors.fit_bones.options import FitBonesOptions
from facepipe.processors.fit_bones.report import (
    FitBonesReport,
    ResidualReport,
    TargetReport,
    at_limits,
    by_region,
    distances,
)
from facepipe.processors.fit_bones.residual import Residual, corrective
from facepipe.processors.fit_bones.rig_checks import check_rig, local_shear, rest_shear
from facepipe.processors.fit_bones.session import BoneFit
from facepipe.processors.fit_bones.target_checks import check_targets, size_warning
from facepipe.processors.fit_bones.targets import Target
from facepipe.rig import Rig, rest_coefficients
from facepipe.stage import Face

_STRICTER = 0.99  # of the threshold: what solves stop at leaves room for the rounding of what is authored


@dataclass(frozen=True, kw_only=True)
class FoundTarget:
    """What one target gave."""

    animation: Animation
    shapes: tuple[tuple[Blendshape | None, ...], ...]  # residual shapes, each a blendshape or None per mesh
    report: TargetReport
    warnings: tuple[str, ...]


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
        self.options, self.parts, self.rig = options, face.parts(), face.rig()
        self.mm = face.mm_per_unit
        check_rig(face.where, self.parts, self.rig)
        self.lower, self.upper = limits.resolve(self.rig.joints, face.meters_per_unit, self.parts.bone_limits)
        self.weights = weights
        self.initial = np.clip(_initial(initial, self.rig), self.lower, self.upper)
        self.rest = self.rig.evaluate()
        check_targets(targets, self.rest, weights)
        taken = [one.name for one in self.parts.animations]
        self.names = unique_identifiers([*taken, *(target.name for target in targets)])[len(taken) :]
        self.shape_names = list(face.shapes)
        self._sessions: dict[bytes, BoneFit] = {}
        self.session = self._session(None)

    def _session(self, known: npt.NDArray[np.bool_] | None) -> BoneFit:
        """A session whose points count where a target knows them."""
        key = b"" if known is None else np.packbits(known).tobytes()
        if key not in self._sessions:
            weights = self.weights if known is None else self.weights * known
            self._sessions[key] = BoneFit(
                self.rig,
                lower=self.lower,
                upper=self.upper,
                weights=weights,
                threshold=_STRICTER * self.options.threshold_mm / self.mm,
                steps=self.options.max_iterations,
                rounds=self.options.evening,
                regularise=self.options.regularise,
                sparsity=self.options.sparsity,
            )
        return self._sessions[key]

    def fit(self, target: Target, name: str, done: Callable[[], object]) -> FoundTarget:
        """All frames of a target, each from the one before."""
        session = self._session(target.known)
        start, steps, frames = self.initial, 0, []
        for goal in target.points:
            try:
                fitted = session.fit(goal, start)
            except np.linalg.LinAlgError:
                what = "the scale of a joint fell to 0, expected limits that keep it away from there"
                raise FitError(f"{self.rig.name} -> {name}", what) from None
            start, steps = fitted.coefficients, steps + fitted.steps
            frames.append(start.astype(np.float32).astype(np.float64))  # as it is authored
            done()
        return self._found(session, target, name, np.stack(frames), steps)

    def _found(self, session: BoneFit, target: Target, name: str, coefficients: FloatArray, steps: int) -> FoundTarget:
        counts, limited = session.weights > 0, coefficients
        posed, off = self._posed(target, coefficients)
        missed = np.flatnonzero(off[:, counts].max(axis=1) > self.options.threshold_mm)
        if self.options.residual and len(missed):  # what a residual is added to is what SkelAnimation holds
            coefficients = coefficients.copy()
            for frame in missed:
                coefficients[frame] = with_half_scales(self.rig, coefficients[frame], self.lower, self.upper)
            posed, off = self._posed(target, coefficients)
        corrected = (off > _STRICTER * self.options.threshold_mm) & counts
        corrected[np.setdiff1d(np.arange(len(off)), missed)] = False
        residuals = self._residuals(target, name, coefficients, corrected)
        shapes, weights = _tracks(residuals)
        end = self._off(np.stack([p if r is None else r.points for p, r in zip(posed, residuals, strict=True)]), target)
        known = np.ones(len(counts), bool) if target.known is None else target.known
        report = TargetReport(
            animation=name,
            frames=len(coefficients),
            before=distances(self._off(self.rig.evaluate(coefficients=self.initial)[None], target)[:, counts]),
            distances=distances(off[:, counts]),
            regions=by_region(off, all_regions(self.parts.meshes), known),
            reached=bool((end[:, counts] <= self.options.threshold_mm).all()),
            steps=steps,
            at_limits=at_limits(limited, self.lower, self.upper, self.rig.joints, session.free),
            residual=_residual_report(shapes, end[:, counts]) if self.options.residual else None,
        )
        animation = Animation(
            name=name,
            times=target.times,
            joints=self.rig.joints,
            coefficients=coefficients,
            shapes=tuple(_name(own) for own in shapes),
            shape_weights=weights if shapes else None,
        )
        return FoundTarget(
            animation=animation,
            shapes=shapes,
            report=report,
            warnings=(
                *target.notes,
                *size_warning(target, name, self.rest, self.weights),
                *self._warnings(name, report, residuals, coefficients),
            ),
        )

    def _posed(self, target: Target, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (T, n, 3), and how far off they are (T, n), in millimetres."""
        posed = np.stack([self.rig.evaluate(coefficients=one) for one in coefficients])
        return posed, self._off(posed, target)

    def _off(self, points: FloatArray, target: Target) -> FloatArray:
        """(T, n) distances in millimetres."""
        return np.asarray(np.linalg.norm(points - target.points, axis=2) * self.mm)

    def _residuals(
        self, target: Target, name: str, coefficients: FloatArray, corrected: npt.NDArray[np.bool_]
    ) -> list[Residual | None]:
        """A residual for each frame that needs one."""
        if not self.options.residual:
            return [None] * len(coefficients)
        found: list[Residual | None] = []
        width = len(str(len(coefficients)))
        for number, (own, goal, rows) in enumerate(zip(coefficients, target.points, corrected, strict=True), 1):
            if not rows.any():
                found.append(None)
                continue
            wanted = f"{name}_residual" if len(coefficients) == 1 else f"{name}_residual_{number:0{width}}"
            shape = unique_identifiers([*self.shape_names, wanted])[-1]
            self.shape_names.append(shape)
            found.append(corrective(self.parts, self.rig, shape, own, goal, rows))
        return found

    def _warnings(
        self, name: str, report: TargetReport, residuals: Sequence[Residual | None], coefficients: FloatArray
    ) -> list[str]:
        lines = []
        lost = sum(one.lost for one in residuals if one is not None)
        if lost:
            lines.append(f"{name}: {lost} points are squashed flat by their bones, the residual can't move them")
        if not report.reached:
            largest = (report.residual.distances if report.residual else report.distances).max_mm
            lines.append(f"{name}: {largest:.4g} mm off at most, threshold {self.options.threshold_mm:g} mm")
        sheared = local_shear(self.rig, coefficients)
        if sheared:
            lines.append(f"{name}: SkelAnimation can't hold the shear of {', '.join(sheared)}; the coefficients do")
        return lines

    def report(self, found: Sequence[FoundTarget]) -> FitBonesReport:
        """The report of all targets."""
        joints = self.rig.joints
        return FitBonesReport(
            threshold_mm=self.options.threshold_mm,
            points=len(self.rig.points),
            joints=len(joints),
            free=len(self.session.free),
            weightless=tuple(joints[i] for i in np.flatnonzero(self.session.weightless)),
            targets={one.animation.name: one.report for one in found},
            warnings=(*rest_shear(self.rig), *dict.fromkeys(line for one in found for line in one.warnings)),
        )


def _initial(given: FloatArray | None, rig: Rig) -> FloatArray:
    rest = rest_coefficients(len(rig.joints))
    if given is None:
        return rest
    initial = np.asarray(given, dtype=np.float64)
    if initial.shape != rest.shape or not np.isfinite(initial).all():
        raise InputError("initial", f"coefficients {initial.shape}, expected {rest.shape} finite numbers")
    return initial


def _tracks(residuals: Sequence[Residual | None]) -> tuple[tuple[tuple[Blendshape | None, ...], ...], FloatArray]:
    """The shapes of all frames, and their weights (T, shapes): 1 at the frame that each is for."""
    own = {frame: one.shapes for frame, one in enumerate(residuals) if one is not None}
    made = {frame: meshes for frame, meshes in own.items() if any(shape is not None for shape in meshes)}
    shapes, frames = tuple(made.values()), list(made)
    weights = np.zeros((len(residuals), len(shapes)))
    weights[frames, np.arange(len(shapes))] = 1.0
    return shapes, weights


def _name(shapes: tuple[Blendshape | None, ...]) -> str:
    return next(one.name for one in shapes if one is not None)


def _residual_report(shapes: Sequence[Sequence[Blendshape | None]], end: FloatArray) -> ResidualReport:
    points = sum(len(one.offsets) for own in shapes for one in own if one is not None)
    return ResidualReport(shapes=len(shapes), points=points, distances=distances(end))
