"""Authors sliders on a face: those of a table, and a learned network beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from facepipe.core import tokens
from facepipe.core.errors import InputError
from facepipe.core.names import first_names, identifier, unknown
from facepipe.core.reports import Report
from facepipe.parts import Animation, BoneLimits, FaceParts, Recipe, Slider, SliderNetwork
from facepipe.payload import PayloadContent
from facepipe.rig import CHANNELS, slide
from facepipe.rig.sliders import sliders_fault
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes
from facepipe.stage.face import play
from facepipe.stage.prims import check_property_name
from facepipe.verbs.bone_payload import beyond_limits, check_limits, limit_warnings
from facepipe.verbs.sliders.tables import SliderTable

_SHOWN = 4  # names of a list


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
        values = dict(self.values)
        if self.mirror:
            twins = {slider.name: slider.mirror for slider in parts.sliders if slider.mirror is not None}
            mirrored = {twins[name]: value for name, value in values.items() if name in twins}
            if not mirrored:
                what = f"none of {', '.join(values)} has a mirror, expected one of a symmetric pair"
                raise InputError(face.where, what)
            values = {**mirrored, **values}
        known = {slider.name: slider for slider in parts.sliders}
        for name, value in values.items():
            if name not in known:
                raise InputError(face.where, unknown(name, known, "slider"))
            low, high = known[name].minimum, known[name].maximum
            if not low <= value <= high:  # NaN too
                raise InputError(f"{face.where} -> slider {name}", f"value {value:g}, expected {low:g} to {high:g}")
        sliders = tuple(
            replace(one, value=values.get(one.name, one.default if self.reset else one.value)) for one in parts.sliders
        )
        try:
            animation = pose(parts, sliders, self.name)
            # for its check alone: sliders may drive shapes that the face lacks
            face.rig().weight_vector(dict(zip(animation.shapes, _weights(animation), strict=True)))
        except InputError as error:
            raise error.under(face.where) from None
        before = {one.name: one for one in parts.animations}.get(self.name)
        if before is not None and before.times is not None:
            raise InputError(face.where, f"has a clip '{self.name}' already, expected another name")
        if before is None:
            animations = (*parts.animations, animation)
        else:
            animations = tuple(animation if one is before else one for one in parts.animations)
        beyond, joints = tuple[str, ...](), parts.skeleton.joints
        if joints:
            coefficients, _ = slide(sliders, joints, network=parts.slider_network)
            content = PayloadContent(joints=joints, coefficients=coefficients, meters_per_unit=face.meters_per_unit)
            beyond = beyond_limits(face, content)
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


@dataclass(frozen=True, kw_only=True)
class AuthorSlidersReport(Report):
    """What was authored."""

    sliders: tuple[str, ...]  # of the table
    replaced: tuple[str, ...] = ()  # that the face had by the same name
    dropped: tuple[str, ...] = ()  # that the face had and has no more
    channels: int = 0  # that the table's sliders drive, each counted once
    shapes: int = 0
    beyond_limits: tuple[str, ...] = ()  # "slider -> joint:channel" where one slider can leave the face's limits
    authored: tuple[str, ...] = ()

    def as_text(self, out: Path) -> str:
        """For people."""
        kept = f", {len(self.replaced)} of them replaced" if self.replaced else ""
        dropped = f", {len(self.dropped)} dropped" if self.dropped else ""
        over = f"over {self.channels} channels and {self.shapes} shapes"
        return f"{out}: {len(self.sliders)} sliders{kept}, {over}{dropped}"


@dataclass(frozen=True, kw_only=True)
class AuthorSliders:
    """The sliders of a table on a face; those that it has by the same names are replaced, and keep their values.

    A mirror that is named on one side only is named on the other too.

    :param drop: drop all other sliders of the face
    """

    table: SliderTable
    drop: bool = False

    def __call__(self, face: Face, *, recipe: Recipe | None = None) -> AuthorSlidersReport:
        """Author them.

        :param recipe: authored with the result; None leaves what the face has
        :raises InputError: names that USD can't hold, joints, channels, shapes or mirrors that the face lacks, or
            limits of the face that cross
        """
        for rule in self.table.rules:
            check_property_name(rule.where, "slider", rule.name, tokens.SLIDER_API)
        parts = face.parts()
        new = self.table.resolve(parts.skeleton.joints, face.shapes, parts.meters_per_unit)
        names = {slider.name for slider in new}
        valued, unset = with_values(new, parts.sliders)
        others = () if self.drop else tuple(slider for slider in parts.sliders if slider.name not in names)
        # over new and kept ones: a new slider may name a kept one as its mirror
        sliders = (*others, *valued)
        # the sliders, a mirror that is named on one side only named on the other too
        named = {slider.mirror: slider.name for slider in sliders if slider.mirror is not None}
        merged = tuple(replace(slider, mirror=slider.mirror or named.get(slider.name)) for slider in sliders)
        fault = sliders_fault(merged)
        if fault:
            where = {rule.name: rule.where for rule in self.table.rules}
            raise InputError(where.get(fault[0], f"{self.table.where} -> slider {fault[0]} of the face"), fault[1])
        beyond = sliders_beyond(new, parts.skeleton.joints, parts.bone_limits)
        network, lost = fitting_network(parts.slider_network, merged)
        idle = [slider.name for slider in new if not slider.channels and not slider.shapes]
        none = (f"{len(idle)} sliders drive nothing: {first_names(idle, _SHOWN)}",) if idle else ()
        changed = replace(parts, sliders=merged, slider_network=network, recipe=recipe or parts.recipe)
        authored = author_changes(face, changed)
        return AuthorSlidersReport(
            sliders=tuple(slider.name for slider in new),
            replaced=tuple(slider.name for slider in parts.sliders if slider.name in names),
            dropped=tuple(slider.name for slider in parts.sliders if slider.name not in names and self.drop),
            channels=len({entry[:2] for slider in new for entry in slider.channels}),
            shapes=len({entry[0] for slider in new for entry in slider.shapes}),
            beyond_limits=beyond,
            authored=authored,
            warnings=(*unset, *lost, *none, *beyond_lines(beyond)),
        )


def sliders_beyond(sliders: Sequence[Slider], joints: Sequence[str], limits: BoneLimits | None) -> tuple[str, ...]:
    """``slider -> joint:channel`` where a slider at an end of its range, all others at their default, is beyond limits.

    :raises InputError: limits that cross
    """
    if limits is None:
        return ()
    check_limits(joints, limits)
    reaching = []
    start, _ = slide(sliders, joints, {slider.name: slider.default for slider in sliders})
    for slider in sliders:
        low, middle, high = (
            slide((slider,), joints, {slider.name: value})[0]
            for value in (slider.minimum, slider.default, slider.maximum)
        )
        ends = [(start - middle + end).astype(np.float32) for end in (low, high)]
        beyond = np.any([(one < limits.lower) | (one > limits.upper) for one in ends], axis=0)
        reaching += [f"{slider.name} -> {joints[joint]}:{CHANNELS[channel]}" for joint, channel in np.argwhere(beyond)]
    return tuple(reaching)


def with_values(new: Sequence[Slider], known: Sequence[Slider]) -> tuple[tuple[Slider, ...], tuple[str, ...]]:
    """Sliders with the values that the face gave them, and a line for each that is out of the new range."""
    lines, valued = [], []
    values = {slider.name: slider.value for slider in known}
    for slider in new:
        value = values.get(slider.name)
        if value is not None and not slider.minimum <= value <= slider.maximum:
            lines.append(f"slider {slider.name}: value {value:g} is out of its new range, now the default")
            value = None
        valued.append(replace(slider, value=value))
    return tuple(valued), tuple(lines)


def beyond_lines(beyond: Sequence[str]) -> tuple[str, ...]:
    """A warning of channels that single sliders move beyond limits."""
    if not beyond:
        return ()
    some = first_names(beyond, _SHOWN)
    return (f"{len(beyond)} channels of single sliders reach beyond the limits of the face: {some}",)


@dataclass(frozen=True, kw_only=True)
class AuthorNetworkReport(Report):
    """What was authored."""

    sliders: tuple[str, ...]  # that go in
    channels: int  # that are added to
    shapes: int
    layers: tuple[int, ...]  # numbers that go into the first, and that come out of each
    replaced: bool  # the face had another network
    authored: tuple[str, ...] = ()

    def as_text(self, out: Path) -> str:
        """For people."""
        layers, replaced = " -> ".join(map(str, self.layers)), ", in place of another" if self.replaced else ""
        return f"{out}: a network {layers}{replaced}, over {self.channels} channels and {self.shapes} shapes"


@dataclass(frozen=True, kw_only=True)
class AuthorNetwork:
    """A learned network on a face, which adds to what its sliders do; one that it has is replaced."""

    network: SliderNetwork

    def __call__(self, face: Face, *, recipe: Recipe | None = None) -> AuthorNetworkReport:
        """Author it.

        :param recipe: authored with the result; None leaves what the face has
        :raises InputError: a damaged network, or one of sliders, joints, channels or shapes that the face lacks
        """
        parts, network = face.parts(), self.network
        try:
            # both for their checks alone: damaged layers, and names that the face lacks
            slide(parts.sliders, parts.skeleton.joints, network=network)
            face.rig().weight_vector(dict.fromkeys(network.shapes, 0.0))
        except InputError as error:
            raise error.under(face.where) from None
        changed = replace(parts, slider_network=network, recipe=recipe or parts.recipe)
        authored = author_changes(face, changed)
        return AuthorNetworkReport(
            sliders=network.sliders,
            channels=len(network.channels),
            shapes=len(network.shapes),
            layers=(len(network.sliders), *(len(bias) for bias in network.biases)),
            replaced=parts.slider_network is not None,
            authored=authored,
        )


def fitting_network(
    network: SliderNetwork | None, sliders: Sequence[Slider]
) -> tuple[SliderNetwork | None, tuple[str, ...]]:
    """The network of a face that gets other `sliders`, and a warning where it can't stay: one of its own is gone."""
    if network is None:
        return None, ()
    known = {slider.name for slider in sliders}
    gone = [name for name in network.sliders if name not in known]
    if not gone:
        return network, ()
    return None, (f"the learned network of the sliders is dropped: it needs '{gone[0]}'",)
