"""Makes sliders of a face's blendshapes, by fitting its bones to them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import first_names, select
from facepipe.core.reports import Report, table
from facepipe.core.threads import one_thread
from facepipe.parts import Blendshape, Curve, FaceParts, Recipe, Slider
from facepipe.rig import CHANNELS
from facepipe.rig.sliders import with_entries, with_mutual_mirrors
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes
from facepipe.verbs.fit_bones.limits import LimitRules, check_rig
from facepipe.verbs.fit_bones.options import STRICTER
from facepipe.verbs.fit_bones.target_fits import Residual, corrective
from facepipe.verbs.sliders.author_sliders import beyond_lines, fitting_network, sliders_beyond, with_values
from facepipe.verbs.sliders.options import ShapeSliderOptions
from facepipe.verbs.sliders.shape_fits import ShapeFits, ShapePose, fit_poses
from facepipe.verbs.sliders.shape_names import ShapeSlider, parse_pairs, shape_sliders

_HEAD = ("distance, mm", "by", "joints", "channels", "reach", "RMS", "max", "RMS left", "max left")
_RESIDUAL = "_residual"  # what the name of a shape's corrective ends in

_CURVES: Mapping[float, Curve] = {-1.0: ((-1.0, 1.0), (0.0, 0.0)), 1.0: ((0.0, 0.0), (1.0, 1.0))}
_SHOWN = 4  # names of a list
_LEAST = 1e-6  # mm: a motion that is less is none


@dataclass(frozen=True, kw_only=True)
class EndReport:
    """One end of a slider: a shape, over all points of the face."""

    shape: str
    rms_mm: float  # of the shape's motion
    max_mm: float
    left_rms_mm: float  # of what bones leave
    left_max_mm: float
    reach: float  # 1 - RMS left / RMS of the motion, at least 0
    residual_points: int = 0
    end_max_mm: float  # at the slider's end, with residual or shape where it drives one


@dataclass(frozen=True, kw_only=True)
class MadeSlider:
    """One slider."""

    group: str
    ends: tuple[EndReport, ...]  # the lower one first
    reach: float  # of all ends
    joints: int
    channels: int
    symmetric: bool  # both sides of the face move as mirror images, or this slider and its mirror do
    mirror: str | None
    by: str  # "bones", "bones and residual", "shapes"; "" where it was left out


@dataclass(frozen=True, kw_only=True)
class GroupReach:
    """The sliders of a group, those left out too."""

    sliders: int
    left_out: int
    rms_mm: float  # of all motions
    left_rms_mm: float
    reach: float


@dataclass(frozen=True, kw_only=True)
class ShapeSlidersReport(Report):
    """What was made."""

    sliders: Mapping[str, MadeSlider]
    left_out: Mapping[str, MadeSlider] = field(default_factory=dict)  # bones reach too little of them
    groups: Mapping[str, GroupReach] = field(default_factory=dict)
    unmoved: tuple[str, ...] = ()  # shapes that move no point
    replaced: tuple[str, ...] = ()  # sliders that the face had by the same names
    dropped: tuple[str, ...] = ()  # sliders that the face had and has no more
    beyond_limits: tuple[str, ...] = ()  # "slider -> joint:channel" beyond the face's own limits
    authored: tuple[str, ...] = ()
    seconds: float = 0.0

    def as_text(self, out: Path) -> str:
        """A table for people, the sliders of each group below it."""
        sliders = {**self.sliders, **self.left_out}
        rows: list[Sequence[object]] = [_HEAD]
        for group, reach in self.groups.items():
            numbers = (f"{reach.reach:.2f}", f"{reach.rms_mm:.2f}", "", f"{reach.left_rms_mm:.2f}")
            rows.append((group or "(no group)", "", "", "", *numbers))
            for name, slider in sliders.items():
                if slider.group == group:
                    ends, count = slider.ends, len(slider.ends)
                    rms, left = (
                        math.sqrt(sum(mm**2 for mm in values) / count)
                        for values in ([end.rms_mm for end in ends], [end.left_rms_mm for end in ends])
                    )
                    largest, last = max(end.max_mm for end in ends), max(end.left_max_mm for end in ends)
                    numbers = (f"{rms:.2f}", f"{largest:.1f}", f"{left:.2f}", f"{last:.1f}")
                    by = slider.by or "left out"
                    rows.append((f"  {name}", by, slider.joints, slider.channels, f"{slider.reach:.2f}", *numbers))
        parts = [f"{len(self.sliders)} sliders of {sum(len(slider.ends) for slider in sliders.values())} shapes"]
        for what, names in (("left out", self.left_out), ("replaced", self.replaced), ("dropped", self.dropped)):
            parts += [f"{len(names)} {what}"] if names else []
        return f"{out}: {', '.join(parts)} in {self.seconds:.1f} s\n{table(rows)}"


def reach_of(motions: Sequence[float], left: Sequence[float]) -> float:
    """How much bones reach of several motions, from their RMS and that of what is left of each."""
    length = float(np.linalg.norm(motions))
    return max(0.0, 1.0 - float(np.linalg.norm(left)) / length) if length else 0.0


Made = tuple[str, Slider | None, tuple[Residual, ...], MadeSlider]  # by its name; no slider where it was left out


@dataclass(frozen=True, kw_only=True)
class SliderMaker:
    """Makes the sliders of one face."""

    parts: FaceParts  # what the rig of `fits` was built from
    fits: ShapeFits
    options: ShapeSliderOptions
    poses: Mapping[str, ShapePose]  # by shape
    targets: Mapping[str, FloatArray]  # shape -> (n, 3) points
    mm: float  # millimetres in a stage unit

    def make(self, wanted: ShapeSlider, twin: ShapeSlider | None) -> Made:
        """The slider, by what it and its mirror reach together: bones, with a residual or not, shapes, or nothing."""
        reached = self.reach(*((wanted,) if twin is None else (wanted, twin))) >= self.options.least_reach
        residual, residuals = self.options.residual, {}
        for _, shape in wanted.ends if reached and residual else ():
            pose, target = self.poses[shape], self.targets[shape]
            corrected = np.linalg.norm(pose.points - target, axis=1) * self.mm > STRICTER * self.options.threshold_mm
            if corrected.any():
                coefficients, name = self.fits.rest + pose.gains, shape + _RESIDUAL
                residuals[shape] = corrective(self.parts, self.fits.rig, name, coefficients, target, corrected)
        by = ("bones and residual" if residuals else "bones") if reached else "shapes" if residual else ""
        slider = self._slider(wanted, by, residuals) if by else None
        return wanted.name, slider, tuple(residuals.values()), self._report(wanted, by, residuals)

    def reach(self, *sliders: ShapeSlider) -> float:
        """How much of the motion of sliders' shapes bones make."""
        shapes = sorted(shape for slider in sliders for _, shape in slider.ends)  # as of the mirror, to the last digit
        motions = [np.linalg.norm(self.targets[shape] - self.fits.points) for shape in shapes]
        left = [np.linalg.norm(self.targets[shape] - self.poses[shape].points) for shape in shapes]
        return reach_of([float(motion) for motion in motions], [float(one) for one in left])

    def _slider(self, wanted: ShapeSlider, by: str, residuals: Mapping[str, Residual]) -> Slider:
        channels, shapes = [], []
        for value, shape in wanted.ends:
            curve = _CURVES[value] if len(wanted.ends) == 2 else None
            gains = self.poses[shape].gains
            for joint, channel in np.argwhere(gains != 0.0) if by != "shapes" else ():
                entry = (self.fits.rig.joints[joint], CHANNELS[channel], float(gains[joint, channel]))
                channels.append((entry, curve))
            driven = shape if by == "shapes" else shape + _RESIDUAL if shape in residuals else None
            if driven is not None:
                shapes.append(((driven, 1.0), curve))
        plain = Slider(name=wanted.name, group=wanted.group, minimum=wanted.minimum, mirror=wanted.mirror)
        return with_entries(plain, channels, shapes)

    def _report(self, wanted: ShapeSlider, by: str, residuals: Mapping[str, Residual]) -> MadeSlider:
        poses = [self.poses[shape] for _, shape in wanted.ends]
        # no tolerance: channels that were left out stand at rest to the bit
        moved = np.asarray(np.any([pose.gains != 0.0 for pose in poses], axis=0))
        ends = []
        for _, shape in wanted.ends:
            target, bones, residual = self.targets[shape], self.poses[shape].points, residuals.get(shape)
            end = target if by == "shapes" else bones if residual is None else residual[1]
            motion, left, last = (
                np.linalg.norm(target - one, axis=1) * self.mm for one in (self.fits.points, bones, end)
            )
            points = 0 if residual is None else sum(len(one.point_indices) for one in residual[0] if one)
            # of (n,) lengths in millimetres: the shape's motion, what bones leave, what the slider's end leaves
            rms, rest = (float(np.sqrt((one**2).mean())) for one in (motion, left))
            ends.append(
                EndReport(
                    shape=shape,
                    rms_mm=rms,
                    max_mm=float(motion.max()),
                    left_rms_mm=rest,
                    left_max_mm=float(left.max()),
                    reach=max(0.0, 1.0 - rest / rms) if rms else 0.0,
                    residual_points=points,
                    end_max_mm=float(last.max()),
                )
            )
        return MadeSlider(
            group=wanted.group,
            ends=tuple(ends),
            reach=self.reach(wanted),
            joints=int(moved.any(axis=1).sum()),
            channels=int(moved.sum()),
            symmetric=all(pose.symmetric for pose in poses),
            mirror=wanted.mirror,
            by=by,
        )


