"""The light of a photo and the colours of a face in it, in closed form where points and camera are known."""

from __future__ import annotations

import torch
from torch import Tensor

from facepipe.learn.light import ambient
from facepipe.learn.photo.seen_surface import SeenSurface

_ROUNDS = 4
OUTLIER = 0.06  # of linear light, beyond which pixels hardly count: shadows, highlights, hair over the brow
_RIDGE = (1e-5, *(1e-3,) * 3, *(4e-3,) * 5, 1e-3, 1e-6)  # keeps harmonics that few normals show small
_DOUBT = 2e-4  # of all the light, with which a material keeps its own colour among the others
_LEAST, _LARGEST = 0.05, 20.0  # factor of a colour


def relight(surface: SeenSurface, seen: Tensor, shape: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Light (k, 3) and factors of the materials' colours (count, 3) that bring a face nearest to a photo.

    Robust least squares, light and colours in turn; the material with the most pixels keeps its own colour, since
    light and colour can't be told apart but for their ratios.

    :param seen: (p, 3) linear light of the photo at the surface's pixels
    :param shape: (p, k) how white surfaces there take each number of the light: 9 harmonics, and a lamp where k is 10
    :param count: of materials
    """
    with torch.no_grad():
        tint = seen.new_ones((count, 3))
        light = ambient(seen.new_full((3,), 0.5))
        light = torch.cat([light, light.new_zeros((shape.shape[1] - len(light), 3))])
        if not len(seen):
            return light, tint
        for _ in range(_ROUNDS):
            light, _ = light_of(shape, surface.colors * tint[surface.materials], seen)
            lit = surface.colors * (shape @ light).clamp(min=1e-3)
            tint = _tint(tint, lit, seen, surface.materials, count)
        main = int(torch.bincount(surface.materials, minlength=count).argmax())
        return light * tint[main], tint / tint[main]


def light_of(
    shape: Tensor, color: Tensor, seen: Tensor, mirrored: Tensor | None = None, outlier: float = OUTLIER
) -> tuple[Tensor, Tensor]:
    """(k, 3) numbers of the light under which surfaces of these colours look as seen, and (m, 3) of what they mirror.

    :param shape: (p, k) how white surfaces take each number
    :param mirrored: (p, m) light that surfaces mirror whatever their colour; None: none
    :param outlier: linear light that pixels may be off before they count less
    """
    white = seen[:, :0] if mirrored is None else mirrored
    columns = []
    for channel in range(3):
        rows = torch.cat([shape * color[:, channel : channel + 1], white], dim=1)
        target, trust = seen[:, channel], torch.ones_like(seen[:, channel])
        ridge = torch.diag(rows.new_tensor(_RIDGE[: rows.shape[1]])) * (rows * rows).sum() / 3
        for _ in range(3):
            solution = torch.linalg.solve(rows.T @ (rows * trust[:, None]) + ridge, rows.T @ (trust * target))
            trust = 1 / (1 + ((rows @ solution - target) / outlier) ** 2)
        columns.append(solution)
    light, glint = torch.stack(columns, dim=1).split([shape.shape[1], white.shape[1]])
    return light, glint


def _tint(tint: Tensor, lit: Tensor, seen: Tensor, material: Tensor, count: int) -> Tensor:
    """(materials, 3) factors of lit colours, robust against single pixels; those hardly seen change as all do."""
    off = (lit * tint[material] - seen).abs().sum(dim=1, keepdim=True)
    trust = 1 / (1 + (off / (3 * OUTLIER)) ** 2)
    above, below = (lit.new_zeros((count, 3)).index_add_(0, material, trust * lit * each) for each in (seen, lit))
    ratio, doubt = above.sum(dim=0) / below.sum(dim=0).clamp(min=1e-9), _DOUBT * below.sum(dim=0)
    return ((above + doubt * ratio) / (below + doubt).clamp(min=1e-9)).clamp(_LEAST, _LARGEST)
