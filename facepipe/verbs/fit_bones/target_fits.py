"""Fits the bones of a face to its targets: poses many at a time, clips frame by frame, and what bones can't reach.

In order: the report; the residual as a blendshape, and scales as SkelAnimation holds them; the fits of one face
(`TargetFits`); all of it authored (`FitBones`), with how much points count and where a fit starts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import FitError, InputError
from facepipe.core.names import first_names, suggestion, unique_identifiers
from facepipe.core.reports import Report, not_in_json, table
from facepipe.core.threads import one_thread
from facepipe.parts import Animation, Blendshape, FaceParts, Recipe, all_regions
from facepipe.payload import decode
from facepipe.rig import CHANNELS, Rig, matrix_coefficients, mesh_spaces, rest_coefficients
from facepipe.rig.trs import decompose
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes
from facepipe.stage.face import play
from facepipe.verbs.bone_payload import SUFFIX, check_fits, payload_bytes
from facepipe.verbs.fit_bones.bone_fit import BoneFit
from facepipe.verbs.fit_bones.limits import LimitRules, check_rig, check_targets, rest_shear, size_warning, some
from facepipe.verbs.fit_bones.options import STRICTER, FitBonesOptions
from facepipe.verbs.fit_bones.person_reach import PersonReach, person_reach
from facepipe.verbs.fit_bones.targets import Target

_SHOWN = 4  # names of a list
_REGIONS = 3  # of a single target, the worst
_FLAT = 1e-9  # determinant of a blended matrix, of its size: no way back from there
_SAME = 2e-7  # relative: a scale that is as near to one in half precision is it
_TOGETHER = 32  # poses at a time: more gain little, and the next report of progress waits for them

ShapeOfMeshes = tuple[Blendshape | None, ...]  # one shape: a blendshape or None per mesh
Residual = tuple[ShapeOfMeshes, FloatArray, int]  # as `corrective` makes it
_LARGEST_WEIGHT = 1e12  # of a point
_NO_REGIONS = "none, the face has neither regions nor point subsets"


@dataclass(frozen=True, kw_only=True)
class Distances:
    """Distances of points from their targets, over all frames."""

    points: int
    mean_mm: float
    rms_mm: float
    p95_mm: float
    max_mm: float


class Solved(NamedTuple):
    """What a frame came to."""

    coefficients: FloatArray  # (m, 9)
    steps: int
    capped: bool  # that were all steps it may take


@dataclass(frozen=True, kw_only=True)
class ResidualReport:
    """A corrective blendshape per frame that needs one."""

    shapes: int
    points: int  # offsets of all shapes together
    distances: Distances  # with bones and residual


@dataclass(frozen=True, kw_only=True)
class TargetReport:
    """One target."""

    animation: str  # the SkelAnimation that holds the coefficients
    frames: int
    before: Distances  # at the pose that the fit started from, points that count
    distances: Distances  # with bones alone, points that count
    regions: Mapping[str, Distances] = field(default_factory=dict)  # points by the region that most of them is in
    reached: bool  # within the threshold, with the residual where there is one
    steps: int  # of the solves that were kept, over all frames
    capped: int = 0  # frames whose solve ended at --max-iterations, before an optimum
    at_limits: tuple[str, ...] = ()  # "joint:channel" where some frame is stopped by a limit
    residual: ResidualReport | None = None
    person: PersonReach | None = None  # of another face on the head in the box that bones alone miss


@dataclass(frozen=True, kw_only=True)
class FitBonesReport(Report):
    """What a bone fit did."""

    threshold_mm: float
    points: int
    joints: int
    free: int  # joints that could move
    weightless: tuple[str, ...]  # joints without influence on a point that counts: they keep their place
    targets: Mapping[str, TargetReport]
    authored: tuple[str, ...] = ()
    seconds: float = 0.0
    fitted: Any = not_in_json()  # the targets, of which pictures are drawn

    @property
    def missed(self) -> tuple[str, ...]:
        """Targets that are not reached."""
        return tuple(name for name, target in self.targets.items() if not target.reached)

    def as_text(self, out: Path) -> str:
        """How near each target is reached."""
        count = len(self.targets)
        # enough that distances differ from the threshold
        decimals = max(4, 1 - math.floor(math.log10(self.threshold_mm)))
        residual = any(target.residual for target in self.targets.values())
        head = ["distance, mm", "frames", "steps", "before", "mean", "RMS", "p95", "max"]
        rows: list[list[object]] = [[*head, *(["residual points", "max"] if residual else [])]]
        for name, target in self.targets.items():
            off, corrected = target.distances, target.residual
            numbers = (
                f"{value:.{decimals}f}"
                for value in (target.before.max_mm, off.mean_mm, off.rms_mm, off.p95_mm, off.max_mm)
            )
            rest = [f"{corrected.points:,}", f"{corrected.distances.max_mm:.{decimals}f}"] if corrected else []
            rows.append([name, target.frames, target.steps, *numbers, *rest, *([] if target.reached else ["missed"])])
        regions = [(off.max_mm, name) for target in self.targets.values() for name, off in target.regions.items()]
        regions = sorted(regions, key=lambda one: -one[0])[:_REGIONS] if count == 1 else []
        worst = [", ".join(f"{name} {off_mm:.{decimals}f} mm" for off_mm, name in regions)]
        lines = [
            f"{out}: {count} target{'s' * (count != 1)}, {self.free} of {self.joints} joints, "
            f"{self.points:,} points in {self.seconds:.2f} s",
            table(rows),
            *(f"worst regions: {some}" for some in worst if some),
            *(
                f"{name}: stopped by limits: {_names(target.at_limits)}"
                for name, target in self.targets.items()
                if target.at_limits
            ),
            *(
                f"{name}: bones leave {who.bones_mean_mm:.3f} mm on average, `facepipe person` {who.mean_mm:.3f} mm "
                f"in {who.bytes:,} bytes"
                for name, target in self.targets.items()
                if (who := target.person)
            ),
        ]
        if self.weightless:
            lines.append(f"joints that move nothing, left as they are: {_names(self.weightless)}")
        return "\n".join(filter(None, lines))


def distances(values: FloatArray) -> Distances:
    """Of distances (..., points) in millimetres, frames before points."""
    values = np.atleast_2d(values)
    if not values.size:
        return Distances(points=0, mean_mm=0.0, rms_mm=0.0, p95_mm=0.0, max_mm=0.0)
    return Distances(
        points=values.shape[-1],
        mean_mm=float(values.mean()),
        rms_mm=float(np.sqrt((values**2).mean())),
        p95_mm=float(np.percentile(values, 95)),
        max_mm=float(values.max()),
    )


def by_region(off: FloatArray, masks: Mapping[str, FloatArray], known: BoolArray | None) -> dict[str, Distances]:
    """Of distances (T, n) of known points, all without `known` (n,), in the region that most of each is in."""
    if not masks:
        return {}
    shares = np.stack(list(masks.values()))
    largest = np.where(shares.max(axis=0) > 0, shares.argmax(axis=0), -1)
    if known is not None:
        largest[~known] = -1
    numbers = dict(enumerate(masks))
    return {name: distances(off[:, largest == number]) for number, name in numbers.items() if (largest == number).any()}


def at_limits(
    coefficients: FloatArray, lower: FloatArray, upper: FloatArray, joints: tuple[str, ...], free: IntArray
) -> tuple[str, ...]:
    """``joint:channel`` of the free joints' channels that a frame of (T, m, 9) has at a limit, where not locked."""
    held = ((coefficients <= lower) | (coefficients >= upper)).any(axis=0) & (lower < upper)
    allowed = np.isin(np.arange(len(joints)), free)
    return tuple(f"{joints[joint]}:{CHANNELS[channel]}" for joint, channel in np.argwhere(held & allowed[:, None]))


