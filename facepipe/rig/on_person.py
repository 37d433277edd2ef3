"""Animations, sliders and limits relative to a person's rest, which they play on top of."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Animation, BoneLimits, Curve, FaceParts, Skeleton, Slider, SliderNetwork
from facepipe.rig.animation import local_transforms, places
from facepipe.rig.bone_coefficients import (
    CHANNELS,
    coefficient_derivatives,
    coefficient_matrices,
    matrix_coefficients,
    rest_coefficients,
)
from facepipe.rig.person import Person, is_person
from facepipe.rig.rig import Rig
from facepipe.rig.slider_network import evaluate
from facepipe.rig.sliders import channel_entries, clamped_value, response, shape_entries, with_entries
from facepipe.rig.trs import decompose

_NO_GAIN = 1e-9  # of gains
_EXACT_TRANSFORM = 1e-9


@dataclass(frozen=True, kw_only=True)
class NewRest:
    """The skeleton with the person as its rest."""

    skeleton: Skeleton
    stretch: FloatArray  # (j, 3, 3) scale of the person that the joints no longer have, in their own axes

    def carried(self, matrices: FloatArray) -> FloatArray:
        """(..., j, 4, 4) matrices relative to the person's rest of those under the person: translations stretched."""
        result = np.array(matrices, dtype=np.float64)
        result[..., :3, 3] = np.einsum("jab,...jb->...ja", self.stretch, result[..., :3, 3])
        return result


def new_rest(rig: Rig, skeleton: Skeleton, person: Person, *, in_joints: bool) -> NewRest:
    """The person's rest: without the person's scales, or with `in_joints` the transforms alone."""
    local = rig.rest @ person.matrices
    if in_joints:
        unstretched = np.tile(np.eye(3), (len(local), 1, 1))
        return NewRest(skeleton=replace(skeleton, rest_transforms=local), stretch=unstretched)
    world = rig.joint_worlds(local, np.eye(4))
    before = _stretch(rig.joint_worlds(rig.rest.copy(), np.eye(4)))
    after = _stretch(world)
    stretch = np.linalg.solve(before, after)  # of the person alone, in each joint's own axes
    unscaled = world.copy()
    unscaled[:, :3, :3] = world[:, :3, :3] @ np.linalg.inv(stretch)
    above = np.array([np.eye(4) if parent < 0 else unscaled[parent] for parent in rig.parents]).reshape(-1, 4, 4)
    rest = np.linalg.solve(above, unscaled)
    return NewRest(skeleton=replace(skeleton, bind_transforms=unscaled, rest_transforms=rest), stretch=stretch)


def _stretch(worlds: FloatArray) -> FloatArray:
    """(j, 3, 3) symmetric positive stretch K of the linear parts Q K (polar decomposition); mirrors stay in Q."""
    _, scale, Vt = np.linalg.svd(worlds[:, :3, :3])
    return np.asarray((np.swapaxes(Vt, -1, -2) * scale[:, None, :]) @ Vt)


def animations_on(parts: FaceParts, person: Person, new: NewRest) -> tuple[Animation, ...]:
    """The animations as expressions on top of the person.

    Poses of photos hold the person, which is taken off them; a pose that is the person itself is left out. All others
    are expressions already.
    """
    of_photos = {photo.animation for photo in parts.photos}
    return tuple(
        _animation_on(parts, animation, person, new, holds_person=animation.name in of_photos)
        for animation in parts.animations
        if not is_person(parts, animation, person)
    )


def _animation_on(
    parts: FaceParts, animation: Animation, person: Person, new: NewRest, *, holds_person: bool
) -> Animation:
    if holds_person:
        animation = _without(parts, animation, person)
    if not animation.joints or all(
        getattr(animation, field) is None for field in ("translations", "rotations", "scales", "coefficients")
    ):
        return animation
    rows = places(parts.skeleton, animation)
    if animation.coefficients is not None:
        coefficients: FloatArray = np.array(animation.coefficients, dtype=np.float64)
        coefficients[..., :3] = np.einsum("jab,tjb->tja", new.stretch[rows], coefficients[..., :3])
        return replace(animation, coefficients=coefficients, translations=None, rotations=None, scales=None)
    rest = np.asarray(parts.skeleton.rest_transforms, dtype=np.float64)[rows]
    expression: FloatArray = np.linalg.solve(rest, local_transforms(parts.skeleton, animation))
    expression[..., :3, 3] = np.einsum("jab,tjb->tja", new.stretch[rows], expression[..., :3, 3])
    coefficients = matrix_coefficients(expression)
    if np.allclose(
        coefficient_matrices(coefficients), expression, rtol=0, atol=_EXACT_TRANSFORM * max(1.0, np.abs(rest).max())
    ):
        return replace(animation, coefficients=coefficients, translations=None, rotations=None, scales=None)
    # between joints of uneven scale a turn becomes a shear, which nine coefficients do not hold; posed from rest it may
    # be a plain turn again
    posed = decompose(np.asarray(new.skeleton.rest_transforms)[rows] @ expression)
    return replace(animation, translations=posed.translation, rotations=posed.rotation, scales=posed.scale)


