"""How much the pixels of two pictures differ, fine detail before slow shading.

The light of a photo is never that of nine spherical harmonics: shadows, highlights and creases differ from it over
many pixels, while lips, brows, lids and outlines differ over few. So the difference is split into bands (the Laplacian
pyramid of Burt and Adelson, 1983), of which the finest count most.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

SPREAD = (0.03, 0.03, 0.04, 0.20)  # sRGB by which each band is off where a fit is good, finest first; last the rest
_BEND = 1.5  # spreads beyond which a difference counts linearly


def color_loss(image: Tensor, photo: Tensor, coverage: Tensor, spread: Sequence[float] = SPREAD) -> Tensor:
    """Mean over the covered pixels and bands of the differences of pictures (h, w, 3), in spreads, by Huber's norm.

    :param coverage: (h, w) 0..1
    """
    rest = (image - photo).permute(2, 0, 1)[None]
    total = image.new_zeros(())
    for number, width in enumerate(spread):
        band = rest
        if number < len(spread) - 1:
            coarse = _halved(rest)
            band = rest - functional.interpolate(coarse, rest.shape[2:], mode="bilinear", align_corners=False)
            rest = coarse
        area = 4.0**number  # a coarse pixel stands for many
        total = total + area * _huber(band / width).mean(dim=1).sum()
    return total / (len(spread) * coverage.detach().sum().clamp(min=1))


def _halved(picture: Tensor) -> Tensor:
    """Half as many pixels each way, smoothed."""
    padded = functional.pad(picture, (0, picture.shape[3] % 2, 0, picture.shape[2] % 2), mode="replicate")
    smooth = functional.avg_pool2d(functional.pad(padded, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    return functional.avg_pool2d(smooth, 2)


def _huber(values: Tensor) -> Tensor:
    size = values.abs()
    return torch.where(size < _BEND, 0.5 * size * size, _BEND * (size - 0.5 * _BEND))
