"""Sets sliders of a face, and poses it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from facepipe.core.errors import InputError
from facepipe.core.names import identifier, unknown
from facepipe.core.reports import Report
from facepipe.parts import Animation, FaceParts, Recipe, Slider
from facepipe.payload import PayloadContent
from facepipe.rig import slide
from facepipe.stage import Face
from facepipe.stage.animation_source import play
from facepipe.stage.author_changes import author_changes
from facepipe.verbs.apply_bones import beyond_limits, limit_warnings


@dataclass(frozen=True, kw_only=True)
class SetSlidersReport(Report):
    """What was authored."""

    values: Mapping[str, float]  # that were set, twins too
    animation: str
    joints: int  # that leave rest
    shapes: int  # that are on
    beyond_limits: tuple[str, ...] = ()  # "joint:channel" where the pose is beyond the face's limits
    authored: tuple[str, ...] = ()

    def as_text(self, out: Path) -> str:
        """For people."""
        values = ", ".join(f"{name} {value:g}" for name, value in self.values.items()) or "all at their defaults"
        return f"{out}: {values}: {self.joints} joints off rest, {self.shapes} shapes on"


@dataclass(frozen=True, kw_only=True)
class SetSliders:
    """Slider values, and the pose that all sliders of the face make together as a SkelAnimation.

    The face's skeleton plays it: what opens the stage shows the posed face, as `Face.evaluate` gives it with these
    values. A pose of that name is replaced.

    :param values: by slider
    :param mirror: set the twins of symmetric pairs too, unless they are in `values`
    :param reset: set all other sliders to their defaults; else they keep their values
    :param name: of the animation
    """

    values: Mapping[str, float] = field(default_factory=dict)
    mirror: bool = False
    reset: bool = False
    name: str = "sliders"

    def __call__(self, face: Face, *, recipe: Recipe | None = None) -> SetSlidersReport:
        """Author values and pose.

        :param recipe: authored with the result; None leaves what the face has
        :raises InputError: sliders that the face lacks, values out of range, no twin to mirror to, sliders that drive
            joints, channels or shapes that the face lacks, or a clip of that name
        """
        changed, report = self.changed(face)
        authored = author_changes(face, replace(changed, recipe=recipe or changed.recipe))
        play(face, self.name)
        return replace(report, authored=authored)

    def changed(self, face: Face) -> tuple[FaceParts, SetSlidersReport]:
        """The face with its values and the pose, for who authors more beside them, and the report of that.

        :raises InputError: as a call does
        """
        if identifier(self.name) != self.name:
            raise InputError(face.where, f"'{self.name[:40]}' is no name of a prim, expected one like sliders")
        parts = face.parts()
        values = self._all_values(face.where, parts.sliders)
        _check_values(face.where, parts.sliders, values)
        sliders = tuple(self._set(slider, values) for slider in parts.sliders)
        try:
            animation = pose(parts, sliders, self.name)
            # for its check alone: sliders may drive shapes that the face lacks
            face.rig().weight_vector(dict(zip(animation.shapes, _weights(animation), strict=True)))
        except InputError as error:
            raise error.under(face.where) from None
        animations = _with(face.where, parts.animations, animation)
        beyond = _beyond(face, sliders)
        rest = np.array([0.0] * 6 + [1.0] * 3)
        report = SetSlidersReport(
            values=values,
            animation=self.name,
            joints=0 if animation.coefficients is None else int((animation.coefficients[0] != rest).any(axis=1).sum()),
            shapes=sum(weight != 0 for weight in _weights(animation)),
            beyond_limits=beyond,
            warnings=limit_warnings(beyond, clamped=False),
        )
        return replace(parts, sliders=sliders, animations=animations, person=None), report

    def _all_values(self, where: str, sliders: Sequence[Slider]) -> dict[str, float]:
        if not self.mirror:
            return dict(self.values)
        twins = {slider.name: slider.mirror for slider in sliders if slider.mirror is not None}
        mirrored = {twins[name]: value for name, value in self.values.items() if name in twins}
        if not mirrored:
            raise InputError(where, f"none of {', '.join(self.values)} has a mirror, expected one of a symmetric pair")
        return {**mirrored, **self.values}

    def _set(self, slider: Slider, values: Mapping[str, float]) -> Slider:
        value = values.get(slider.name, slider.default if self.reset else slider.value)
        return replace(slider, value=value)


def pose(parts: FaceParts, sliders: Sequence[Slider], name: str) -> Animation:
    """The pose that sliders make at their values: of all joints and shapes that any of them, or their network, drives.

    :raises InputError: no sliders, or some that drive joints or channels that the face lacks
    """
    if not sliders:
        raise InputError("sliders", "none, expected some (`facepipe sliders FACE --from TABLE` authors them)")
    network = parts.slider_network
    coefficients, weights = slide(sliders, parts.skeleton.joints, network=network)
    driven = {joint for slider in sliders for joint, _, _ in slider.channels}
    driven |= set() if network is None else {joint for joint, _ in network.channels}
    joints = [i for i, joint in enumerate(parts.skeleton.joints) if joint in driven]
    return Animation(
        name=name,
        joints=tuple(parts.skeleton.joints[i] for i in joints),
        coefficients=coefficients[joints][None] if joints else None,
        shapes=tuple(sorted(weights)),
        shape_weights=np.array([[weights[shape] for shape in sorted(weights)]]) if weights else None,
    )


def _weights(animation: Animation) -> list[float]:
    return [] if animation.shape_weights is None else [float(one) for one in animation.shape_weights[0]]


def _check_values(where: str, sliders: Sequence[Slider], values: Mapping[str, float]) -> None:
    known = {slider.name: slider for slider in sliders}
    for name, value in values.items():
        if name not in known:
            raise InputError(where, unknown(name, known, "slider"))
        low, high = known[name].minimum, known[name].maximum
        if not low <= value <= high:  # NaN too
            raise InputError(f"{where} -> slider {name}", f"value {value:g}, expected {low:g} to {high:g}")


def _with(where: str, animations: Sequence[Animation], new: Animation) -> tuple[Animation, ...]:
    before = next((animation for animation in animations if animation.name == new.name), None)
    if before is None:
        return (*animations, new)
    if before.times is not None:
        raise InputError(where, f"has a clip '{new.name}' already, expected another name")
    return tuple(new if animation is before else animation for animation in animations)


def _beyond(face: Face, sliders: Sequence[Slider]) -> tuple[str, ...]:
    joints = face.skeleton.joints
    if not joints:
        return ()
    coefficients, _ = slide(sliders, joints, network=face.slider_network)
    content = PayloadContent(joints=joints, coefficients=coefficients, meters_per_unit=face.meters_per_unit)
    return beyond_limits(face, content)