def _without(parts: FaceParts, animation: Animation, person: Person) -> Animation:
    """A pose that holds the person, as the expression on top: ``inverse(M(person)) M``, weights less the person's."""
    skeleton, joints = parts.skeleton, parts.skeleton.joints
    count = animation.samples
    local = np.tile(np.asarray(skeleton.rest_transforms, dtype=np.float64), (count, 1, 1, 1))
    local[:, places(skeleton, animation)] = local_transforms(skeleton, animation)
    under = np.asarray(skeleton.rest_transforms, dtype=np.float64) @ person.matrices
    given = np.zeros((count, 0)) if animation.shape_weights is None else np.asarray(animation.shape_weights, np.float64)
    given_weights = dict(zip(animation.shapes, given.T, strict=False))
    names = tuple(sorted({*given_weights, *person.weights}))
    columns = [given_weights.get(name, np.zeros(count)) - person.weights.get(name, 0.0) for name in names]
    return replace(
        animation,
        joints=joints,
        coefficients=matrix_coefficients(np.linalg.solve(under, local)) if joints else None,
        shapes=names,
        shape_weights=np.stack(columns, axis=1) if names else None,
    )


def limits_on(limits: BoneLimits | None, person: Person, new: NewRest) -> BoneLimits | None:
    """The limits that are left for expressions: less the person's translations and angles, by its scales.

    The person itself is always within them.
    """
    if limits is None:
        return None
    rest = rest_coefficients(len(person.coefficients))
    spread = np.ones_like(rest)
    spread[:, :3] = np.abs(np.diagonal(new.stretch, axis1=1, axis2=2))

    def left(values: FloatArray) -> FloatArray:
        values = np.asarray(values, dtype=np.float64)
        scales = person.coefficients[:, 6:]
        moved = (values - person.coefficients) * spread
        moved[:, 6:] = np.where(scales == 0, 1.0, values[:, 6:] / np.where(scales == 0, 1.0, scales))
        return moved

    one, other = left(limits.lower), left(limits.upper)  # a mirrored scale swaps them
    return BoneLimits(lower=np.minimum(np.minimum(one, other), rest), upper=np.maximum(np.maximum(one, other), rest))


def sliders_on(parts: FaceParts, person: Person, new: NewRest) -> tuple[Slider, ...]:
    """The sliders with the person's values as their defaults, which then add nothing.

    Gains are those of the coefficients of ``inverse(M(person)) M(person + change)``, to first order.
    """
    change = _Changes(parts, person, new)
    return tuple(change.slider(slider) for slider in parts.sliders)


def network_on(parts: FaceParts, person: Person, new: NewRest) -> SliderNetwork | None:
    """The learned network of the sliders, adding nothing at the person's values."""
    network = parts.slider_network
    if network is None:
        return None
    change = _Changes(parts, person, new)
    values = {slider.name: clamped_value(slider) for slider in parts.sliders}
    start = evaluate(network, np.array([values[name] for name in network.sliders]))
    rows = [change.channels(joint, channel) for joint, channel in network.channels]
    channels = tuple(dict.fromkeys(key for row in rows for key in row))
    spread = np.zeros((len(channels) + len(network.shapes), len(rows) + len(network.shapes)))
    for column, row in enumerate(rows):
        for key, factor in row.items():
            spread[channels.index(key), column] = factor
    spread[len(channels) :, len(rows) :] = np.eye(len(network.shapes))
    # the last layer is straight: what channels become, and what the person has already, go into its numbers
    return replace(
        network,
        channels=channels,
        weights=(*network.weights[:-1], spread @ network.weights[-1]),
        biases=(*network.biases[:-1], spread @ (network.biases[-1] - start)),
    )


class _Changes:
    """Changes of one bone coefficient of a joint, relative to the person's rest."""

    def __init__(self, parts: FaceParts, person: Person, new: NewRest) -> None:
        self.index = {joint: i for i, joint in enumerate(parts.skeleton.joints)}
        inverse = np.linalg.pinv(coefficient_matrices(person.coefficients))
        by = inverse[:, None] @ coefficient_derivatives(person.coefficients)  # (j, 9, 4, 4)
        turns = by[..., :3, :3]
        angles = np.stack([turns[..., i - 1, i - 2] - turns[..., i - 2, i - 1] for i in range(3)], axis=-1) / 2
        moves = np.einsum("jab,jkb->jka", new.stretch, by[..., :3, 3])
        self.by = np.concatenate([moves, angles, np.diagonal(turns, axis1=-2, axis2=-1)], axis=-1)  # (j, 9, 9)

    def channels(self, joint: str, channel: str) -> dict[tuple[str, str], float]:
        """Factor of every channel that a change of one becomes."""
        row = self.by[self.index[joint], CHANNELS.index(channel)].tolist()
        return {(joint, name): by for name, by in zip(CHANNELS, row, strict=True) if abs(by) > _NO_GAIN}

    def slider(self, slider: Slider) -> Slider:
        """The slider on top of the person."""
        value = clamped_value(slider)
        gains: dict[tuple[str, str, Curve | None], float] = defaultdict(float)
        for (joint, channel, gain), curve in channel_entries(slider):
            for (moved_joint, name), factor in self.channels(joint, channel).items():
                gains[moved_joint, name, _shifted(curve, value, slider.default)] += gain * factor
        return replace(
            with_entries(
                slider,
                [((joint, channel, gain), curve) for (joint, channel, curve), gain in gains.items()],
                [(entry, _shifted(curve, value, slider.default)) for entry, curve in shape_entries(slider)],
            ),
            default=value,
            value=None,
        )


def _shifted(curve: Curve | None, value: float, default: float) -> Curve | None:
    """The curve less what it is at `value`."""
    if curve is None:
        return None
    start = response(curve, value, default)
    return tuple((at, amount - start) for at, amount in curve)
