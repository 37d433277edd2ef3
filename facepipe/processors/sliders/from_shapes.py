"""Makes sliders of a face's blendshapes, by fitting its bones to them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.errors import InputError
from facepipe.names import select
from facepipe.parts import Blendshape, Curve, FaceParts, FloatArray, Recipe, Slider
from facepipe.processors.fit_bones.limits import LimitRules
from facepipe.processors.fit_bones.residual import Residual, corrective
from facepipe.processors.fit_bones.rig_checks import check_rig
from facepipe.processors.fit_bones.sessions import STRICTER
from facepipe.processors.sliders.author_sliders import mutual, sliders_beyond
from facepipe.processors.sliders.shape_fits import ShapeFits, ShapePose
from facepipe.processors.sliders.shape_names import ShapeSlider, parse_pairs, shape_sliders
from facepipe.processors.sliders.shape_options import ShapeSliderOptions
from facepipe.processors.sliders.shape_report import EndReport, MadeSlider, ShapeSlidersReport, by_group, end_report
from facepipe.rig import CHANNELS, Rig
from facepipe.rig.sliders import with_entries
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes

RESIDUAL = "_residual"  # what the name of a shape's corrective ends in

_SHOWN = 4  # names of a list
_LEAST_MOTION = 1e-6  # mm: less is none
_CURVES: Mapping[float, Curve] = {-1.0: ((-1.0, 1.0), (0.0, 0.0)), 1.0: ((0.0, 0.0), (1.0, 1.0))}


@dataclass(frozen=True, kw_only=True)
class SlidersFromShapes(ShapeSliderOptions):
    """Sliders that move the bones of a face as its blendshapes move it.

    Each shape is fitted by the bones, within limits, and the slider goes straight from rest to that pose. Sliders of
    the left and the right side get the same pose, mirrored.

    >>> face = facepipe.open("head.usda")
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
        """The shapes to make sliders of; residuals of others among them are none.

        :raises InputError: a pattern that matches no shape, or a face without shapes
        """
        own = tuple(name for name in face.shapes if name.removesuffix(RESIDUAL) not in {*face.shapes} - {name})
        if not own:
            raise InputError(face.where, "has no blendshapes, expected some to make sliders of")
        found = select(own, self.shapes, "from-shapes")
        if not found:
            raise InputError("option from-shapes", "no pattern, expected some of the face's shapes, or *")
        return found

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
        targets = {shape: rig.evaluate({shape: 1.0}) for shape in chosen}
        fits = ShapeFits(rig, lower, upper, self, face.mm_per_unit)
        made = _Making(self, parts, fits, targets, face.mm_per_unit)
        made.make(shape_sliders(chosen, parse_pairs(self.pairs)), done)
        result = self._merged(made.authored_parts(), made.sliders)
        authored = author_changes(face, replace(result, recipe=recipe or parts.recipe))
        report = made.report()
        names, kept = {one.name for one in made.sliders}, {one.name for one in result.sliders}
        return replace(
            report,
            replaced=tuple(one.name for one in parts.sliders if one.name in names),
            dropped=tuple(one.name for one in parts.sliders if one.name not in kept),
            beyond_limits=sliders_beyond(made.sliders, rig.joints, parts.bone_limits),
            authored=authored,
            seconds=time.perf_counter() - start,
        )

    def _merged(self, parts: FaceParts, new: Sequence[Slider]) -> FaceParts:
        """The face with new sliders beside those that it keeps."""
        names = {one.name for one in new}
        others = () if self.drop else tuple(one for one in parts.sliders if one.name not in names)
        unknown = names | {one.name for one in others}
        others = tuple(replace(one, mirror=one.mirror if one.mirror in unknown else None) for one in others)
        return replace(parts, sliders=mutual((*others, *new)))


class _Making:
    """The sliders of one face while they are made."""

    def __init__(
        self, options: ShapeSliderOptions, parts: FaceParts, fits: ShapeFits, targets: Mapping[str, FloatArray], mm: float
    ) -> None:
        self.options, self.parts, self.fits, self.targets, self.mm = options, parts, fits, targets, mm
        self.rig: Rig = fits.rig
        self.sliders: list[Slider] = []
        self.made: dict[str, MadeSlider] = {}
        self.left_out: dict[str, MadeSlider] = {}
        self.residuals: dict[str, Residual] = {}
        motions = {shape: np.linalg.norm(target - fits.points, axis=1) for shape, target in targets.items()}
        self.motions = motions
        self.unmoved = tuple(shape for shape in targets if motions[shape].max(initial=0.0) * mm <= _LEAST_MOTION)

    def make(self, wanted: Sequence[ShapeSlider], done: Callable[[], object]) -> None:
        """Fit all, and keep what bones reach."""
        poses = self._poses([shape for shape in self.targets if shape not in self.unmoved], wanted, done)
        for _ in self.unmoved:
            done()
        by_name = {one.name: one for one in wanted}
        reports = {one.name: self._ends(one, poses) for one in wanted}
        for slider in wanted:
            own = reports[slider.name]
            twin = reports[slider.mirror] if slider.mirror else ()
            if not own:
                continue
            reached = _reach((*own, *twin)) >= self.options.least_reach
            mirror = slider.mirror if slider.mirror and reports[by_name[slider.mirror].name] else None
            self._add(replace(slider, mirror=mirror), own, poses, reached)
