"""Training of a small network with one hidden layer, beside a linear map, on samples of what is to be learnt."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facepipe.learn.one_thread import one_thread

FloatArray = npt.NDArray[np.floating]

BATCH = 256
FIRST_RATE, LAST_RATE = 1e-2, 1e-5
CHECK_EVERY = 100  # steps
RIDGE = 1e-9  # of the mean square of the features

_ACTIVATIONS = {"tanh": torch.tanh, "relu": torch.relu, "silu": torch.nn.functional.silu}


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
    done: Callable[[], object] = lambda: None,
) -> Trained:
    """A network of `width` hidden units for `samples`, of least squared error: linear parts by least squares.

    Adam on the hidden layer and the last, from a seed, on one thread: the same samples give the same network. After it
    the linear map and the last layer are solved for once more, since they are the least squares of given units.

    :param checked: other samples; training stops where their error has not fallen for `patience` steps, and the best is
        taken
    :param sparsity: how strongly weights of the hidden layer are drawn to 0, so that a unit takes few inputs and what
        few of them do together is not mistaken for the others' doing; of the rate of Adam (proximal L1)
    :param done: called once for each step
    """
    with one_thread():
        linear, offset = _least_squares(_tensor(samples.inputs), _tensor(samples.outputs))
        parts = [(_tensor(one.inputs), _tensor(one.outputs)) for one in (samples, checked)]
        left = [(x, y - x @ linear - offset) for x, y in parts]
        network = _Network(samples.inputs.shape[1], left[0][1].shape[1], width, activation, seed)
        taken = _descend(network, left[0], left[1], seed, steps, patience, sparsity, done)
        x, y = parts[0]
        hidden, hidden_bias, _, _ = network.parameters
        units = network.units(x).detach()
        solved, last_bias = _least_squares(torch.cat([x, units], dim=1), y)
        inputs = x.shape[1]
        return Trained(
            linear=solved[:inputs].numpy(),
            hidden=hidden.detach().numpy(),
            hidden_bias=hidden_bias.detach().numpy(),
            last=solved[inputs:].T.numpy(),
            last_bias=last_bias.numpy(),
            steps=taken,
        )


class _Network:
    """(n, i) -> (n, o)."""

    def __init__(self, inputs: int, outputs: int, width: int, activation: str, seed: int) -> None:
        random = torch.Generator().manual_seed(seed)
        hidden = torch.randn(width, inputs, generator=random, dtype=torch.float64) / math.sqrt(inputs)
        # every other unit starts at one input: most of what sliders do is a function of one of them
        alone = torch.arange(0, width, 2)
        hidden[alone] = 0.0
        hidden[alone, torch.arange(len(alone)) % inputs] = 2.0
        bias = torch.rand(width, generator=random, dtype=torch.float64) * 2 - 1
        last = torch.zeros(outputs, width, dtype=torch.float64)
        last_bias = torch.zeros(outputs, dtype=torch.float64)
        self.parameters = [one.requires_grad_() for one in (hidden, bias, last, last_bias)]
        self._activation = _ACTIVATIONS[activation]

    def units(self, x: Tensor) -> Tensor:
        """(n, h) values of the hidden layer."""
        hidden, bias, _, _ = self.parameters
        return self._activation(x @ hidden.T + bias)

    def __call__(self, x: Tensor) -> Tensor:
        """(n, o)."""
        _, _, last, last_bias = self.parameters
        return self.units(x) @ last.T + last_bias

    def shrink(self, amount: float) -> None:
        """Draw the weights of the hidden layer to 0."""
        if amount > 0.0:
            with torch.no_grad():
                self.parameters[0].copy_(torch.nn.functional.softshrink(self.parameters[0], amount))

    def copied(self) -> list[Tensor]:
        """The parameters as they are now."""
        return [one.detach().clone() for one in self.parameters]

    def restore(self, copies: list[Tensor]) -> None:
        """Set the parameters to what they were."""
        with torch.no_grad():
            for one, copy in zip(self.parameters, copies, strict=True):
                one.copy_(copy)


def _descend(
    network: _Network,
    samples: tuple[Tensor, Tensor],
    checked: tuple[Tensor, Tensor],
    seed: int,
    steps: int,
    patience: int,
    sparsity: float,
    done: Callable[[], object],
) -> int:
    """Train in place; returns the steps taken. Outputs of all scales count by their squares, so scale them before."""
    x, y = samples
    size = y.square().mean().sqrt().clamp_min(1e-30)
    optimiser = torch.optim.Adam(network.parameters, lr=FIRST_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, LAST_RATE)
    random = torch.Generator().manual_seed(seed)
    best, best_step, kept = math.inf, 0, network.copied()
    for step in range(1, steps + 1):
        rows = torch.randint(len(x), (BATCH,), generator=random)
        optimiser.zero_grad()
        loss = ((network(x[rows]) - y[rows]) / size).square().mean()
        loss.backward()
        optimiser.step()
        network.shrink(sparsity * schedule.get_last_lr()[0])
        schedule.step()
        done()
        if step % CHECK_EVERY == 0 or step == steps:
            with torch.no_grad():
                error = float(((network(checked[0]) - checked[1]) / size).square().mean())
            if error < best:
                best, best_step, kept = error, step, network.copied()
            elif step - best_step >= patience:
                break
    network.restore(kept)
    return step


def _least_squares(features: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """(f, o) and (o,): the map and offset of least squared error."""
    whole = torch.cat([features, torch.ones_like(features[:, :1])], dim=1)
    normal = whole.T @ whole
    normal += RIDGE * normal.diagonal().mean() * torch.eye(len(normal), dtype=normal.dtype)
    solved = torch.linalg.solve(normal, whole.T @ targets)
    return solved[:-1], solved[-1]


def _tensor(values: FloatArray) -> Tensor:
    return torch.as_tensor(np.asarray(values, dtype=np.float64))
