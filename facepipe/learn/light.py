"""Light as spherical harmonics: 9 coefficients a colour channel, on normals.

Ramamoorthi and Hanrahan, "An Efficient Representation for Irradiance Environment Maps", SIGGRAPH 2001: what a matt
surface receives from any distant light is, to about 1 % on average, a quadratic function of its normal.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

KERNEL = (1.0, *(2 / 3,) * 3, *(1 / 4,) * 5)  # the cosine's share of each band, over pi (their equation 8)


def basis(normals: Tensor) -> Tensor:
    """(..., 9) real spherical harmonics of unit vectors (..., 3): 1, y, z, x, xy, yz, 3 z^2 - 1, zx, x^2 - y^2."""
    x, y, z = normals.unbind(-1)
    zeroth, first, second = math.sqrt(1 / (4 * math.pi)), math.sqrt(3 / (4 * math.pi)), math.sqrt(15 / (4 * math.pi))
    harmonics = [
        torch.full_like(x, zeroth),
        first * y,
        first * z,
        first * x,
        second * x * y,
        second * y * z,
        second / math.sqrt(12) * (3 * z * z - 1),
        second * z * x,
        second / 2 * (x * x - y * y),
    ]
    return torch.stack(harmonics, dim=-1)


def shade(normals: Tensor, light: Tensor, shadow: Tensor | None = None) -> Tensor:
    """(..., m, 3) linear colours of white matt surfaces with unit normals (..., m, 3) in light (..., 9, 3).

    What comes out below 0, where few coefficients ring, is 0. Light and normals stand in one frame: with camera
    coordinates, the light stays with the camera.

    :param shadow: (..., m, 9) what self-shadowing adds to the harmonics of the normals
    """
    harmonics = basis(normals)
    return ((harmonics if shadow is None else harmonics + shadow) @ light).clamp(min=0)


def ambient(color: Tensor) -> Tensor:
    """(..., 9, 3) light that shows every white surface in a linear colour (..., 3)."""
    rest = torch.zeros_like(color)
    return torch.stack([color * math.sqrt(4 * math.pi), *[rest] * 8], dim=-2)


def distant(direction: Tensor, color: Tensor) -> Tensor:
    """(..., 9, 3) light from unit directions (..., 3), of a linear colour (..., 3) where it falls straight on."""
    kernel = direction.new_tensor(KERNEL) * math.pi
    return (basis(direction) * kernel)[..., None] * color[..., None, :]
