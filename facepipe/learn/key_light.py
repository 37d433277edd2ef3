"""A distant lamp beside the harmonics of light: what has sharp shadows and highlights.

Nine harmonics hold all that a matt convex body shows of any light; a nose's shadow and the shine of a forehead they
don't. One lamp, the key light of a portrait, shows most of both.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor
from torch.nn import functional

NUMBERS = 8  # of a lamp: direction, colour, strength of the shine and logarithm of its exponent
DARK = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 3.0)  # no lamp
_FACING = 0.04  # what a surface of index of refraction 1.5 reflects of light that falls straight on
_DIM = 1e-2  # linear light that has no hue worth the name
_ALIKE = 0.25  # by which hues may differ: lamps and windows do


@dataclass(frozen=True, kw_only=True)
class KeyLight:
    """A lamp in camera coordinates, and how much of it reaches each point."""

    numbers: Tensor  # (8,): direction (3, any length), linear colour (3), shine, logarithm of the exponent
    arriving: Tensor  # (n,) 0..1, as `facepipe.learn.self_shadow.visibility`

    def shade(self, normals: Tensor, towards_eye: Tensor, arriving: Tensor) -> tuple[Tensor, Tensor]:
        """(m, 3) linear light on white matt surfaces, and (m, 3) what they mirror whatever their colour.

        Lambert, and normalised Blinn-Phong with Schlick's Fresnel term.

        :param normals: (m, 3) unit
        :param towards_eye: (m, 3) unit
        :param arriving: (m,) of the points, interpolated
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
