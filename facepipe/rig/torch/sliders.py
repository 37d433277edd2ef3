"""Sliders to bone coefficients and shape weights, as `facepipe.rig.slide` defines it, with gradients.

That is sums of piecewise-linear functions of single inputs, and the learned network of a face's sliders.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.parts import Curve, Slider, SliderNetwork
from facepipe.rig import CHANNELS, rest_coefficients
from facepipe.rig.sliders import channel_entries, check_network, response, shape_entries

ACTIVATIONS = {"tanh": torch.tanh, "relu": torch.relu, "silu": torch.nn.functional.silu}


@dataclass(frozen=True, kw_only=True)
class Term:
    """``base + slope * x[input] + sum(change * max(x[input] - at, 0))``, added to one output."""

    output: int
    input: int
    base: float = 0.0
    slope: float = 0.0
    bends: tuple[tuple[float, float], ...] = ()  # (at, change of slope)


class PiecewiseLinear:
    """(..., inputs) -> (..., outputs).

    At a bend the derivative is the mean of both sides, as central differences have it, so that a slider whose two
    halves meet at its default can leave it either way.
    """

    def __init__(
        self, terms: Sequence[Term], inputs: int, base: FloatArray, dtype: torch.dtype, device: torch.device | str
    ) -> None:
        """:param base: (outputs,) what the terms add to"""
        # y = b + s x + sum c max(x - a, 0): terms with a bend at the same a share its column, so all is one product.
        bends = sorted({(term.input, at) for term in terms for at, _ in term.bends})
        column = {bend: inputs + i for i, bend in enumerate(bends)}
        matrix = np.zeros((inputs + len(bends), len(base)))
        constant = np.array(base, dtype=np.float64)
        for term in terms:
            constant[term.output] += term.base
            matrix[term.input, term.output] += term.slope
            for at, change in term.bends:
                matrix[column[term.input, at], term.output] += change
        self._matrix = torch.as_tensor(matrix, dtype=dtype, device=device)
        self._constant = torch.as_tensor(constant, dtype=dtype, device=device)
        self._bent = torch.as_tensor([own for own, _ in bends], dtype=torch.int64, device=device)
        self._at = torch.as_tensor([at for _, at in bends], dtype=dtype, device=device)

    def __call__(self, x: Tensor) -> Tensor:
        """(..., outputs) of (..., inputs)."""
        if len(self._bent):
            past = x.index_select(-1, self._bent) - self._at
            x = torch.cat([x, (past + past.abs()) / 2], dim=-1)
        return x @ self._matrix + self._constant


class DifferentiableNetwork:
    """Clamped slider values (..., s) to what the network adds to all bone coefficients and shape weights."""

    def __init__(
        self,
        network: SliderNetwork,
        sliders: Sequence[str],
        joints: Sequence[str],
        shapes: Sequence[str],
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> None:
        """:raises InputError: a damaged network, or one of a slider, joint, channel or shape that is not there"""
        check_network(network, sliders, joints)
        for shape in network.shapes:
            if shape not in shapes:
                raise InputError("slider network", f"no shape '{shape}'")
        columns = [9 * list(joints).index(joint) + CHANNELS.index(channel) for joint, channel in network.channels]
        columns += [9 * len(joints) + list(shapes).index(shape) for shape in network.shapes]
        self._layers = [
            tuple(torch.as_tensor(np.asarray(one, dtype=np.float64), dtype=dtype, device=device) for one in layer)
            for layer in zip(network.weights, network.biases, strict=True)
        ]
        self._activation = ACTIVATIONS[network.activation]
        self._inputs = torch.as_tensor([list(sliders).index(name) for name in network.sliders], device=device)
        self._columns = torch.as_tensor(columns, device=device)
        self._outputs = 9 * len(joints) + len(shapes)

    def __call__(self, values: Tensor) -> Tensor:
        """(..., 9 j + shapes)."""
        units = values.index_select(-1, self._inputs)
        for number, (weight, bias) in enumerate(self._layers):
            if number:
                units = self._activation(units)
            units = units @ weight.T + bias
        full = units.new_zeros(*units.shape[:-1], self._outputs)
        return full.index_copy(-1, self._columns, units)


class DifferentiableSliders:
    """Slider values (..., s), in the order of `names`, to bone coefficients and shape weights.

    Where it `moves_joints`; else the coefficients are those at rest, whatever the values.
    """

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
        terms = []
        for number, slider in enumerate(sliders):
            for (joint, channel, gain), curve in channel_entries(slider):
                if joint not in joints or channel not in CHANNELS:
                    raise InputError(f"slider {slider.name}", f"no joint '{joint}' with a channel '{channel}'")
                output = 9 * list(joints).index(joint) + CHANNELS.index(channel)
                terms.append(_term(number, output, slider, gain, curve))
            for (shape, gain), curve in shape_entries(slider):
                if shape not in shapes:
                    raise InputError(f"slider {slider.name}", f"no shape '{shape}'")
                terms.append(_term(number, 9 * len(joints) + list(shapes).index(shape), slider, gain, curve))
        self.moves_joints = any(term.output < 9 * len(joints) for term in terms)
        self.moves_joints |= network is not None and bool(network.channels)
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
