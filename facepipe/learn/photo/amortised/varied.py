"""Pictures as the world varies them: noisy landmarks, other lights and cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from facepipe.core.arrays import FloatArray
from facepipe.geometry.landmarks import eye_distance
from facepipe.learn.photo.amortised.network import MEAN, STD
from facepipe.learn.photo.amortised.pictures import Crop, Picture

_GAIN, _CAST, _SHADE, _NOISE = 0.2, 0.07, 0.25, 0.02  # standard deviations; all but noise of logarithms
_CELLS = 4  # a side of the picture that shades


def noisy_landmarks(picture: Picture, sigma: float, rng: np.random.Generator) -> FloatArray:
    """(68, 2) with noise of up to `sigma`, a share of the distance of the outer eye corners."""
    spread = sigma * rng.uniform(0, 1) * max(eye_distance(picture.landmarks), 1.0)
    return np.asarray(picture.landmarks + spread * rng.standard_normal(picture.landmarks.shape))


def batch(crops: Sequence[Crop]) -> tuple[Tensor, Tensor]:
    """What the network takes."""
    return torch.stack([one.image for one in crops]), torch.stack([one.landmarks for one in crops])


def varied(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Crops (b, 3, s, s) as the network takes them, in other light and with noise."""
    count = len(images)
    gain = rng.normal(0, _GAIN, (count, 1, 1, 1)) + rng.normal(0, _CAST, (count, 3, 1, 1))
    shade = rng.normal(0, _SHADE, (count, 1, _CELLS, _CELLS)) * rng.random((count, 1, 1, 1))
    factor = functional.interpolate(_float(shade), images.shape[2:], mode="bicubic", align_corners=False)
    noise = torch.randn(images.shape, generator=torch.Generator().manual_seed(int(rng.integers(2**31))))
    strength = _float(_NOISE * rng.random((count, 1, 1, 1)))
    light = (images * STD + MEAN) * (factor + _float(gain)).exp() + strength * noise
    return (light.clamp(0, 1) - MEAN) / STD


def _float(values: FloatArray) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float32)
