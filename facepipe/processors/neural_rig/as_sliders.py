"""What a neural rig makes of its controls as sliders of a face, and the network beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import FaceParts, Slider, SliderNetwork
from facepipe.rig import CHANNELS
from facepipe.rig.neural_rig import Control, NeuralRig


def shape_name(number: int) -> str:
    """Of a shape of the basis."""
    return f"neural_{number:03d}"


def _names(rig: NeuralRig, joints: Sequence[str]) -> list[tuple[str, str]]:
    return [(joints[joint], CHANNELS[channel]) for joint, channel in rig.channels.tolist()]


def _factors(parts: FaceParts, rig: NeuralRig, scales: FloatArray) -> FloatArray:
    """(r + m,) from the rig's outputs to shape weights and bone coefficients of the face."""
    smaller = 0.001 / parts.meters_per_unit
    return np.concatenate([1.0 / scales, np.where(rig.channels[:, 1] < 3, smaller, 1.0)])


def neural_sliders(parts: FaceParts, rig: NeuralRig, scales: FloatArray) -> tuple[Slider, ...]:
    """The controls, with what is straight of what they do; mirrors as on the face.

    :param scales: (r,) activations of shapes, millimetres, at which their weights are 1
    """
    own, count = {one.name: one for one in parts.sliders}, len(rig.shapes)
    channels = _names(rig, parts.skeleton.joints)
    found = []
    for control, row in zip(rig.controls, rig.linear * _factors(parts, rig, scales), strict=True):
        gains = (row / (control.maximum - control.minimum)).tolist()
        pairs = zip(channels, gains[count:], strict=True)
        slider = Slider(
            name=control.name,
            default=control.default,
            minimum=control.minimum,
            maximum=control.maximum,
            channels=tuple((*channel, gain) for channel, gain in pairs if gain),
            shapes=tuple((shape_name(i), gain) for i, gain in enumerate(gains[:count]) if gain),
        )
        found.append(_as_before(slider, control, own.get(control.name)))
    return tuple(found)


def _as_before(slider: Slider, control: Control, before: Slider | None) -> Slider:
    """With the group, mirror and value that the face's slider of that name has."""
    if before is None:
        return slider
    value = before.value
    if value is not None and not control.minimum <= value <= control.maximum:
        value = None
    return replace(slider, group=before.group, mirror=before.mirror, value=value)


def neural_network(parts: FaceParts, rig: NeuralRig, scales: FloatArray) -> SliderNetwork | None:
    """The hidden layer over plain values; the shares of their ranges are in its weights. None without units."""
    if not len(rig.hidden):
        return None
    low, high, rest = (
        np.array([getattr(one, key) for one in rig.controls]) for key in ("minimum", "maximum", "default")
    )
    first = rig.hidden / (high - low)
    count, factors = len(rig.shapes), _factors(parts, rig, scales)
    order = np.roll(np.arange(len(factors)), -count)  # channels before shapes
    return SliderNetwork(
        sliders=tuple(control.name for control in rig.controls),
        channels=tuple(_names(rig, parts.skeleton.joints)),
        shapes=tuple(shape_name(i) for i in range(count)),
        weights=(first, (rig.last * factors[:, None])[order]),
        biases=(rig.hidden_bias - first @ rest, (rig.last_bias * factors)[order]),
        activation="silu",
        info={"kind": "neural rig", "topology": rig.topology},
    )
