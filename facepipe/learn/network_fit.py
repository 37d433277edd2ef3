"""Training of a small network with one hidden layer, beside a linear map, on samples of what is to be learnt."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.learn.network_descent import Descent, Network, Schedule
from facepipe.learn.one_thread import one_thread
from facepipe.learn.training_state import restoring

Array = npt.NDArray[Any]

RIDGE = 1e-9  # of the mean square of the features


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Rows of inputs, -1..1, and of what they give."""

    inputs: FloatArray  # (n, i)
    outputs: FloatArray  # (n, o)


@dataclass(frozen=True, kw_only=True)
class Trained:
    """``inputs @ linear + activation(inputs @ hidden.T + hidden_bias) @ last.T + last_bias``."""

    linear: FloatArray  # (i, o)
    hidden: FloatArray  # (h, i)
    hidden_bias: FloatArray  # (h,)
    last: FloatArray  # (o, h)
    last_bias: FloatArray  # (o,)
    steps: int
    curve: FloatArray  # (checks, 3): step, what is left of the learned and of the checked samples, RMS in shares of all


def train(
    samples: Samples,
    checked: Samples,
    *,
    width: int,
    activation: Literal["tanh", "relu", "silu"],
    seed: int,
    steps: int,
    patience: int,
    sparsity: float = 0.0,
    device: str = "cpu",
    done: Callable[[], object] = lambda: None,
    state: Mapping[str, Array] | None = None,
    keep: Callable[[Mapping[str, Array]], object] = lambda _: None,
) -> Trained:
    """A network of `width` hidden units for `samples`, of least squared error: linear parts by least squares.

    Adam on the hidden layer and the last, from a seed, on one thread: the same samples give the same network. After it
    the linear map and the last layer are solved for once more, since they are the least squares of given units.

    :param checked: other samples; training stops where their error has not fallen for `patience` steps, and the best is
        taken
    :param sparsity: how strongly weights of the hidden layer are drawn to 0, so that a unit takes few inputs and what
        few of them do together is not mistaken for the others' doing; of the rate of Adam (proximal L1)
    :param device: torch's, that the steps are taken on
    :param done: called once for each step
    :param state: what `keep` was given in a training that was ended: it goes on from there
    :param keep: called with the state now and then
    :raises InputError: a state of another training
    """
    with one_thread():
        linear, offset = _least_squares(_tensor(samples.inputs), _tensor(samples.outputs))
        parts = [(_tensor(one.inputs), _tensor(one.outputs)) for one in (samples, checked)]
        left = [(x.to(device), (y - x @ linear - offset).to(device)) for x, y in parts]
        network = Network(samples.inputs.shape[1], left[0][1].shape[1], width, activation, seed, device)
        schedule = Schedule(steps=steps, patience=patience, seed=seed, sparsity=sparsity)
        descent = Descent(network, left[0], left[1], schedule)
        if state is not None:
            with restoring():
                descent.go_on(state)
        descent.run(done, keep)
        return _solved(network, *parts[0], descent)


def _solved(network: Network, x: Tensor, y: Tensor, descent: Descent) -> Trained:
    hidden, hidden_bias, _, _ = (one.detach().cpu() for one in network.parameters)
    units = network.units(x.to(network.parameters[0].device)).detach().cpu()
    solved, last_bias = _least_squares(torch.cat([x, units], dim=1), y)
    inputs = x.shape[1]
    return Trained(
        linear=solved[:inputs].numpy(),
        hidden=hidden.numpy(),
        hidden_bias=hidden_bias.numpy(),
        last=solved[inputs:].T.numpy(),
        last_bias=last_bias.numpy(),
        steps=descent.steps,
        curve=descent.curve,
    )


def _least_squares(features: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """(f, o) and (o,): the map and offset of least squared error."""
    whole = torch.cat([features, torch.ones_like(features[:, :1])], dim=1)
    normal = whole.T @ whole
    normal += RIDGE * normal.diagonal().mean() * torch.eye(len(normal), dtype=normal.dtype)
    solved = torch.linalg.solve(normal, whole.T @ targets)
    return solved[:-1], solved[-1]


def _tensor(values: FloatArray) -> Tensor:
    return torch.as_tensor(np.asarray(values, dtype=np.float64))