@dataclass(frozen=True, kw_only=True)
class SlidersFromShapes(ShapeSliderOptions):
    """Sliders that move the bones of a face as its blendshapes move it.

    Bones are fitted to each shape, within limits, and the slider goes straight from rest to that pose. Sliders of the
    left and the right side get the same pose, mirrored.

    >>> face = facepipe.open("head.usdc")
    >>> with face.deriving("controls.usda") as result:
    ...     report = SlidersFromShapes(shapes="nose_*,l_eye_*,r_eye_*")(result)

    :param shapes: patterns of their names, comma between
    :param limits: over those of the rig
    :param drop: drop all other sliders of the face
    :raises InputError: options out of range
    """

    shapes: str = "*"
    limits: LimitRules = field(default_factory=LimitRules)
    drop: bool = False

    def chosen(self, face: Face) -> tuple[str, ...]:
        """The shapes to make sliders of; the residuals of others are none.

        :raises InputError: a pattern that matches no shape, or a face without shapes
        """
        residuals = {name + _RESIDUAL for name in face.shapes}
        candidates = tuple(name for name in face.shapes if name not in residuals)
        if not candidates:
            raise InputError(face.where, "has no blendshapes, expected some to make sliders of")
        selected = select(candidates, self.shapes, "from-shapes")
        if not selected:
            raise InputError("option from-shapes", "no pattern, expected some of the face's shapes, or *")
        return selected

    @one_thread()
    def __call__(
        self, face: Face, *, recipe: Recipe | None = None, done: Callable[[], object] = lambda: None
    ) -> ShapeSlidersReport:
        """Fit, and author the sliders on `face`; those that it has by the same names are replaced.

        :param recipe: authored with the result; None leaves what the face has
        :param done: called after every shape
        :raises InputError, TopologyError: a face without bones, singular binds, limits that don't fit it or exclude
            rest, or patterns that match no shape; nothing is authored then
        :raises FitError: limits that let a joint shrink to nothing, and a fit that did
        """
        start = time.perf_counter()
        parts, rig, chosen = face.parts(), face.rig(), self.chosen(face)
        check_rig(face.where, parts, rig)
        lower, upper = self.limits.resolve(rig.joints, face.meters_per_unit, parts.bone_limits)
        fits = ShapeFits(rig, lower, upper, self, face.mm_per_unit)
        targets = {shape: rig.evaluate({shape: 1.0}) for shape in chosen}
        # reach is a share of the motion: a shape without any has none
        least = _LEAST / face.mm_per_unit
        still = tuple(shape for shape in chosen if np.abs(targets[shape] - fits.points).max() <= least)
        moving = {shape: targets[shape] for shape in chosen if shape not in still}
        wanted = shape_sliders(tuple(moving), parse_pairs(self.pairs))
        poses = fit_poses(fits, wanted, moving, done)
        mm = parts.meters_per_unit * 1000.0
        maker = SliderMaker(parts=parts, fits=fits, options=self, poses=poses, targets=moving, mm=mm)
        by_name = {slider.name: slider for slider in wanted}
        made = [maker.make(slider, by_name.get(slider.mirror or "")) for slider in wanted]
        for _ in still:
            done()
        new = [slider for _, slider, *_ in made if slider is not None]
        added: list[list[Blendshape]] = [
            [shapes for *_, found, _ in made for one, *_ in found if (shapes := one[number]) is not None]
            for number in range(len(parts.meshes))
        ]
        names = {shape.name for shapes in added for shape in shapes}
        meshes = tuple(
            replace(mesh, blendshapes=(*(shape for shape in mesh.blendshapes if shape.name not in names), *shapes))
            for mesh, shapes in zip(parts.meshes, added, strict=True)
        )
        # new sliders keep the values of those that they replace, beside the others
        valued, _ = with_values(new, parts.sliders)
        others = () if self.drop else tuple(one for one in parts.sliders if one.name not in {each.name for each in new})
        sliders = with_mutual_mirrors((*others, *valued))
        network, lost = fitting_network(parts.slider_network, sliders)
        changed = replace(parts, meshes=meshes, sliders=sliders, slider_network=network, recipe=recipe or parts.recipe)
        authored = author_changes(face, changed)
        report = _report(parts, made, new, sliders)
        return replace(
            report,
            unmoved=still,
            authored=authored,
            seconds=time.perf_counter() - start,
            warnings=(
                *fits.warnings,
                *lost,
                *report.warnings,
                *((f"{len(still)} shapes move nothing: {first_names(still, _SHOWN)}",) if still else ()),
            ),
        )


