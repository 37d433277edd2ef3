"""Stage two: gradient descent on the joint loss ([0172]-[0178])."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from facepipe.learn.photo.options import PhotoFitOptions
from facepipe.learn.photo.result import Stopped
from facepipe.learn.photo.unknowns import Unknowns

# Steps of each kind of unknown over those of sliders: [0175]-[0177] have a rate for each.
_RATES = {"shares": 1.0, "expressions": 1.0, "poses": 0.25, "light": 1.0, "tint": 1.0}
_SLOWEST = 0.05  # of the rate, at the last step


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
) -> Descent:
    """The unknowns with the least loss of all steps; sliders and expressions stay in their ranges.

    A loss or slope that is not finite ends it, with the best so far.
    """
    at, best, least = start, start.copy(), math.inf
    optimiser = _optimiser(at, options)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: _pace(step, options))
    history: list[dict[str, float]] = []
    for step in range(options.iterations + 1):
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
        optimiser.zero_grad()
        terms["total"].backward()
        if not all(one.grad is None or bool(one.grad.isfinite().all()) for one in at.tensors()):
            return Descent(best=best, history=tuple(history), stopped="not-finite")
        optimiser.step()
        schedule.step()
        at.clamp()
        if done is not None:
            done(1)
    return Descent(best=best, history=tuple(history), stopped="iterations")


def _optimiser(at: Unknowns, options: PhotoFitOptions) -> torch.optim.Optimizer:
    groups = [{"params": [getattr(at, name)], "lr": factor * options.rate} for name, factor in _RATES.items()]
    if options.optimiser == "adam":
        return torch.optim.Adam(groups, betas=(0.9, 0.99))
    return torch.optim.SGD(groups)


def _pace(step: int, options: PhotoFitOptions) -> float:
    """A cosine from 1 to `_SLOWEST` with adam; 1 in plain descent."""
    if options.optimiser != "adam":
        return 1.0
    share = min(step / max(options.iterations, 1), 1.0)
    return _SLOWEST + (1 - _SLOWEST) * 0.5 * (1 + math.cos(math.pi * share))
