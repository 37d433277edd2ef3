"""The last step of an encoder's training: its straight map and its last layer, solved for together."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.geometry.ridge import ridge

_DOUBTS = (0.003, 0.01, 0.03, 0.1, 0.3, 10.0)  # noise of reduced features, within -1..1: with the last, none counts


def last_layer(
    taught: tuple[Tensor, Tensor, Tensor], watched: tuple[Tensor, Tensor, Tensor], noise: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The straight map (3 p, c), the last layer (r, c) and the offset (c,) of least squared error, of given features.

    Features were fitted to the frames, so they are trusted less than these say: by as much as is best for the watched
    frames. The maps are then those of all frames.

    :param taught: offsets (f, p, 3) in millimetres, reduced features (f, r) and controls (f, c) that training saw
    :param watched: others, that it did not see
    :param noise: of offsets, millimetres
    """
    rows, others = _rows(*taught), _rows(*watched)
    coordinates = taught[0][0].numel()

    def solved(seen: FloatArray, told: FloatArray, doubt: float) -> tuple[FloatArray, FloatArray]:
        noises = np.full(seen.shape[1], doubt)
        noises[:coordinates] = noise
        return ridge(seen, told, noises)

    def error(doubt: float) -> float:
        matrix, offset = solved(*rows, doubt)
        return float(np.square(np.clip(others[0] @ matrix + offset, -1.0, 1.0) - others[1]).mean())

    together = [np.concatenate(pair) for pair in zip(rows, others, strict=True)]
    matrix, offset = solved(together[0], together[1], min(_DOUBTS, key=error))
    return matrix[:coordinates], matrix[coordinates:], offset


def _rows(offsets: Tensor, features: Tensor, controls: Tensor) -> tuple[FloatArray, FloatArray]:
    pieces = [one.numpy().astype(np.float64).reshape(len(one), -1) for one in (offsets, features)]
    return np.concatenate(pieces, axis=1), controls.numpy().astype(np.float64)