def _names(names: Sequence[str]) -> str:
    some = ", ".join(name.rpartition("/")[2] for name in names[:_SHOWN])
    return f"{len(names)} ({some}{', ...' if len(names) > _SHOWN else ''})"


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
    :returns: a shape per mesh, None where no point of it is corrected; (n, 3) world points with bones and offsets, in
        float32 as they are authored; how many points' skinning can't be turned round
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
    return tuple(shapes), rig.skin(bound, matrices), int(corrected.sum() - kept.sum())


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
    factors = np.where(local.sheared[:, None] | (factors == 0) | ~np.isfinite(factors), np.nan, factors)
    # one by one the nearest scale inside the limits whose product with its factor is half precision
    products = rounded[:, 6:] * factors
    with np.errstate(over="ignore"):
        half = products.astype(np.float16)
        candidates = (half, np.nextafter(half, np.float16(np.inf)), np.nextafter(half, np.float16(-np.inf)))
    done = ~np.isfinite(half) | (np.abs(half.astype(np.float64) - products) <= _SAME * np.abs(products))
    for candidate in candidates:
        tried = (candidate.astype(np.float64) / factors).astype(np.float32).astype(np.float64)
        fits = ~done & (lower[:, 6:] <= tried) & (tried <= upper[:, 6:])
        rounded[:, 6:] = np.where(fits, tried, rounded[:, 6:])
        done = done | fits
    return rounded


