"""Stage two: gradient descent on the joint loss ([0172]-[0178]), and what it moves."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from facepipe.photo.descent.landmark_fit import State
from facepipe.photo.descent.subject import Stopped
from facepipe.photo.options import PhotoFitOptions
from facepipe.photo.renderer.light import DARK

# Steps of poses, as `PoseSpace`, over those of everything else. A step of a head's place, in sides of the photo, moves
# all its pixels farther than a step of a slider moves any; the document has one rate for poses ([0177]).
_POSES = {"adam": (0.2, 0.2, 0.2, 0.02, 0.02, 0.05, 0.5), "gradient-descent": (0.25,) * 7}
_SLOWEST = 0.05  # of the rate, at the last step
_RISE = (12, 0.3)  # steps, and at most this share of a descent
_RENEWED = (10, 50)  # least and most steps after which what a loss holds fixed is made anew; half a descent otherwise
_MEMORY = (10, 0.25)  # slopes that the first moment remembers, and at most this share of a descent
_SECOND = 0.99  # memory of the second moment
_TINY = 1e-8


@dataclass(frozen=True, kw_only=True)
class Unknowns:
    """Sliders alpha, expressions beta and what makes up the camera parameters p ([0120]), of v photos."""

    shares: Tensor  # (f,) 0..1 of the free sliders' ranges
    expressions: Tensor  # (v, e) 0..1
    poses: Tensor  # (v, 7) as `PoseSpace`
    light: Tensor  # (v, 9, 3)
    key: Tensor  # (v, 8) as `KeyLight`
    tint: Tensor  # (materials, 3) logarithms of factors

    @classmethod
    def from_state(
        cls, state: State, light: Sequence[Tensor], tint: Tensor, key: Sequence[Tensor] | None = None
    ) -> Unknowns:
        """Free tensors in float32, poses in float64; without `key` no lamps."""
        numbers = {
            "shares": torch.as_tensor(state.shares, dtype=torch.float32),
            "expressions": torch.as_tensor(state.expressions, dtype=torch.float32),
            "poses": torch.as_tensor(state.poses, dtype=torch.float64),
            "light": torch.stack(list(light)),
            "key": torch.stack(list(key) if key is not None else [torch.tensor(DARK)] * len(light)),
            "tint": tint,
        }
        return cls(**{name: value.detach().clone().requires_grad_() for name, value in numbers.items()})

    @classmethod
    def names(cls) -> list[str]:
        """What they are called, in order."""
        return [field.name for field in fields(cls)]

    def tensors(self) -> list[Tensor]:
        """All of them, in order."""
        return [getattr(self, name) for name in self.names()]

    def copy(self) -> Unknowns:
        """The same values, held."""
        return Unknowns(**{field.name: getattr(self, field.name).detach().clone() for field in fields(self)})

    def clamp(self) -> None:
        """Put sliders and expressions back into their ranges, and lamps to no less than nothing."""
        with torch.no_grad():
            self.key[:, 3:7].clamp_(min=0)
            self.shares.clamp_(0, 1)
            self.expressions.clamp_(0, 1)

    def state(self) -> State:
        """As numbers, what stage one seeks."""
        shares, expressions, poses = (
            one.detach().numpy().astype(np.float64) for one in (self.shares, self.expressions, self.poses)
        )
        return State(shares=shares, expressions=expressions, poses=poses)


@dataclass(frozen=True, kw_only=True)
class Descent:
    """Where it ended."""

    best: Unknowns
    kept: int  # step that these are of
    history: tuple[dict[str, float], ...]
    stopped: Stopped


def descend(
    loss: Callable[[Unknowns], dict[str, Tensor]],
    start: Unknowns,
    options: PhotoFitOptions,
    done: Callable[[Unknowns], None] | None = None,
    renew: Callable[[Unknowns], None] | None = None,
) -> Descent:
    """The unknowns with the least loss of all steps; sliders and expressions stay in their ranges.

    A loss or slope that is not finite ends it, with the best so far.
    """
    at, best, kept, least = start, start.copy(), 0, math.inf
    # in plain descent [0175]-[0177] a step takes the rate's share of the slope itself
    move = Adam(_within(_MEMORY, options)) if options.optimiser == "adam" else list
    renewed = min(max(options.iterations // 2, _RENEWED[0]), _RENEWED[1])
    history: list[dict[str, float]] = []
    for step in range(options.iterations + 1):
        if renew is not None and 0 < step < options.iterations and step % renewed == 0:
            renew(at)
            least = math.inf  # the loss has changed
        terms = loss(at)
        history.append({name: float(value.detach()) for name, value in terms.items()})
        total = history[-1]["total"]
        if not math.isfinite(total):
            return Descent(best=best, kept=kept, history=tuple(history), stopped="not-finite")
        if total < least:
            best, kept, least = at.copy(), step, total
        if total < options.loss_threshold:
            return Descent(best=best, kept=kept, history=tuple(history), stopped="loss-threshold")
        if step == options.iterations:
            break
        slopes = torch.autograd.grad(terms["total"], at.tensors(), allow_unused=True, materialize_grads=True)
        if not all(bool(slope.isfinite().all()) for slope in slopes):
            return Descent(best=best, kept=kept, history=tuple(history), stopped="not-finite")
        rate = options.rate
        if options.optimiser == "adam":
            # a rise, while its moments know little, then a cosine to `_SLOWEST`
            share = min(step / max(options.iterations, 1), 1.0)
            falling = _SLOWEST + (1 - _SLOWEST) * 0.5 * (1 + math.cos(math.pi * share))
            rate = options.rate * (falling * min(1.0, (step + 1) / max(_within(_RISE, options), 1.0)))
        with torch.no_grad():
            for name, unknown, change in zip(at.names(), at.tensors(), move(slopes), strict=True):
                unknown -= rate * (change * change.new_tensor(_POSES[options.optimiser]) if name == "poses" else change)
        at.clamp()
        if done is not None:
            done(at)
    return Descent(best=best, kept=kept, history=tuple(history), stopped="iterations")


class Adam:
    """Kingma and Ba, "Adam: A Method for Stochastic Optimization", ICLR 2015, algorithm 1, steps of rate 1.

    Ten lines of our own: the first use of torch's imports its compiler, which takes longer than forty steps.
    """

    def __init__(self, memory: float = _MEMORY[0]) -> None:
        """:param memory: slopes that the first moment remembers, 1 or more"""
        self._keep = (1 - 1 / max(memory, 1.0), _SECOND)
        self._count = 0
        self._first: list[Tensor] = []
        self._second: list[Tensor] = []

    def __call__(self, slopes: Sequence[Tensor]) -> list[Tensor]:
        if not self._first:
            self._first, self._second = ([torch.zeros_like(one) for one in slopes] for _ in range(2))
        self._count += 1
        for first, second, slope in zip(self._first, self._second, slopes, strict=True):
            first.lerp_(slope, 1 - self._keep[0])
            second.lerp_(slope * slope, 1 - self._keep[1])
        bias = [1 - keep**self._count for keep in self._keep]
        return [
            (first / bias[0]) / ((second / bias[1]).sqrt() + _TINY)
            for first, second in zip(self._first, self._second, strict=True)
        ]


def _within(steps: tuple[int, float], options: PhotoFitOptions) -> float:
    """So many steps, and at most a share of the descent."""
    return min(steps[0], steps[1] * options.iterations)
