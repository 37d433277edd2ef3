"""Bilinear texture lookups with gradients to the texels and to where they are read."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from facepipe.learn.rows import take

Wrap = Literal["repeat", "mirror", "clamp"]


def bilinear(texels: Tensor, uv: Tensor, wrap_s: Wrap = "repeat", wrap_t: Wrap = "repeat") -> Tensor:
    """(m, c) values of texels (h, w, c), top row first, at UVs (m, 2) with v up.

    The same lookup as the pictures of `facepipe.pictures`: texel centres are half a texel inside.
    """
    height, width, channels = texels.shape
    x = uv[:, 0] * width - 0.5
    y = (1 - uv[:, 1]) * height - 0.5
    left, above = x.detach().floor(), y.detach().floor()
    fx, fy = (x - left)[:, None], (y - above)[:, None]
    columns = [_wrap(left.long() + step, width, wrap_s) for step in (0, 1)]
    rows = [_wrap(above.long() + step, height, wrap_t) * width for step in (0, 1)]
    flat = texels.reshape(-1, channels)
    upper, lower = (
        torch.lerp(take(flat, row + columns[0]), take(flat, row + columns[1]), fx.expand(-1, channels)) for row in rows
    )
    return torch.lerp(upper, lower, fy.expand(-1, channels))


def _wrap(index: Tensor, size: int, mode: Wrap) -> Tensor:
    if mode == "clamp":
        return index.clamp(0, size - 1)
    if mode == "mirror":
        folded = index % (2 * size)
        return torch.where(folded < size, folded, 2 * size - 1 - folded)
    return index % size
