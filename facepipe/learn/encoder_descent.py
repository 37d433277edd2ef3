"""Descent of an encoder's error, that can be stopped at any time and gone on with."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facepipe.learn.encoder_network import EncoderNetwork
from facepipe.learn.training_state import restore_state, state_of

Array = npt.NDArray[Any]

BATCH = 64
FIRST_RATE, LAST_RATE = 5e-4, 1e-6
DECAY = 1.0  # of weights, a step and rate: the network bends no more than the frames ask for
WARM = 100  # steps over which the rate rises
CHECK_EVERY, KEEP_EVERY = 50, 100  # steps


@dataclass(frozen=True, kw_only=True)
class EncoderLimits:
    """How long it is trained."""

    steps: int
    patience: int  # steps without a better check that end it

    def rate(self, step: int) -> float:
        """Of a step, counted from 1: up over the first, then down along a cosine."""
        down = LAST_RATE + (FIRST_RATE - LAST_RATE) * (1.0 + math.cos(math.pi * step / self.steps)) / 2.0
        return down * min(1.0, step / WARM)


class EncoderDescent:
    """Adam with decoupled decay, batch by batch, on frames with other noise each time."""

    def __init__(
        self,
        network: EncoderNetwork,
        samples: tuple[Tensor, Tensor],
        checked: tuple[Tensor, Tensor],
        noise: float,
        random: torch.Generator,
        limits: EncoderLimits,
    ) -> None:
        """
        :param samples: offsets (f, p, 3) in millimetres and controls (f, c)
        :param checked: others; the network that is best there is kept
        :param noise: standard deviation of a coordinate, millimetres
        """
        self._network, self._samples, self._checked, self._limits = network, samples, checked, limits
        self._noise, self._random = noise, random
        self._optimiser = torch.optim.AdamW(network.learned, lr=FIRST_RATE, weight_decay=DECAY)
        self._best, self._best_step, self._kept = network.error(*checked), 0, network.copied()
        self._ended = False
        self.steps = 0

    def run(self, done: Callable[[], object], keep: Callable[[Mapping[str, Array]], object]) -> None:
        """Go on to the end, and restore the best network.

        :param done: called once for each step, of those before too
        :param keep: called with the state every `KEEP_EVERY` steps and in the end
        """
        for _ in range(self.steps):
            done()
        while not self._ended:
            self._step()
            if self.steps % CHECK_EVERY == 0 or self.steps == self._limits.steps:
                self._check()
            if self.steps % KEEP_EVERY == 0 or self._ended:
                keep(self.state())
            done()
        self._network.restore(self._kept)

    def _step(self) -> None:
        self.steps += 1
        self._optimiser.param_groups[0]["lr"] = self._limits.rate(self.steps)
        offsets, controls = self._samples
        rows = torch.randint(len(offsets), (BATCH,), generator=self._random)
        seen = offsets[rows] + self._noise * torch.randn(BATCH, *offsets.shape[1:], generator=self._random)
        self._optimiser.zero_grad()
        loss = (self._network(seen) - controls[rows]).square().mean()
        loss.backward()
        self._optimiser.step()

    def _check(self) -> None:
        error = self._network.error(*self._checked)
        if error < self._best:
            self._best, self._best_step, self._kept = error, self.steps, self._network.copied()
        self._ended = self.steps - self._best_step >= self._limits.patience or self.steps == self._limits.steps

    def state(self) -> dict[str, Array]:
        """All that going on takes."""
        numbers = np.array([self.steps, self._best, self._best_step, self._ended], dtype=np.float64)
        return {**state_of(self._network.learned, self._kept, self._optimiser, self._random), "numbers": numbers}

    def go_on(self, state: Mapping[str, Array]) -> None:
        """Be as `state` says.

        :raises KeyError, RuntimeError, ValueError: the state of another network
        """
        steps, self._best, best_step, ended = (float(one) for one in state["numbers"])
        self.steps, self._best_step, self._ended = int(steps), int(best_step), bool(ended)
        self._kept = restore_state(state, self._network.learned, self._optimiser, self._random, self.steps)