Fitting = tuple[Animation, tuple[ShapeOfMeshes, ...], TargetReport, tuple[str, ...]]  # residuals' shapes, warnings


class TargetFits:
    """One face and its targets."""

    def __init__(self, face: Face, targets: Sequence[Target], options: FitBones) -> None:
        self.parts, initial = face.parts(), options.initial
        weights = point_weights(self.parts, options.regions, options.mask)  # (n,) how much each point counts
        self._rig, self._mm = face.rig(), face.mm_per_unit
        check_rig(face.where, self.parts, self._rig)
        self._limits = options.limits.resolve(self._rig.joints, face.meters_per_unit, self.parts.bone_limits)
        rest = rest_coefficients(len(self._rig.joints))
        start = rest if initial is None else np.asarray(initial, dtype=np.float64)
        if start.shape != rest.shape or not np.isfinite(start).all():
            raise InputError("initial", f"coefficients {start.shape}, expected {rest.shape} finite numbers")
        self._start = np.clip(start, *self._limits)
        self._rest_points = self._rig.evaluate()
        check_targets(targets, self._rest_points, weights)
        self._targets, self._options, self._weights = targets, options, weights
        taken = [animation.name for animation in self.parts.animations]
        self._names = unique_identifiers([*taken, *(target.name for target in targets)])[len(taken) :]
        self._shape_names = list(face.shapes)  # that are taken
        self._fits: dict[bytes, BoneFit] = {}
        self._fit_of_all = self._fit_of(None)

    def fit_all(self, done: Callable[[], object]) -> list[Fitting]:
        """All targets, in their order.

        :param done: called after every frame
        :raises FitError: limits that let a joint shrink to nothing, and a fit that did
        """
        fitted: list[Fitting] = []
        ahead: dict[int, Solved] = {}
        for number, target in enumerate(self._targets):
            if len(target.points) > 1:
                # a clip: each frame is fitted from the one before
                frames, steps, capped, start = [], 0, 0, self._start
                for frame in range(len(target.points)):
                    start, taken, stopped = self._frame(number, frame, start)
                    frames.append(start)
                    steps, capped = steps + taken, capped + stopped
                    done()
                fitted.append(self._fitted(number, np.stack(frames), steps, capped))
                continue
            if number not in ahead:
                ahead |= self._together(number)
            coefficients, steps, stopped = ahead.pop(number)
            fitted.append(self._fitted(number, coefficients[None], steps, int(stopped)))
            done()
        return fitted

    def report(self, fitted: Sequence[Fitting]) -> FitBonesReport:
        """The report of all targets."""
        joints, fit, of_rig = self._rig.joints, self._fit_of_all, rest_shear(self._rig)
        single = fit.symmetry.single if fit.symmetry else ()
        if single:
            names = first_names([joint.rpartition("/")[2] for joint in single], _SHOWN)
            one, many = "1 joint of one side has no partner and moves as it likes", "joints of one side have no partner"
            what = one if len(single) == 1 else f"{len(single)} {many} and move as they like"
            of_rig = [*of_rig, f"{what}: {names}"]
        return FitBonesReport(
            threshold_mm=self._options.threshold_mm,
            points=len(self._rig.points),
            joints=len(joints),
            free=len(fit.free),
            weightless=tuple(joints[number] for number in np.flatnonzero(fit.weightless)),
            targets={animation.name: report for animation, _, report, _ in fitted},
            warnings=(*of_rig, *dict.fromkeys(line for *_, warnings in fitted for line in warnings)),
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

    def _together(self, first: int) -> dict[int, Solved]:
        """Number -> what a pose came to, and those after it that share its `BoneFit`."""
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
        return {
            number: Solved(pose.coefficients, pose.steps, pose.capped)
            for number, pose in zip(numbers, poses, strict=True)
        }

    def _frame(self, number: int, frame: int, start: FloatArray) -> Solved:
        target = self._targets[number]
        try:
            fitted = self._fit_of(target.known).fit(target.points[frame], start)
        except np.linalg.LinAlgError:
            what = "the scale of a joint fell to 0, expected limits that keep it away from there"
            raise FitError(f"{self._rig.name} -> {self._names[number]}", what) from None
        return Solved(fitted.coefficients, fitted.steps, fitted.capped)

    def _fitted(self, number: int, solved: FloatArray, steps: int, capped: int) -> Fitting:
        """What is authored of one target, solved as coefficients (T, m, 9), with its report."""
        target, name, threshold = self._targets[number], self._names[number], self._options.threshold_mm
        fit = self._fit_of(target.known)
        counts = fit.weights > 0
        solved = solved.astype(np.float32).astype(np.float64)  # as it is authored
        coefficients = solved.copy()
        if self._options.residual:
            # a residual is added to the pose that SkelAnimation holds, whose scales are half precision
            off = self._distances(self._posed(solved), target)[:, counts].max(axis=1)
            for frame in np.flatnonzero(off > threshold).tolist():
                coefficients[frame] = half_scaled(fit, solved[frame], target.points[frame])
        posed = self._posed(coefficients)
        miss = self._distances(posed, target)
        corrected = (miss > STRICTER * threshold) & counts & (miss[:, counts].max(axis=1) > threshold)[:, None]
        residuals = self._residuals(target, name, coefficients, corrected)
        frames = len(coefficients)
        # the shapes of all frames, and their weights (T, shapes): 1 at the frame that each is for
        made = {frame: one for frame, (one, _, _) in residuals.items() if any(shape is not None for shape in one)}
        weights = np.zeros((frames, len(made)))
        weights[list(made), np.arange(len(made))] = 1.0
        shapes = tuple(made.values())
        for frame, (_, points, _) in residuals.items():
            posed[frame] = points
        miss_at_end = self._distances(posed, target)
        residual: ResidualReport | None = None
        if self._options.residual:
            offsets = sum(len(part.offsets) for shape in shapes for part in shape if part is not None)
            residual = ResidualReport(shapes=len(shapes), points=offsets, distances=distances(miss_at_end[:, counts]))
        start = np.clip(self._start, fit.lower, fit.upper)
        missed = bool((miss[:, counts] > threshold).any())
        report = TargetReport(
            animation=name,
            frames=len(coefficients),
            before=distances(self._distances(self._posed(start[None]), target)[:, counts]),
            distances=distances(miss[:, counts]),
            regions=by_region(miss, all_regions(self.parts.meshes), target.known),
            reached=bool((miss_at_end[:, counts] <= threshold).all()),
            steps=steps,
            capped=capped,
            at_limits=at_limits(solved, fit.lower, fit.upper, self._rig.joints, fit.free),
            residual=residual,
            person=person_reach(self.parts, target, miss[0]) if target.person and missed else None,
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
        return animation, shapes, report, warnings

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
        lost = sum(flat for _, _, flat in residuals.values())
        if lost:
            lines.append(f"{name}: {lost} points are squashed flat by their bones, the residual can't move them")
        if report.capped and not report.reached:
            where = "" if report.frames == 1 else f" in {report.capped} frames"
            most = self._options.max_iterations
            lines.append(f"{name}: ended after {most} steps{where}, not at an optimum, --max-iterations takes more")
        if not report.reached:
            largest = (report.residual.distances if report.residual else report.distances).max_mm
            lines.append(f"{name}: {largest:.4g} mm off at most, threshold {self._options.threshold_mm:g} mm")
        local = [decompose(self._rig.local_transforms(frame)).sheared for frame in coefficients]
        sheared = [self._rig.joints[number] for number in np.flatnonzero(np.any(local, axis=0))]
        if sheared:
            lines.append(f"{name}: SkelAnimation can't hold the shear of {some(sheared)}; the coefficients do")
        return lines


@dataclass(frozen=True, kw_only=True)
class FitBones(FitBonesOptions):
    """Coefficients, within limits, that bring a skinned face to targets; a SkelAnimation for each.

    The face's skeleton plays that of a single target: what opens the stage shows the fit. Where that target is another
    face, the fit is the person from then on.

    Source: the bone driving coefficients document, claims 1-5.

    >>> face = facepipe.open("rig.usda")
    >>> targets = read_targets(face, ["smile.usda", "jawOpen"])
    >>> with face.deriving("fitted.usdc") as result:
    ...     report = FitBones(residual=True)(result, targets)

    :param limits: over those of the rig
    :param regions: region or point subset -> how much its points count, 0 or more
    :param mask: regions or point subsets outside which no point counts; empty: all do
    :param initial: (m, 9) coefficients to start from, brought into the limits; default rest
    :raises InputError: options out of range
    """

    limits: LimitRules = field(default_factory=LimitRules)
    regions: Mapping[str, float] = field(default_factory=dict)
    mask: Sequence[str] = ()
    initial: FloatArray | None = None

    @one_thread()
    def __call__(
        self,
        face: Face,
        targets: Sequence[Target],
        *,
        recipe: Recipe | None = None,
        done: Callable[[], object] = lambda: None,
    ) -> FitBonesReport:
        """Fit, and author the result on `face`.

        :param recipe: authored with the result; None leaves what the face has
        :param done: called after every frame
        :raises InputError, TopologyError: a face without bones, singular binds, or targets, limits and regions that
            don't fit it, or joints that a symmetric fit can't pair; nothing is authored then
        :raises FitError: limits that let a joint shrink to nothing, and a fit that did
        """
        start = time.perf_counter()
        fits = TargetFits(face, targets, self)
        fitted = fits.fit_all(done)
        parts = fits.parts
        meshes = []
        for number, mesh in enumerate(parts.meshes):
            residuals = [shape[number] for _, added, _, _ in fitted for shape in added]
            shapes = (*mesh.blendshapes, *(shape for shape in residuals if shape is not None))
            meshes.append(replace(mesh, blendshapes=shapes))
        # of several targets none plays, and none is who the face is
        animations = [animation for animation, *_ in fitted]
        is_person = len(fitted) == 1 and targets[0].person
        result = replace(
            parts,
            meshes=tuple(meshes),
            animations=(*parts.animations, *animations),
            person=animations[0].name if is_person else parts.person,
            recipe=recipe or parts.recipe,
        )
        authored = author_changes(face, result)
        if len(fitted) == 1:
            play(face, animations[0].name)
        return replace(fits.report(fitted), authored=authored, seconds=time.perf_counter() - start)


def point_weights(parts: FaceParts, regions: Mapping[str, float], mask: Sequence[str]) -> FloatArray:
    """(n,) how much each point counts in a fit.

    :param regions: region or point subset -> factor, 0 or more; where a mask is soft, or in none, the rest counts as 1
    :param mask: regions or point subsets outside which nothing counts; empty: all counts
    :raises InputError: unknown names, factors that are negative or not finite, or no point that counts
    """
    starts = np.cumsum([0, *(len(mesh.points) for mesh in parts.meshes)])
    known: dict[str, FloatArray] = {}  # region or point subset -> (n,) mask 0..1; of a name that both have the region
    for mesh, start in zip(parts.meshes, starts, strict=False):
        for name, indices in mesh.point_subsets.items():
            known.setdefault(name, np.zeros(starts[-1]))[np.asarray(indices, dtype=np.int64) + start] = 1.0
    for name, region in all_regions(parts.meshes).items():
        known[name] = np.clip(np.asarray(region, np.float64), 0.0, 1.0)
    weights = np.ones(parts.point_count)
    for name, factor in sorted(regions.items()):  # sums depend on the order, which a recipe does not keep
        where = f"region {name}"
        if not (isinstance(factor, int | float) and math.isfinite(factor) and 0 <= factor <= _LARGEST_WEIGHT):
            raise InputError(where, f"weight {factor}, expected a number from 0 to {_LARGEST_WEIGHT:g}")
        weights += _mask(known, name, where) * (factor - 1.0)
    weights = np.maximum(weights, 0.0)
    if mask:
        weights *= np.clip(sum(_mask(known, name, f"mask {name}") for name in mask), 0.0, 1.0)
    weights[weights < 1e-6 * weights.max(initial=0.0)] = 0.0  # what rounding of masks leaves of 0
    if not weights.any():
        raise InputError("weights", "all points weigh 0, expected some that count")
    return weights


def _mask(known: Mapping[str, FloatArray], name: str, where: str) -> FloatArray:
    if name not in known:
        raise InputError(where, f"no such region or point subset{suggestion(name, sorted(known), _NO_REGIONS)}")
    return known[name]


def initial_coefficients(face: Face, word: str) -> FloatArray:
    """(m, 9) coefficients of the first sample of an animation (those of transforms without shear), or of a .fpb file.

    :raises InputError: no such animation, or a file that can't be read or is for another face
    """
    joints = face.skeleton.joints
    if Path(word).suffix.lower() == SUFFIX:
        content = decode(payload_bytes(Path(word)), joints, word)
        check_fits(face, content)
        return np.asarray(content.frames[0])
    animation = next((animation for animation in face.animations if animation.name == word), None)
    if animation is None:
        known = [animation.name for animation in face.animations]
        raise InputError(f"initial {word}", f"no such animation{suggestion(word, known)}")
    if animation.coefficients is None:
        local, _ = face.sample(word)
        # local = rest C: the coefficients are of C
        return matrix_coefficients(np.linalg.solve(face.rig().rest, local))
    coefficients = rest_coefficients(len(joints))
    for joint, row in zip(animation.joints, animation.coefficients[0], strict=True):
        if joint in joints:
            coefficients[joints.index(joint)] = row
    return coefficients
