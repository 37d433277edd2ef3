"""Fits of one face to its targets: poses many at a time, clips frame by frame, and what is authored of each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import FitError, InputError
from facepipe.core.names import first_names, unique_identifiers
from facepipe.core.threads import one_thread
from facepipe.parts import Animation, Blendshape, FaceParts, all_regions
from facepipe.rig import Rig, mesh_spaces, rest_coefficients
from facepipe.rig.trs import decompose
from facepipe.stage import Face
from facepipe.verbs.fit_bones.bone_fit import BoneFit
from facepipe.verbs.fit_bones.limits import LimitRules, check_rig, check_targets, local_shear, rest_shear, size_warning
from facepipe.verbs.fit_bones.options import STRICTER, FitBonesOptions
from facepipe.verbs.fit_bones.report import (
    FitBonesReport,
    ResidualReport,
    TargetReport,
    at_limits,
    by_region,
    distances,
)
from facepipe.verbs.fit_bones.targets import Target

_FLAT = 1e-9  # determinant of a blended matrix, of its size: no way back from there
_SAME = 2e-7  # relative: a scale that is as near to one in half precision is it
_TOGETHER = 32  # poses at a time: more gain little, and the next report of progress waits for them
_SHOWN = 4  # names of a list

ShapeOfMeshes = tuple[Blendshape | None, ...]  # one shape: a blendshape or None per mesh


@dataclass(frozen=True)
class Residual:
    """Offsets of points before skinning, in float32 as they are authored."""

    shapes: tuple[Blendshape | None, ...]  # per mesh; None where no point of it is corrected
    points: FloatArray  # (n, 3) world points with bones and offsets
    lost: int  # points whose skinning can't be turned round


def corrective(
    parts: FaceParts,
    rig: Rig,
    name: str,
    coefficients: FloatArray,
    target: FloatArray,
    corrected: BoolArray,
) -> Residual:
    """The blendshape that brings the posed points `corrected` (n,) to `target` (n, 3), and leaves the others.

    Blendshapes come before skinning: the difference in the world goes back through each point's blended matrix.

    :param parts: what `rig` was built from
    :param coefficients: (m, 9) of the pose
    """
    matrices = rig.skinning_matrices(rig.local_transforms(coefficients))
    posed = rig.skin(rig.points, matrices)
    blended = (rig.influences @ matrices[:, :3, :3].reshape(-1, 9)).reshape(-1, 3, 3)
    # det grows with the cube of the norm: their ratio says how flat a matrix is, whatever the scale of its joints;
    # the inverse of a flat one would throw its point far off
    sizes = np.linalg.norm(blended, axis=(1, 2)) ** 3
    kept = corrected & (np.abs(np.linalg.det(blended)) > _FLAT * sizes)
    rows = np.flatnonzero(kept)
    moved = np.linalg.solve(blended[rows], (target - posed)[rows, :, None])[..., 0]
    shapes: list[Blendshape | None] = []
    bound = rig.points.copy()
    for number, space in enumerate(mesh_spaces(parts)):
        start, stop = rig.mesh_offsets[number : number + 2]
        inside = slice(*np.searchsorted(rows, [start, stop]))
        linear = np.asarray(space, np.float64)[:3, :3]
        offsets = np.linalg.solve(linear, moved[inside].T).T.astype(np.float32)
        # the offsets as rounded to float32: the points returned are those that the file gives
        bound[rows[inside]] += offsets.astype(np.float64) @ linear.T
        indices = (rows[inside] - start).astype(np.int32)
        shapes.append(Blendshape(name=name, point_indices=indices, offsets=offsets) if len(indices) else None)
    return Residual(tuple(shapes), rig.skin(bound, matrices), int(corrected.sum() - kept.sum()))


def half_scaled(fit: BoneFit, coefficients: FloatArray, target: FloatArray) -> FloatArray:
    """(m, 9) float32 numbers near `coefficients`, with scales that SkelAnimation, which is half precision, holds.

    Scales are rounded; the other coefficients then make good what that does to the points. In a sparse fit those that
    rest go on to rest.

    :param target: (n, 3)
    """
    held = np.zeros(coefficients.shape, dtype=np.bool_)
    held[:, 6:] = True
    if fit.sparsity > 0:
        held |= coefficients == rest_coefficients(len(coefficients))
    rounded = _rounded(fit, coefficients)
    with one_thread():
        return _rounded(fit, fit.refit(target, rounded, held).coefficients)


def _rounded(fit: BoneFit, coefficients: FloatArray) -> FloatArray:
    """(m, 9) as float32 numbers with scales of half precision, tied ones alike."""
    rounded = with_half_scales(fit.rig, coefficients, fit.lower, fit.upper)
    if fit.symmetry is not None:
        rounded[:, 6:] = rounded.ravel()[fit.symmetry.leaders].reshape(rounded.shape)[:, 6:]
    return rounded.astype(np.float32).astype(np.float64)


def with_half_scales(rig: Rig, coefficients: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """(m, 9) `coefficients` with each scale the nearest that makes that of the local transform half precision.

    Where limits (m, 9) leave no such scale beside a coefficient, and where a transform has shear, it stays as it is.
    """
    rounded = np.array(coefficients, dtype=np.float64)
    # (m, 3) scales of the local transforms, by those of the coefficients; NaN where there are none
    local = decompose(rig.local_transforms(rounded))
    with np.errstate(divide="ignore", invalid="ignore"):
        factors = local.scale / rounded[:, 6:]
    rounded[:, 6:] = _nearest(
        rounded[:, 6:],
        np.where(local.sheared[:, None] | (factors == 0) | ~np.isfinite(factors), np.nan, factors),
        lower[:, 6:],
        upper[:, 6:],
    )
    return rounded


def _nearest(values: FloatArray, factors: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Values, one by one the nearest inside the limits whose products with `factors` are half precision."""
    products = values * factors
    with np.errstate(over="ignore"):
        half = products.astype(np.float16)
        candidates = (half, np.nextafter(half, np.float16(np.inf)), np.nextafter(half, np.float16(-np.inf)))
    done = ~np.isfinite(half) | (np.abs(half.astype(np.float64) - products) <= _SAME * np.abs(products))
    rounded = np.array(values, dtype=np.float64)
    for candidate in candidates:
        tried = (candidate.astype(np.float64) / factors).astype(np.float32).astype(np.float64)
        fits = ~done & (lower <= tried) & (tried <= upper)
        rounded = np.where(fits, tried, rounded)
        done = done | fits
    return rounded


