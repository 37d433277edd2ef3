"""Bounded Levenberg-Marquardt: damped Gauss-Newton steps that solve their quadratic model within the bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.boxed_qp import solve_boxed

_LEAST, _LARGEST = 1e-8, 1e8  # damping, of the curvature


@dataclass(frozen=True, kw_only=True)
class Quadratic:
    """A model of the cost around a point: ``cost + gradient d + 1/2 d^T hessian d``."""

    cost: float
    gradient: FloatArray  # (n,)
    hessian: FloatArray  # (n, n) positive semidefinite


@dataclass(frozen=True, kw_only=True)
class Minimum:
    """Where the steps ended."""

    x: FloatArray  # (n,)
    cost: float
    steps: int
    settled: bool  # the last step lowered the cost by less than the tolerance


def levenberg_marquardt(
    model: Callable[[FloatArray], Quadratic],
    cost: Callable[[FloatArray], float],
    start: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    *,
    steps: int = 40,
    tolerance: float = 1e-4,
) -> Minimum:
    """The minimum of a cost near `start`, within bounds.

    Damping multiplies the diagonal of the Hessian (Marquardt) and follows the ratio of what a step gained to what its
    model promised (Nielsen). Nocedal and Wright, "Numerical Optimization", section 10.3, bounds by projected Newton
    steps on the model.

    :param tolerance: share of the cost; a step that gains less is the last
    """
    x = np.clip(start, lower, upper)
    here = model(x)
    damping, growth = 1e-3, 2.0
    for number in range(steps):
        diagonal = np.maximum(np.diag(here.hessian), 1e-9 * max(float(np.diag(here.hessian).max()), 1e-30))
        d = solve_boxed(here.hessian + np.diag(damping * diagonal), here.gradient, lower - x, upper - x).x
        promised = -float(here.gradient @ d + 0.5 * d @ here.hessian @ d)
        tried = np.clip(x + d, lower, upper)
        gained = here.cost - cost(tried)
        if gained > 0 and promised > 0:
            x, before = tried, here.cost
            here = model(x)
            damping = float(np.clip(damping * max(1 / 3, 1 - (2 * gained / promised - 1) ** 3), _LEAST, _LARGEST))
            growth = 2.0
            if gained <= tolerance * before:
                return Minimum(x=x, cost=here.cost, steps=number + 1, settled=True)
        elif promised <= tolerance * tolerance * abs(here.cost) or damping >= _LARGEST:
            return Minimum(x=x, cost=here.cost, steps=number + 1, settled=True)
        else:
            damping, growth = min(damping * growth, _LARGEST), 2 * growth
    return Minimum(x=x, cost=here.cost, steps=steps, settled=False)
