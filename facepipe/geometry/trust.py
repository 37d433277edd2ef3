"""How much to trust what is seen of a person, found from people of whom all is known: each predicted by the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from facepipe.core.arrays import FloatArray

_STEPS = (0.0, *(10.0**power for power in np.arange(-2.0, 4.1, 0.5)))  # times the inverse of a block's mean square


@dataclass(frozen=True)
class Block:
    """Numbers of m people, as what their inner products say of them."""

    products: FloatArray  # (m, m), of numbers whose mean over people is 0

    @classmethod
    def of(cls, numbers: FloatArray) -> Block:
        """That of numbers (m, d)."""
        return cls(numbers @ numbers.T)

    @property
    def mean_square(self) -> float:
        """Of the rows' lengths."""
        return float(np.trace(self.products)) / len(self.products)


def trust(seen: Sequence[Block], wanted: Block) -> list[float]:
    """The weight of each block that is seen: the inverse of the variance of its noise.

    Those with which a Gaussian model of the other people comes nearest to what is wanted of each person, among powers
    of ten and 0; the smallest of those that do equally well. Leaving people out one by one has a closed form (Craven
    and Wahba, "Smoothing noisy data with spline functions", Numerische Mathematik 1978).
    """
    scales = [1.0 / block.mean_square if block.mean_square > 0 else 0.0 for block in seen]
    best, found = np.inf, [0.0] * len(seen)
    if len(wanted.products) < 3:  # of two, each is predicted by the other alone, whatever the weights
        return found
    for steps in product(_STEPS, repeat=len(seen)):
        weights = [step * scale for step, scale in zip(steps, scales, strict=True)]
        summed = np.sum([weight * block.products for weight, block in zip(weights, seen, strict=True)], axis=0)
        missed = _missed(summed, wanted.products)
        if missed < best * (1.0 - 1e-9):
            best, found = missed, weights
    return found


def _missed(products: FloatArray, wanted: FloatArray) -> float:
    """Sum over people of the squared distance of what is predicted of them from what is so."""
    count = len(products)
    scaled = products / (count - 1)
    hat = np.linalg.solve(scaled + np.eye(count), scaled) + 1.0 / count
    left = np.eye(count) - hat
    return float((np.einsum("ij,jk,ik->i", left, wanted, left, optimize=True) / np.square(np.diag(left))).sum())
