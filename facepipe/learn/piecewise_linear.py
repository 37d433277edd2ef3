"""Sums of piecewise-linear functions of single inputs: what sliders and shape weights do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray


@dataclass(frozen=True, kw_only=True)
class Term:
    """``base + slope * x[input] + sum(change * max(x[input] - at, 0))``, added to one output."""

    output: int
    input: int
    base: float = 0.0
    slope: float = 0.0
    bends: tuple[tuple[float, float], ...] = ()  # (at, change of slope)


class PiecewiseLinear:
    """(..., inputs) -> (..., outputs).

    At a bend the derivative is the mean of both sides, as central differences have it, so that a slider whose two
    halves meet at its default can leave it either way.
    """

    def __init__(
        self, terms: Sequence[Term], inputs: int, base: FloatArray, dtype: torch.dtype, device: torch.device | str
    ) -> None:
        """:param base: (outputs,) what the terms add to"""
        bends = sorted({(term.input, at) for term in terms for at, _ in term.bends})
        column = {bend: inputs + i for i, bend in enumerate(bends)}
        matrix = np.zeros((inputs + len(bends), len(base)))
        constant = np.array(base, dtype=np.float64)
        for term in terms:
            constant[term.output] += term.base
            matrix[term.input, term.output] += term.slope
            for at, change in term.bends:
                matrix[column[term.input, at], term.output] += change
        self._matrix = torch.as_tensor(matrix, dtype=dtype, device=device)
        self._constant = torch.as_tensor(constant, dtype=dtype, device=device)
        self._bent = torch.as_tensor([own for own, _ in bends], dtype=torch.int64, device=device)
        self._at = torch.as_tensor([at for _, at in bends], dtype=dtype, device=device)

    def __call__(self, x: Tensor) -> Tensor:
        """(..., outputs) of (..., inputs)."""
        if len(self._bent):
            past = x.index_select(-1, self._bent) - self._at
            x = torch.cat([x, (past + past.abs()) / 2], dim=-1)
        return x @ self._matrix + self._constant
