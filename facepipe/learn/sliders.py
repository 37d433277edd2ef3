"""Sliders to bone coefficients and shape weights, as `facepipe.rig.slide` defines it, with gradients."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from facepipe.core.errors import InputError
from facepipe.learn.piecewise_linear import PiecewiseLinear, Term
from facepipe.learn.slider_network import DifferentiableNetwork
from facepipe.parts import Curve, Slider, SliderNetwork
from facepipe.rig import CHANNELS, rest_coefficients
from facepipe.rig.sliders import channel_entries, response, shape_entries


class DifferentiableSliders:
    """Slider values (..., s), in the order of `names`, to bone coefficients and shape weights."""

    def __init__(
        self,
        sliders: Sequence[Slider],
        joints: Sequence[str],
        shapes: Sequence[str],
        dtype: torch.dtype,
        device: torch.device | str,
        network: SliderNetwork | None = None,
    ) -> None:
        """
        :param network: of the face, which adds to what the sliders do
        :raises InputError: a slider or network of a joint, channel or shape that is not there
        """
        self.names = tuple(slider.name for slider in sliders)
        self.lower, self.upper, self.default, self.value = (
            torch.as_tensor(np.array(numbers, dtype=np.float64), dtype=dtype, device=device)
            for numbers in (
                [slider.minimum for slider in sliders],
                [slider.maximum for slider in sliders],
                [slider.default for slider in sliders],
                [slider.default if slider.value is None else slider.value for slider in sliders],
            )
        )
        self._joints = len(joints)
        base = np.concatenate([rest_coefficients(len(joints)).ravel(), np.zeros(len(shapes))])
        terms = [term for i, slider in enumerate(sliders) for term in _terms(i, slider, joints, shapes)]
        self._map = PiecewiseLinear(terms, len(sliders), base, dtype, device)
        self._network: DifferentiableNetwork | None = None
        if network is not None:
            self._network = DifferentiableNetwork(network, self.names, joints, shapes, dtype, device)

    def __call__(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Bone coefficients (..., j, 9) and shape weights (..., shapes); values are clamped to their range.

        A value beyond its range gets no gradient, one at its end does.
        """
        clamped = torch.minimum(torch.maximum(values, self.lower), self.upper)
        clamped = torch.where(self.lower < self.upper, clamped, self.lower)  # a single value has no gradient
        result = self._map(clamped)
        if self._network is not None:
            result = result + self._network(clamped)
        bones = 9 * self._joints
        return result[..., :bones].unflatten(-1, (self._joints, 9)), result[..., bones:]


def _terms(number: int, slider: Slider, joints: Sequence[str], shapes: Sequence[str]) -> list[Term]:
    terms = []
    for (joint, channel, gain), curve in channel_entries(slider):
        if joint not in joints or channel not in CHANNELS:
            raise InputError(f"slider {slider.name}", f"no joint '{joint}' with a channel '{channel}'")
        output = 9 * list(joints).index(joint) + CHANNELS.index(channel)
        terms.append(_term(number, output, slider, gain, curve))
    for (shape, gain), curve in shape_entries(slider):
        if shape not in shapes:
            raise InputError(f"slider {slider.name}", f"no shape '{shape}'")
        terms.append(_term(number, 9 * len(joints) + list(shapes).index(shape), slider, gain, curve))
    return terms


def _term(number: int, output: int, slider: Slider, gain: float, curve: Curve | None) -> Term:
    """The response of one entry, as hinges inside the slider's range: clamped values never bend outside it."""
    if curve is None:
        return Term(output=output, input=number, base=-gain * slider.default, slope=gain)
    inside = [at for at, _ in curve if slider.minimum < at < slider.maximum]
    at = np.array([slider.minimum, *inside, slider.maximum])
    if at[0] == at[-1]:
        return Term(output=output, input=number, base=gain * response(curve, float(at[0]), slider.default))
    amounts = gain * np.array([response(curve, float(one), slider.default) for one in at])
    slopes = np.diff(amounts) / np.diff(at)
    return Term(
        output=output,
        input=number,
        base=float(amounts[0] - slopes[0] * at[0]),
        slope=float(slopes[0]),
        bends=tuple((float(at[i]), float(slopes[i] - slopes[i - 1])) for i in range(1, len(slopes))),
    )
