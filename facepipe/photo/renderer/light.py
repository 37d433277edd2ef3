"""Light as spherical harmonics: 9 coefficients a colour channel, on normals.

Ramamoorthi and Hanrahan, "An Efficient Representation for Irradiance Environment Maps", SIGGRAPH 2001: what a matt
surface receives from any distant light is, to about 1 % on average, a quadratic function of its normal.

Nine harmonics hold all that a matt convex body shows of any light; a nose's shadow and the shine of a forehead they
don't. One distant lamp beside them, the key light of a portrait, shows most of both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

NUMBERS = 8  # of a lamp: direction, colour, strength of the shine and logarithm of its exponent
DARK = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 3.0)  # no lamp
_FACING = 0.04  # what a surface of index of refraction 1.5 reflects of light that falls straight on
_DIM = 1e-2  # linear light that has no hue worth the name
_ALIKE = 0.25  # by which hues may differ: lamps and windows do
KERNEL = (1.0, *(2 / 3,) * 3, *(1 / 4,) * 5)  # the cosine's share of each band, over pi (their equation 8)


@dataclass(frozen=True, kw_only=True)
class KeyLight:
    """A lamp in camera coordinates, and how much of it reaches each point."""

    numbers: Tensor  # (8,): direction (3, any length), linear colour (3), shine, logarithm of the exponent
    arriving: Tensor  # (n,) 0..1, as `facepipe.photo.descent.shadows.visibility`

    def shade(self, normals: Tensor, towards_eye: Tensor, arriving: Tensor) -> tuple[Tensor, Tensor]:
        """(m, 3) linear light on white matt surfaces, and (m, 3) what they mirror whatever their colour.

        Lambert, and normalised Blinn-Phong with Schlick's Fresnel term, by unit normals and directions (m, 3);
        `arriving` (m,) is that of the points, interpolated.
        """
        direction = functional.normalize(self.numbers[:3], dim=0)
        color, shine, exponent = self.numbers[3:6].clamp(min=0), self.numbers[6].clamp(min=0), self.numbers[7].exp()
        cosine = (normals @ direction).clamp(min=0)
        matt = (cosine * arriving)[:, None] * color
        half = functional.normalize(towards_eye + direction, dim=1)
        grazing = 1 - (towards_eye * half).sum(dim=1).clamp(0, 1)
        mirrored = _FACING + (1 - _FACING) * grazing**5
        lobe = (exponent + 2) / 8 * (normals * half).sum(dim=1).clamp(min=1e-4) ** exponent
        return matt, (shine * mirrored * lobe)[:, None] * matt


def hue_cost(light: Tensor, key: Tensor) -> Tensor:
    """How much a lamp (8,) and the light around it (9, 3) differ in hue beyond what is usual: squares, mostly 0.

    Without it a blue lamp and yellow harmonics, or the reverse, paint patches on a face whose colours don't fit.
    """
    lamp, around = key[3:6].clamp(min=0), light[0].clamp(min=0)
    hues = [(one + _DIM) / (one.mean() + _DIM) for one in (lamp, around)]
    return (((hues[0] - hues[1]).abs() - _ALIKE).clamp(min=0) ** 2).sum() * (lamp.mean() / _DIM).clamp(max=1)


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