def _report(
    parts: FaceParts, made: Sequence[Made], new: Sequence[Slider], kept: Sequence[Slider]
) -> ShapeSlidersReport:
    """What is known of the sliders that were made, and of those that the face had."""
    made_names, after = {slider.name for slider in new}, {slider.name for slider in kept}
    beyond = sliders_beyond(new, parts.skeleton.joints, parts.bone_limits)
    left_out = {name: report for name, slider, _, report in made if slider is None}
    lost = sum(flat for _, _, residuals, _ in made for _, _, flat in residuals)
    lines = []
    if left_out:
        names = first_names(tuple(left_out), _SHOWN)
        lines.append(f"{len(left_out)} sliders left out, bones hardly reach their shapes: {names}")
    if lost:
        lines.append(f"{lost} points of residuals can't be corrected: skinning flattens what is around them")
    sliders = [report for *_, report in made]
    groups: dict[str, list[MadeSlider]] = {}
    for slider in sliders:
        groups.setdefault(slider.group, []).append(slider)
    reaches = {}
    for name, members in groups.items():
        ends = [end for slider in members for end in slider.ends]
        # of all ends together, by their squares: a mean of their reaches would let small motions count as large ones
        motions, left = np.array([end.rms_mm for end in ends]), np.array([end.left_rms_mm for end in ends])
        reaches[name] = GroupReach(
            sliders=len(members),
            left_out=sum(not slider.by for slider in members),
            rms_mm=float(np.sqrt((motions**2).mean())),
            left_rms_mm=float(np.sqrt((left**2).mean())),
            reach=reach_of(motions.tolist(), left.tolist()),
        )
    return ShapeSlidersReport(
        sliders={name: report for name, slider, _, report in made if slider is not None},
        left_out=left_out,
        groups=reaches,
        replaced=tuple(slider.name for slider in parts.sliders if slider.name in made_names),
        dropped=tuple(slider.name for slider in parts.sliders if slider.name not in after),
        beyond_limits=beyond,
        warnings=(*lines, *beyond_lines(beyond)),
    )
