"""Training of a small network with one hidden layer, beside a linear map, on samples of what is to be learnt.

Descent can be stopped at any time and continued.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import AnyArray, FloatArray
from facepipe.learn.one_thread import one_thread
from facepipe.learn.training_state import restore_state, restoring, state_of

BATCH = 256
FIRST_RATE, LAST_RATE = 1e-2, 1e-5
CHECK_EVERY, KEEP_EVERY = 100, 500  # steps

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

    def copied(self) -> list[Tensor]:
        """The parameters as they are now."""
        return [parameter.detach().clone() for parameter in self.parameters]

    def restore(self, copies: list[Tensor]) -> None:
        """Set the parameters to what they were."""
        with torch.no_grad():
            for one, copy in zip(self.parameters, copies, strict=True):
                one.copy_(copy)


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How long a descent goes on, and what it draws."""

    steps: int
    patience: int  # steps without a better check that end it
    seed: int
    sparsity: float  # of the rate of Adam, drawn off the hidden layer's weights (proximal L1)

    def rate(self, step: int) -> float:
        """Of a step, counted from 1: half a cosine from the first to the last."""
        turned = math.cos(math.pi * (step - 1) / self.steps)
        return LAST_RATE + 0.5 * (FIRST_RATE - LAST_RATE) * (1.0 + turned)


@dataclass(kw_only=True)
class _Progress:
    step: int = 0
    best: float = math.inf
    best_step: int = 0
    summed: float = 0.0  # losses since the last check
    curve: list[list[float]] = field(default_factory=list)


class Descent:
    """Adam on a network, batch by batch; errors count by their squares, in shares of the outputs' own."""

    def __init__(
        self, network: Network, samples: tuple[Tensor, Tensor], checked: tuple[Tensor, Tensor], schedule: Schedule
    ) -> None:
        """:param checked: other samples; the network that is best there is kept"""
        self._network, self._samples, self._checked, self._schedule = network, samples, checked, schedule
        self._size = samples[1].square().mean().sqrt().clamp_min(1e-30)
        self._optimiser = torch.optim.Adam(network.parameters, lr=FIRST_RATE)
        self._random = torch.Generator().manual_seed(schedule.seed)
        self._kept = network.copied()
        self._now = _Progress()

    @property
    def steps(self) -> int:
        """Steps taken."""
        return self._now.step

    @property
    def curve(self) -> AnyArray:
        """(checks, 3): step, then what is left of the learned and of the checked samples, RMS in shares of all."""
        return np.array(self._now.curve, dtype=np.float64).reshape(-1, 3)

    def run(self, done: Callable[[], object], keep: Callable[[Mapping[str, AnyArray]], object]) -> None:
        """Go on to the end, and restore the best network.

        :param done: called once for each step, of those before too
        :param keep: called with the state every `KEEP_EVERY` steps and in the end
        """
        for _ in range(self._now.step):
            done()
        while self._now.step < self._schedule.steps and not self._stale():
            self._step()
            if self._now.step % CHECK_EVERY == 0 or self._now.step == self._schedule.steps:
                self._check()
            if self._now.step % KEEP_EVERY == 0:
                keep(self.state())
            done()
        if self._now.step % KEEP_EVERY:
            keep(self.state())
        self._network.restore(self._kept)

    def _stale(self) -> bool:
        return self._now.step - self._now.best_step >= self._schedule.patience and bool(self._now.curve)

    def _step(self) -> None:
        self._now.step += 1
        rate = self._schedule.rate(self._now.step)
        self._optimiser.param_groups[0]["lr"] = rate
        x, y = self._samples
        rows = torch.randint(len(x), (BATCH,), generator=self._random).to(x.device)
        self._optimiser.zero_grad()
        loss = ((self._network(x[rows]) - y[rows]) / self._size).square().mean()
        loss.backward()
        self._optimiser.step()
        self._network.shrink(self._schedule.sparsity * rate)
        self._now.summed += float(loss.detach())

    def _check(self) -> None:
        now, (x, y) = self._now, self._checked
        with torch.no_grad():
            error = float(((self._network(x) - y) / self._size).square().mean())
        since = now.step - (int(now.curve[-1][0]) if now.curve else 0)
        now.curve.append([float(now.step), math.sqrt(now.summed / since), math.sqrt(error)])
        now.summed = 0.0
        if error < now.best:
            now.best, now.best_step, self._kept = error, now.step, self._network.copied()

    def state(self) -> dict[str, AnyArray]:
        """All that going on takes."""
        numbers = np.array([self._now.step, self._now.best, self._now.best_step, self._now.summed])
        found = state_of(self._network.parameters, self._kept, self._optimiser, self._random)
        return found | {"numbers": numbers, "curve": self.curve}

    def go_on(self, state: Mapping[str, AnyArray]) -> None:
        """Take over a state.

        :raises KeyError, RuntimeError, ValueError: the state of another network
        """
        step, best, best_step, summed = (float(one) for one in state["numbers"])
        curve = np.asarray(state["curve"]).reshape(-1, 3).tolist()
        self._kept = restore_state(state, self._network.parameters, self._optimiser, self._random, int(step))
        self._now = _Progress(
            step=int(step),
            best=best,
            best_step=int(best_step),
            summed=summed,
            curve=curve,
        )


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
