"""A descent that can be stopped at any time and continued, and ends with the best of its parameters."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import AnyArray
from facepipe.core.errors import InputError

_MOMENTS = ("exp_avg", "exp_avg_sq")  # of Adam


class Descent(ABC):
    """Adam or AdamW, batch by batch; the parameters that are best on other samples, checked now and then, are kept."""

    check_every: ClassVar[int]  # steps
    keep_every: ClassVar[int]

    def __init__(
        self,
        parameters: list[Tensor],
        optimiser: torch.optim.Optimizer,
        random: torch.Generator,
        *,
        steps: int,
        patience: int,
    ) -> None:
        """:param steps: at most
        :param patience: steps without a better check that end it
        """
        self._parameters, self._optimiser, self._random = parameters, optimiser, random
        self._most, self._patience = steps, patience
        self.steps = 0  # that were taken
        self._best, self._best_step, self._kept = math.inf, 0, self._copied()
        self._summed = 0.0  # losses since the last check

    @abstractmethod
    def rate(self, step: int) -> float:
        """Of a step, counted from 1."""

    @abstractmethod
    def loss(self) -> Tensor:
        """Of the next batch."""

    @abstractmethod
    def error(self) -> float:
        """Of the samples that are checked."""

    def run(self, done: Callable[[], object], keep: Callable[[Mapping[str, AnyArray]], object]) -> None:
        """Go on to the end, and restore the best parameters.

        :param done: called once for each step, of those before too
        :param keep: called with the state every `keep_every` steps and in the end
        """
        begun = self.steps
        for _ in range(begun):
            done()
        while self.steps < self._most and not self._stale():
            self._step()
            if self.steps % self.check_every == 0 or self.steps == self._most:
                self._check()
            if self.steps % self.keep_every == 0:
                keep(self.state())
            done()
        # Kept before the best is restored: Adam's moments belong to the last parameters, not to the best.
        if self.steps > begun and self.steps % self.keep_every:
            keep(self.state())
        with torch.no_grad():
            for parameter, copy in zip(self._parameters, self._kept, strict=True):
                parameter.copy_(copy)

    def _stale(self) -> bool:
        """Whether the last check says that it is to end."""
        return self.steps - self.steps % self.check_every - self._best_step >= self._patience

    def _step(self) -> None:
        self.steps += 1
        self._optimiser.param_groups[0]["lr"] = self.rate(self.steps)
        self._optimiser.zero_grad()
        loss = self.loss()
        loss.backward()
        self._optimiser.step()
        self._summed += float(loss.detach())

    def _check(self) -> float:
        error = self.error()
        if error < self._best:
            self._best, self._best_step, self._kept = error, self.steps, self._copied()
        return error

    def _copied(self) -> list[Tensor]:
        return [parameter.detach().clone() for parameter in self._parameters]

    def state(self) -> dict[str, AnyArray]:
        """All that going on takes: parameters, the best of them so far, Adam's moments and the draws to come."""
        state: dict[str, AnyArray] = {"random": self._random.get_state().numpy().astype(np.int32)}
        state["numbers"] = np.array([self.steps, self._best, self._best_step, self._summed])
        for number, (one, best) in enumerate(zip(self._parameters, self._kept, strict=True)):
            state |= {f"now.{number}": one.detach().cpu().numpy().copy(), f"best.{number}": best.cpu().numpy()}
            moments = self._optimiser.state[one]
            state |= {f"{name}.{number}": moments[name].cpu().numpy().copy() for name in _MOMENTS}
        return state

    def go_on(self, state: Mapping[str, AnyArray]) -> None:
        """Take over a state.

        :raises InputError: a damaged one, or that of another network
        """
        try:
            self._take_over(state)
        except (KeyError, RuntimeError, ValueError, TypeError, OverflowError):
            what = "is damaged or of another network, expected that of this training"
            raise InputError("training state", what) from None

    def _take_over(self, state: Mapping[str, AnyArray]) -> None:
        steps, self._best, best_step, self._summed = (float(one) for one in state["numbers"])
        self.steps, self._best_step, self._kept = int(steps), int(best_step), []
        for number, parameter in enumerate(self._parameters):
            with torch.no_grad():
                parameter.copy_(torch.tensor(state[f"now.{number}"]).reshape(parameter.shape))
            best, *moments = (
                torch.tensor(state[f"{name}.{number}"]).to(parameter).reshape(parameter.shape)
                for name in ("best", *_MOMENTS)
            )
            self._kept.append(best)
            step = torch.tensor(self.steps, dtype=torch.float32)
            self._optimiser.state[parameter] = {"step": step, **dict(zip(_MOMENTS, moments, strict=True))}
        self._random.set_state(torch.as_tensor(np.asarray(state["random"]).astype(np.uint8)))
