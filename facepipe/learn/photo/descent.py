"""Stage two: gradient descent on the joint loss ([0172]-[0178])."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from facepipe.learn.photo.result import Stopped
from facepipe.learn.photo.unknowns import Unknowns
from facepipe.photo_options import PhotoFitOptions

# Steps of each kind of unknown over those of sliders: [0175]-[0177] have a rate for each.
_RATES = {"shares": 1.0, "expressions": 1.0, "poses": 0.25, "light": 1.0, "key": 1.0, "tint": 1.0}
_SLOWEST = 0.05  # of the rate, at the last step
_RISE = 12  # steps
_RENEWED = 50  # steps after which what a loss holds fixed is made anew
_MEMORY = (0.9, 0.99)  # of the first and second moments
_TINY = 1e-8


@dataclass(frozen=True, kw_only=True)
class Descent:
    """Where it ended."""

    best: Unknowns
    history: tuple[dict[str, float], ...]
    stopped: Stopped


def descend(
    loss: Callable[[Unknowns], dict[str, Tensor]],
    start: Unknowns,
    options: PhotoFitOptions,
    done: Callable[[int], None] | None = None,
    renew: Callable[[Unknowns], None] | None = None,
) -> Descent:
    """The unknowns with the least loss of all steps; sliders and expressions stay in their ranges.

    A loss or slope that is not finite ends it, with the best so far.
    """
    at, best, least = start, start.copy(), math.inf
    move = Adam() if options.optimiser == "adam" else _plain
    history: list[dict[str, float]] = []
    for step in range(options.iterations + 1):
        if renew is not None and step and step % _RENEWED == 0:
            renew(at)
            least = math.inf  # the loss has changed
        terms = loss(at)
        history.append({name: float(value.detach()) for name, value in terms.items()})
        total = history[-1]["total"]
        if not math.isfinite(total):
            return Descent(best=best, history=tuple(history), stopped="not-finite")
        if total < least:
            best, least = at.copy(), total
        if total < options.loss_threshold:
            return Descent(best=best, history=tuple(history), stopped="loss-threshold")
        if step == options.iterations:
            break
        slopes = torch.autograd.grad(terms["total"], at.tensors(), allow_unused=True, materialize_grads=True)
        if not all(bool(one.isfinite().all()) for one in slopes):
            return Descent(best=best, history=tuple(history), stopped="not-finite")
        with torch.no_grad():
            rates = [options.rate * _RATES[name] * _pace(step, options) for name in at.names()]
            for unknown, change in zip(at.tensors(), move(slopes, rates), strict=True):
                unknown -= change
        at.clamp()
        if done is not None:
            done(1)
    return Descent(best=best, history=tuple(history), stopped="iterations")


def _plain(slopes: Sequence[Tensor], rates: Sequence[float]) -> list[Tensor]:
    """[0175]-[0177]: the rate times the slope."""
    return [rate * slope for slope, rate in zip(slopes, rates, strict=True)]


class Adam:
    """Kingma and Ba, "Adam: A Method for Stochastic Optimization", ICLR 2015, algorithm 1.

    Ten lines of our own: the first use of torch's imports its compiler, which takes longer than forty steps.
    """

    def __init__(self) -> None:
        self._count = 0
        self._first: list[Tensor] = []
        self._second: list[Tensor] = []

    def __call__(self, slopes: Sequence[Tensor], rates: Sequence[float]) -> list[Tensor]:
        if not self._first:
            self._first, self._second = ([torch.zeros_like(one) for one in slopes] for _ in range(2))
        self._count += 1
        for first, second, slope in zip(self._first, self._second, slopes, strict=True):
            first.lerp_(slope, 1 - _MEMORY[0])
            second.lerp_(slope * slope, 1 - _MEMORY[1])
        bias = [1 - memory**self._count for memory in _MEMORY]
        return [
            rate * (first / bias[0]) / ((second / bias[1]).sqrt() + _TINY)
            for rate, first, second in zip(rates, self._first, self._second, strict=True)
        ]


def _pace(step: int, options: PhotoFitOptions) -> float:
    """With adam a rise, while its moments know little, then a cosine to `_SLOWEST`; 1 in plain descent."""
    if options.optimiser != "adam":
        return 1.0
    share = min(step / max(options.iterations, 1), 1.0)
    falling = _SLOWEST + (1 - _SLOWEST) * 0.5 * (1 + math.cos(math.pi * share))
    return falling * min(1.0, (step + 1) / min(_RISE, options.iterations))