@dataclass(frozen=True, kw_only=True)
class FittedTarget:
    """What the fit of one target gave."""

    animation: Animation
    shapes: tuple[ShapeOfMeshes, ...]  # of the residual
    report: TargetReport
    warnings: tuple[str, ...]


class TargetFits:
    """One face and its targets.

    :param limits: over those of the rig
    :param weights: (n,) how much each point counts
    :param initial: (m, 9) coefficients to start from; None: rest
    """

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
        self.parts = face.parts()
        self._rig, self._mm = face.rig(), face.mm_per_unit
        check_rig(face.where, self.parts, self._rig)
        self._limits = limits.resolve(self._rig.joints, face.meters_per_unit, self.parts.bone_limits)
        self._start = np.clip(_checked_start(initial, self._rig), *self._limits)
        self._rest_points = self._rig.evaluate()
        check_targets(targets, self._rest_points, weights)
        self._targets, self._options, self._weights = targets, options, weights
        taken = [animation.name for animation in self.parts.animations]
        self._names = unique_identifiers([*taken, *(target.name for target in targets)])[len(taken) :]
        self._shape_names = list(face.shapes)  # that are taken
        self._fits: dict[bytes, BoneFit] = {}
        self._fit_of_all = self._fit_of(None)

    def fit_all(self, done: Callable[[], object]) -> list[FittedTarget]:
        """All targets, in their order.

        :param done: called after every frame
        :raises FitError: limits that let a joint shrink to nothing, and a fit that did
        """
        return [self._fitted(number, *solved) for number, solved in enumerate(self._solved(done))]

    def report(self, fitted: Sequence[FittedTarget]) -> FitBonesReport:
        """The report of all targets."""
        joints, fit = self._rig.joints, self._fit_of_all
        of_rig = (*rest_shear(self._rig), *_unpaired(fit.symmetry.single if fit.symmetry else ()))
        return FitBonesReport(
            threshold_mm=self._options.threshold_mm,
            points=len(self._rig.points),
            joints=len(joints),
            free=len(fit.free),
            weightless=tuple(joints[number] for number in np.flatnonzero(fit.weightless)),
            targets={target.animation.name: target.report for target in fitted},
            warnings=(*of_rig, *dict.fromkeys(line for target in fitted for line in target.warnings)),
        )

    def _fit_of(self, known: BoolArray | None) -> BoneFit:
        """The fit in which the points count that a target knows, made once.

        :raises InputError: limits or joints that a symmetric fit can't have
        """
        # by the points known: factors depend on these weights, not on the target, so poses of one file share them
        key = b"" if known is None or known.all() else np.packbits(known).tobytes()
        if key not in self._fits:
            options, (lower, upper) = self._options, self._limits
            self._fits[key] = BoneFit(
                self._rig,
                lower=lower,
                upper=upper,
                weights=self._weights if known is None else self._weights * known,
                threshold=STRICTER * options.threshold_mm / self._mm,
                steps=options.max_iterations,
                rounds=options.evening,
                regularise=options.regularise,
                sparsity=options.sparsity,
                symmetric=options.symmetric,
            )
        return self._fits[key]

    def _solved(self, done: Callable[[], object]) -> Iterator[tuple[FloatArray, int]]:
        """Coefficients (T, m, 9) and steps of each target."""
        ahead: dict[int, tuple[FloatArray, int]] = {}
        for number, target in enumerate(self._targets):
            if len(target.points) > 1:
                yield self._clip(number, done)
                continue
            if number not in ahead:
                ahead |= self._together(number)
            coefficients, steps = ahead.pop(number)
            yield coefficients[None], steps
            done()

    def _together(self, first: int) -> dict[int, tuple[FloatArray, int]]:
        """Number -> coefficients (m, 9) and steps of a pose and of those after it that share its `BoneFit`."""
        fit, numbers = self._fit_of(self._targets[first].known), []
        for number in range(first, len(self._targets)):
            target = self._targets[number]
            if len(target.points) == 1 and self._fit_of(target.known) is fit:
                numbers.append(number)
            if len(numbers) == _TOGETHER:
                break
        try:
            poses = fit.fit_all([self._targets[number].points[0] for number in numbers], self._start)
        except np.linalg.LinAlgError:  # one by one, to name the target
            return {number: self._frame(number, 0, self._start) for number in numbers}
        return {number: (pose.coefficients, pose.steps) for number, pose in zip(numbers, poses, strict=True)}

    def _clip(self, number: int, done: Callable[[], object]) -> tuple[FloatArray, int]:
        """Coefficients (T, m, 9) and steps of a clip, each frame fitted from the one before."""
        frames, steps, start = [], 0, self._start
        for frame in range(len(self._targets[number].points)):
            start, taken = self._frame(number, frame, start)
            frames.append(start)
            steps += taken
            done()
        return np.stack(frames), steps

    def _frame(self, number: int, frame: int, start: FloatArray) -> tuple[FloatArray, int]:
        target = self._targets[number]
        try:
            fitted = self._fit_of(target.known).fit(target.points[frame], start)
        except np.linalg.LinAlgError:
            what = "the scale of a joint fell to 0, expected limits that keep it away from there"
            raise FitError(f"{self._rig.name} -> {self._names[number]}", what) from None
        return fitted.coefficients, fitted.steps

    def _fitted(self, number: int, solved: FloatArray, steps: int) -> FittedTarget:
        """What is authored of one target, solved as coefficients (T, m, 9), with its report."""
        target, name, threshold = self._targets[number], self._names[number], self._options.threshold_mm
        fit = self._fit_of(target.known)
        counts = fit.weights > 0
        solved = solved.astype(np.float32).astype(np.float64)  # as it is authored
        coefficients = self._with_half_scales(fit, target, solved) if self._options.residual else solved
        posed = self._posed(coefficients)
        miss = self._distances(posed, target)
        corrected = (miss > STRICTER * threshold) & counts & (miss[:, counts].max(axis=1) > threshold)[:, None]
        residuals = self._residuals(target, name, coefficients, corrected)
        frames = len(coefficients)
        # the shapes of all frames, and their weights (T, shapes): 1 at the frame that each is for
        made = {frame: one.shapes for frame, one in residuals.items() if any(shape is not None for shape in one.shapes)}
        weights = np.zeros((frames, len(made)))
        weights[list(made), np.arange(len(made))] = 1.0
        shapes, weights = tuple(made.values()), weights
        for frame, residual in residuals.items():
            posed[frame] = residual.points
        miss_at_end = self._distances(posed, target)
        start = np.clip(self._start, fit.lower, fit.upper)
        report = TargetReport(
            animation=name,
            frames=len(coefficients),
            before=distances(self._distances(self._posed(start[None]), target)[:, counts]),
            distances=distances(miss[:, counts]),
            regions=by_region(miss, all_regions(self.parts.meshes), target.known),
            reached=bool((miss_at_end[:, counts] <= threshold).all()),
            steps=steps,
            at_limits=at_limits(solved, fit.lower, fit.upper, self._rig.joints, fit.free),
            residual=_residual_report(shapes, miss_at_end[:, counts]) if self._options.residual else None,
        )
        animation = Animation(
            name=name,
            times=target.times,
            joints=self._rig.joints,
            coefficients=coefficients,
            shapes=tuple(next(part.name for part in shape if part is not None) for shape in shapes),
            shape_weights=weights if shapes else None,
        )
        size = size_warning(target, name, self._rest_points, fit.weights)
        warnings = (*target.notes, *size, *self._warnings(report, residuals, coefficients))
        return FittedTarget(animation=animation, shapes=shapes, report=report, warnings=warnings)

    def _with_half_scales(self, fit: BoneFit, target: Target, solved: FloatArray) -> FloatArray:
        """(T, m, 9) `solved`, with half-precision scales in the frames that need a residual.

        A residual is added to the pose that SkelAnimation holds, whose scales are half precision.
        """
        coefficients, miss = solved.copy(), self._distances(self._posed(solved), target)
        for frame in np.flatnonzero(miss[:, fit.weights > 0].max(axis=1) > self._options.threshold_mm):
            coefficients[frame] = half_scaled(fit, solved[frame], target.points[frame])
        return coefficients

    def _posed(self, coefficients: FloatArray) -> FloatArray:
        """(T, n, 3) points."""
        return np.stack([self._rig.evaluate(coefficients=frame) for frame in coefficients])

    def _distances(self, points: FloatArray, target: Target) -> FloatArray:
        """(T, n) distances of (T, n, 3) points from the target's, in millimetres."""
        return np.asarray(np.linalg.norm(points - target.points, axis=2) * self._mm)

    def _residuals(
        self, target: Target, name: str, coefficients: FloatArray, corrected: BoolArray
    ) -> dict[int, Residual]:
        """Frame -> residual, of the frames that need one."""
        residuals: dict[int, Residual] = {}
        if not self._options.residual:
            return residuals
        count = len(coefficients)
        for frame in np.flatnonzero(corrected.any(axis=1)).tolist():
            wanted = f"{name}_residual" if count == 1 else f"{name}_residual_{frame + 1:0{len(str(count))}}"
            shape = unique_identifiers([*self._shape_names, wanted])[-1]
            self._shape_names.append(shape)
            residuals[frame] = corrective(
                self.parts, self._rig, shape, coefficients[frame], target.points[frame], corrected[frame]
            )
        return residuals

    def _warnings(self, report: TargetReport, residuals: Mapping[int, Residual], coefficients: FloatArray) -> list[str]:
        name, lines = report.animation, []
        lost = sum(residual.lost for residual in residuals.values())
        if lost:
            lines.append(f"{name}: {lost} points are squashed flat by their bones, the residual can't move them")
        if not report.reached:
            largest = (report.residual.distances if report.residual else report.distances).max_mm
            lines.append(f"{name}: {largest:.4g} mm off at most, threshold {self._options.threshold_mm:g} mm")
        sheared = local_shear(self._rig, coefficients)
        if sheared:
            lines.append(f"{name}: SkelAnimation can't hold the shear of {sheared}; the coefficients do")
        return lines


def _residual_report(shapes: Sequence[ShapeOfMeshes], miss_at_end: FloatArray) -> ResidualReport:
    points = sum(len(part.offsets) for shape in shapes for part in shape if part is not None)
    return ResidualReport(shapes=len(shapes), points=points, distances=distances(miss_at_end))


def _unpaired(joints: Sequence[str]) -> list[str]:
    """A warning of joints that have no partner in a symmetric fit."""
    if not joints:
        return []
    names = first_names([joint.rpartition("/")[2] for joint in joints], _SHOWN)
    if len(joints) == 1:
        return [f"1 joint of one side has no partner and moves as it likes: {names}"]
    return [f"{len(joints)} joints of one side have no partner and move as they like: {names}"]


def _checked_start(given: FloatArray | None, rig: Rig) -> FloatArray:
    rest = rest_coefficients(len(rig.joints))
    if given is None:
        return rest
    start = np.asarray(given, dtype=np.float64)
    if start.shape != rest.shape or not np.isfinite(start).all():
        raise InputError("initial", f"coefficients {start.shape}, expected {rest.shape} finite numbers")
    return start
