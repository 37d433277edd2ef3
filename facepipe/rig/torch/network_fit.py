"""Training of a small network with one hidden layer, beside a linear map, on samples of what is to be learnt."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import AnyArray, FloatArray
from facepipe.rig.torch.descent import Descent
from facepipe.rig.torch.one_thread import one_thread

BATCH = 256
FIRST_RATE, LAST_RATE = 1e-2, 1e-5

_ACTIVATIONS = {"tanh": torch.tanh, "relu": torch.relu, "silu": torch.nn.functional.silu}
RIDGE = 1e-9  # of the mean square of the features


class Network:
    """(n, i) -> (n, o), one hidden layer; what it gives at first is 0."""

    def __init__(self, inputs: int, outputs: int, width: int, activation: str, seed: int, device: str) -> None:
        random = torch.Generator().manual_seed(seed)
        hidden = torch.randn(width, inputs, generator=random, dtype=torch.float64) / math.sqrt(inputs)
        # every other unit starts at one input: most of what sliders do is a function of one of them
        alone = torch.arange(0, width, 2)
        hidden[alone] = 0.0
        hidden[alone, torch.arange(len(alone)) % inputs] = 2.0
        bias = torch.rand(width, generator=random, dtype=torch.float64) * 2 - 1
        last = torch.zeros(outputs, width, dtype=torch.float64)
        last_bias = torch.zeros(outputs, dtype=torch.float64)
        self.parameters = [one.to(device).requires_grad_() for one in (hidden, bias, last, last_bias)]
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


class NetworkDescent(Descent):
    """Adam on a network; errors count by their squares, in shares of the outputs' own."""

    check_every, keep_every = 100, 500

    def __init__(
        self,
        network: Network,
        samples: tuple[Tensor, Tensor],
        checked: tuple[Tensor, Tensor],
        *,
        steps: int,
        patience: int,
        seed: int,
        sparsity: float,
    ) -> None:
        """:param checked: other samples; the network that is best there is kept
        :param sparsity: of the rate of Adam, drawn off the hidden layer's weights (proximal L1)
        """
        self._network, self._samples, self._checked, self._sparsity = network, samples, checked, sparsity
        self._size = samples[1].square().mean().sqrt().clamp_min(1e-30)
        self._curve: list[list[float]] = []
        optimiser = torch.optim.Adam(network.parameters, lr=FIRST_RATE)
        random = torch.Generator().manual_seed(seed)
        super().__init__(network.parameters, optimiser, random, steps=steps, patience=patience)

    @property
    def curve(self) -> AnyArray:
        """(checks, 3): step, then what is left of the learned and of the checked samples, RMS in shares of all."""
        return np.array(self._curve, dtype=np.float64).reshape(-1, 3)

    def rate(self, step: int) -> float:
        """Half a cosine from the first to the last."""
        turned = math.cos(math.pi * (step - 1) / self._most)
        return LAST_RATE + 0.5 * (FIRST_RATE - LAST_RATE) * (1.0 + turned)

    def loss(self) -> Tensor:
        """Of the next batch."""
        x, y = self._samples
        rows = torch.randint(len(x), (BATCH,), generator=self._random).to(x.device)
        return ((self._network(x[rows]) - y[rows]) / self._size).square().mean()

    def error(self) -> float:
        """Of the samples that are checked."""
        x, y = self._checked
        with torch.no_grad():
            return float(((self._network(x) - y) / self._size).square().mean())

    def state(self) -> dict[str, AnyArray]:
        """With the curve."""
        return super().state() | {"curve": self.curve}

    def _stale(self) -> bool:
        return self.steps - self._best_step >= self._patience and bool(self._curve)

    def _step(self) -> None:
        super()._step()
        self._network.shrink(self._sparsity * self.rate(self.steps))

    def _check(self) -> float:
        error = super()._check()
        since = self.steps - (int(self._curve[-1][0]) if self._curve else 0)
        self._curve.append([float(self.steps), math.sqrt(self._summed / since), math.sqrt(error)])
        self._summed = 0.0
        return error

    def _take_over(self, state: Mapping[str, AnyArray]) -> None:
        super()._take_over(state)
        self._curve = np.asarray(state["curve"]).reshape(-1, 3).tolist()


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
    state: Mapping[str, AnyArray] | None = None,
    keep: Callable[[Mapping[str, AnyArray]], object] = lambda _: None,
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
        # The network starts at 0 and learns what the straight map leaves alone.
        left = [(x.to(device), (y - x @ linear - offset).to(device)) for x, y in parts]
        network = Network(samples.inputs.shape[1], left[0][1].shape[1], width, activation, seed, device)
        descent = NetworkDescent(
            network, left[0], left[1], steps=steps, patience=patience, seed=seed, sparsity=sparsity
        )
        if state is not None:
            descent.go_on(state)
        descent.run(done, keep)
        return _solved(network, *parts[0], descent)


def _solved(network: Network, x: Tensor, y: Tensor, descent: NetworkDescent) -> Trained:
    hidden, hidden_bias, _, _ = (parameter.detach().cpu() for parameter in network.parameters)
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
