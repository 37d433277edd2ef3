"""How far landmarks are off, in standard deviations, and what that counts."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.geometry.landmarks import face_size
from facepipe.photo.descent.landmark_rig import CONTOUR, COUNT

_ALONG = 0.15  # weight of a contour point's error along the contour: it slides
# Landmarks on either rim of the lids and of the lips, and how well their distance is known, of the size of the face:
# better than where they are, since what misplaces one misplaces the other too.
_UPPER, _LOWER = [37, 38, 43, 44, 61, 62, 63], [41, 40, 47, 46, 67, 66, 65]
_OPENING = 0.006
HUBER = 3.0  # standard deviations beyond which an error counts linearly


def standardised(marks: Tensor, outward: Tensor, targets: FloatArray, sigma: FloatArray) -> Tensor:
    """(..., l + 7, 2) how far landmarks are off targets, in standard deviations: the contour's across it and, weakly,
    along it; last the openings of lids and lips.

    :param marks: (..., l, 2) pixels
    :param outward: (..., 17, 2) directions across the contour
    :param targets: (l, 2) pixels
    :param sigma: (l, 1) pixels
    """
    off = marks - torch.as_tensor(targets)
    doubt = np.maximum(sigma[_UPPER], sigma[_LOWER]) * np.sqrt((1 / sigma**2).mean())  # 1: as landmarks usually count
    opening = off[..., _UPPER, :] - off[..., _LOWER, :]
    opening = opening / torch.as_tensor(_OPENING * face_size(targets[:COUNT]) * doubt)
    off = off / torch.as_tensor(sigma)
    on = off[..., CONTOUR, :]
    along = torch.stack([-outward[..., 1], outward[..., 0]], dim=-1)
    contour = torch.stack([(on * outward).sum(dim=-1), _ALONG * (on * along).sum(dim=-1)], dim=-1)
    return torch.cat([contour, off[..., CONTOUR.stop :, :], opening], dim=-2)


def huber(residuals: Tensor) -> Tensor:
    """Half the squares of residuals in standard deviations, growing linearly beyond `HUBER`."""
    size = residuals.abs()
    return torch.where(size <= HUBER, 0.5 * size * size, HUBER * (size - 0.5 * HUBER))
