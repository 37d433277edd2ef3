"""Crops of pictures with gradients: where they lie, `facepipe.geometry.face_crops` tells."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.rig.torch import torch


def sample_crop(image: torch.Tensor, matrix: FloatArray, size: int) -> torch.Tensor:
    """(1, 3, size, size) the crop of an image (h, w, 3), bilinear, with gradients to the image.

    An image of more than 1.5 times the crop's resolution is averaged over whole pixels first, so that nothing
    flickers. What lies outside the image has the colour of its nearest border pixel.

    :param matrix: (2, 3) from crop pixels to image pixels
    """
    pixels = image.permute(2, 0, 1)[None]
    factor = max(1, round(float(np.hypot(*matrix[:, 0]))))
    if factor > 1:
        pixels = torch.nn.functional.avg_pool2d(pixels, factor, ceil_mode=True, count_include_pad=False)
    centres = np.arange(size) + 0.5
    x, y = np.meshgrid(centres, centres)
    places = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.asarray(matrix).T / factor
    grid = 2 * places / (pixels.shape[3], pixels.shape[2]) - 1
    return torch.nn.functional.grid_sample(
        pixels, torch.as_tensor(grid[None], dtype=image.dtype, device=image.device), "bilinear", "border", False
    )
