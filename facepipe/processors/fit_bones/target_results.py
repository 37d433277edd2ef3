"""What fits of targets come to: coefficients as they are authored, residual shapes, figures and warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.core.names import unique_identifiers
from facepipe.parts import Animation, Blendshape, FaceParts, all_regions
from facepipe.processors.fit_bones.options import FitBonesOptions
from facepipe.processors.fit_bones.report import ResidualReport, TargetReport, at_limits, by_region, distances
from facepipe.processors.fit_bones.residual import Residual, corrective
from facepipe.processors.fit_bones.rig_checks import local_shear
from facepipe.processors.fit_bones.sessions import STRICTER, Session
from facepipe.processors.fit_bones.target_checks import size_warning
from facepipe.processors.fit_bones.targets import Target
from facepipe.rig import Rig


@dataclass(frozen=True)
class Frames:
    """Where the fit of a target ended."""

    coefficients: FloatArray  # (T, m, 9) float32 numbers, as they are authored
    fitted: FloatArray  # (T, m, 9) the same before scales of poses with a residual were brought to half precision
    steps: int


@dataclass(frozen=True, kw_only=True)
class FoundTarget:
    """What one target gave."""

    animation: Animation
    shapes: tuple[tuple[Blendshape | None, ...], ...]  # residual shapes, each a blendshape or None per mesh
    report: TargetReport
    warnings: tuple[str, ...]


class TargetResults:
    """Results on one face.

    :param rest: (n, 3) points
    :param shapes: names that are taken
    :param mm: millimetres in a stage unit
    """

    def __init__(
        self, parts: FaceParts, rig: Rig, options: FitBonesOptions, rest: FloatArray, shapes: Sequence[str], mm: float
    ) -> None:
        self.parts, self.rig, self.options, self.rest, self.mm = parts, rig, options, rest, mm
        self.shape_names = list(shapes)

    def frames(self, session: Session, target: Target, coefficients: FloatArray, steps: int) -> Frames:
        """Coefficients (T, m, 9) as they are authored: what a residual is added to is what SkelAnimation holds."""
        fitted = coefficients.astype(np.float32).astype(np.float64)
        found = fitted.copy()
        if self.options.residual:
            _, off = self._posed(target, fitted)
            for frame in np.flatnonzero(off[:, session.counts].max(axis=1) > self.options.threshold_mm):
                found[frame] = session.half_scales.near(fitted[frame], target.points[frame])
        return Frames(found, fitted, steps)

    def found(self, session: Session, target: Target, name: str, frames: Frames) -> FoundTarget:
        """What to author, and what to tell, of one target."""
        counts, coefficients, threshold = session.counts, frames.coefficients, self.options.threshold_mm
        posed, off = self._posed(target, coefficients)
        missed = off[:, counts].max(axis=1) > threshold
        corrected = (off > STRICTER * threshold) & counts & missed[:, None]
        residuals = self._residuals(target, name, coefficients, corrected)
        shapes, weights = _tracks(residuals)
        end = self._off(np.stack([p if r is None else r.points for p, r in zip(posed, residuals, strict=True)]), target)
        known = np.ones(len(counts), bool) if target.known is None else target.known
        report = TargetReport(
            animation=name,
            frames=len(coefficients),
            before=distances(self._off(self.rig.evaluate(coefficients=session.start)[None], target)[:, counts]),
            distances=distances(off[:, counts]),
            regions=by_region(off, all_regions(self.parts.meshes), known),
            reached=bool((end[:, counts] <= threshold).all()),
            steps=frames.steps,
            at_limits=at_limits(frames.fitted, session.fit.lower, session.fit.upper, self.rig.joints, session.fit.free),
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
                *size_warning(target, name, self.rest, session.fit.weights),
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
