"""One slider of a shape's pose, or of the poses of two."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Curve, FaceParts, Slider
from facepipe.processors.fit_bones.options import STRICTER
from facepipe.processors.fit_bones.residual import Residual, corrective
from facepipe.processors.sliders.shape_fits import ShapeFits, ShapePose
from facepipe.processors.sliders.shape_names import ShapeSlider
from facepipe.processors.sliders.shape_options import ShapeSliderOptions
from facepipe.processors.sliders.shape_report import MadeSlider, end_report, reach_of
from facepipe.rig import CHANNELS
from facepipe.rig.sliders import with_entries

RESIDUAL = "_residual"  # what the name of a shape's corrective ends in

_CURVES: Mapping[float, Curve] = {-1.0: ((-1.0, 1.0), (0.0, 0.0)), 1.0: ((0.0, 0.0), (1.0, 1.0))}


@dataclass(frozen=True, kw_only=True)
class Made:
    """A slider with the shapes that it needs; None where it was left out."""

    name: str
    slider: Slider | None
    residuals: tuple[Residual, ...]
    report: MadeSlider


class SliderMaker:
    """Makes the sliders of one face.

    :param parts: what the rig of `fits` was built from
    :param poses: shape -> pose
    :param targets: shape -> (n, 3) points
    :param mm: millimetres in a stage unit
    """

    def __init__(
        self,
        parts: FaceParts,
        fits: ShapeFits,
        options: ShapeSliderOptions,
        poses: Mapping[str, ShapePose],
        targets: Mapping[str, FloatArray],
        mm: float,
    ) -> None:
        self.parts, self.fits, self.options, self.poses, self.targets, self.mm = (
            parts,
            fits,
            options,
            poses,
            targets,
            mm,
        )

    def make(self, wanted: ShapeSlider, twin: ShapeSlider | None) -> Made:
        """The slider, by what it and its mirror reach together: bones, with a residual or not, shapes, or nothing."""
        reached = self.reach(*((wanted,) if twin is None else (wanted, twin))) >= self.options.least_reach
        residual = self.options.residual
        found = {shape: self._residual(shape) for _, shape in wanted.ends} if reached and residual else {}
        residuals = {shape: one for shape, one in found.items() if one is not None}
        by = ("bones and residual" if residuals else "bones") if reached else "shapes" if residual else ""
        return Made(
            name=wanted.name,
            slider=self._slider(wanted, by, residuals) if by else None,
            residuals=tuple(residuals.values()),
            report=self._report(wanted, by, residuals),
        )

    def reach(self, *sliders: ShapeSlider) -> float:
        """How much of the motion of sliders' shapes bones make."""
        shapes = sorted(shape for slider in sliders for _, shape in slider.ends)  # as of the mirror, to the last digit
        motions = [np.linalg.norm(self.targets[shape] - self.fits.points) for shape in shapes]
        left = [np.linalg.norm(self.targets[shape] - self.poses[shape].points) for shape in shapes]
        return reach_of([float(one) for one in motions], [float(one) for one in left])

    def _residual(self, shape: str) -> Residual | None:
        """What bones leave beyond the threshold."""
        pose, target = self.poses[shape], self.targets[shape]
        off = np.linalg.norm(pose.points - target, axis=1) * self.mm
        corrected = off > STRICTER * self.options.threshold_mm
        if not corrected.any():
            return None
        coefficients = self.fits.rest + pose.gains
        return corrective(self.parts, self.fits.rig, shape + RESIDUAL, coefficients, target, corrected)

    def _slider(self, wanted: ShapeSlider, by: str, residuals: Mapping[str, Residual]) -> Slider:
        channels, shapes = [], []
        for value, shape in wanted.ends:
            curve = _CURVES[value] if len(wanted.ends) == 2 else None
            gains = self.poses[shape].gains
            for joint, channel in np.argwhere(gains != 0.0) if by != "shapes" else ():
                entry = (self.fits.rig.joints[joint], CHANNELS[channel], float(gains[joint, channel]))
                channels.append((entry, curve))
            driven = shape if by == "shapes" else shape + RESIDUAL if shape in residuals else None
            if driven is not None:
                shapes.append(((driven, 1.0), curve))
        plain = Slider(name=wanted.name, group=wanted.group, minimum=wanted.minimum, mirror=wanted.mirror)
        return with_entries(plain, channels, shapes)

    def _report(self, wanted: ShapeSlider, by: str, residuals: Mapping[str, Residual]) -> MadeSlider:
        poses = [self.poses[shape] for _, shape in wanted.ends]
        moved = np.asarray(np.any([pose.gains != 0.0 for pose in poses], axis=0))
        ends = []
        for _, shape in wanted.ends:
            target, bones, residual = self.targets[shape], self.poses[shape].points, residuals.get(shape)
            end = target if by == "shapes" else bones if residual is None else residual.points
            motion, left, last = (
                np.linalg.norm(target - one, axis=1) * self.mm for one in (self.fits.points, bones, end)
            )
            points = 0 if residual is None else sum(len(one.point_indices) for one in residual.shapes if one)
            ends.append(end_report(shape, motion, left, last, points))
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
