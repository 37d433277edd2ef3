"""The learned network of a face's sliders, as `facepipe.rig.slider_network` defines it, with gradients."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from facepipe.core.errors import InputError
from facepipe.parts import SliderNetwork
from facepipe.rig import CHANNELS
from facepipe.rig.slider_network import check_network

_ACTIVATIONS = {"tanh": torch.tanh, "relu": torch.relu, "silu": torch.nn.functional.silu}


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
        self._activation = _ACTIVATIONS[network.activation]
        self._inputs = torch.as_tensor([list(sliders).index(name) for name in network.sliders], device=device)
        self._columns = torch.as_tensor(columns, device=device)
        self._outputs = 9 * len(joints) + len(shapes)

    def __call__(self, values: Tensor) -> Tensor:
        """(..., 9 j + shapes)."""
        found = values.index_select(-1, self._inputs)
        for number, (weight, bias) in enumerate(self._layers):
            if number:
                found = self._activation(found)
            found = found @ weight.T + bias
        full = found.new_zeros(*found.shape[:-1], self._outputs)
        return full.index_copy(-1, self._columns, found)
