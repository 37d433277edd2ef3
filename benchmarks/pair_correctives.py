"""Dense blendshapes with correctives: shapes that products of two controls bring, the peer that goes on where
blendshapes, one a control, end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from facepipe.neural import Motion

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

_ROUNDS = 4  # pairs are chosen a part at a time, each by what the ones before it leave
_KEPT = 128  # principal components of what is left, to choose by
_FIRM = 1e-6  # of the products' squares; those of controls that seldom move together say nothing


@dataclass(frozen=True)
class Correctives:
    """``rest + [x, 1, products of pairs] shapes`` of x, the controls from 0 to 1."""

    rest: FloatArray  # (n, 3) millimetres
    pairs: IntArray  # (p, 2)
    shapes: FloatArray  # (c + 1 + p, n, 3)

    def points(self, values: FloatArray) -> FloatArray:
        """(n, 3) of (c,) values."""
        row = np.concatenate([values, [1.0], values[self.pairs[:, 0]] * values[self.pairs[:, 1]]])
        return np.asarray(self.rest + np.tensordot(row, self.shapes, axes=1))


def pair_correctives(motion: Motion, count: int) -> Correctives:
    """The `count` pairs that explain most of what the others leave, and shapes of least squared error on all frames."""
    from facepipe.geometry.shape_basis import motion_basis

    x = motion.values
    deltas = (motion.points - motion.rest).reshape(len(x), -1)
    every = np.array(np.triu_indices(x.shape[1], 1)).T
    products = x[:, every[:, 0]] * x[:, every[:, 1]]
    rows = np.concatenate([x, np.ones((len(x), 1))], axis=1)
    left = deltas - rows @ np.linalg.lstsq(rows, deltas, rcond=None)[0]
    target = motion_basis(left.reshape(motion.points.shape), 0.0, _KEPT)[1]
    chosen: list[int] = []
    for part in np.array_split(np.arange(count), _ROUNDS):
        own = np.linalg.qr(np.concatenate([rows, products[:, chosen]], axis=1))[0]
        fresh, rest = (one - own @ (own.T @ one) for one in (products, target))
        sizes = np.square(fresh).sum(axis=0)
        explained = np.square(fresh.T @ rest).sum(axis=1) / (sizes + _FIRM * sizes.max())
        explained[chosen] = -1.0
        chosen += np.argsort(-explained)[: len(part)].tolist()
    rows = np.concatenate([rows, products[:, chosen]], axis=1)
    shapes = np.linalg.lstsq(rows, deltas, rcond=None)[0]
    return Correctives(motion.rest, every[chosen], shapes.reshape(-1, *motion.rest.shape))
