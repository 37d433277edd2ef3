"""Where the lamp of a photo stands whose shadows a face of known shape shows."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from facepipe.learn.photo.relight import OUTLIER, light_of
from facepipe.learn.photo.seen_surface import SeenSurface
from facepipe.learn.self_shadow import sphere, visibility

_CANDIDATES = 96
_BEHIND = -0.2  # cosine to the view below which a lamp hardly lights what the photo shows
_RINGS = (math.radians(10.0), math.radians(5.0))  # around the best so far, each of eight more
_SAMPLES = 4000  # pixels


def find_key(surface: SeenSurface, points: Tensor, seen: Tensor, harmonics: Tensor, colors: Tensor) -> Tensor | None:
    """(3,) unit direction of the lamp that, beside harmonics, explains a photo best; None: none does.

    :param points: (n, 3) camera coordinates
    :param seen: (p, 3) linear light of the photo at the surface's pixels
    :param harmonics: (p, 9) how white surfaces there take the light that is no lamp
    :param colors: (p, 3) linear colours of the surface
    """
    chosen = torch.arange(0, len(seen), max(1, len(seen) // _SAMPLES))

    def cost(column: Tensor | None) -> float:
        shape = harmonics if column is None else torch.cat([harmonics, column[:, None]], dim=1)
        light = light_of(shape[chosen], colors[chosen], seen[chosen])
        if column is not None and float(light[-1].mean()) <= 0:
            return math.inf
        off = ((shape[chosen] @ light) * colors[chosen] - seen[chosen]) / OUTLIER
        return float((off**2 / (1 + off**2)).mean())

    def best(directions: Iterable[Tensor]) -> tuple[float, Tensor | None]:
        found: tuple[float, Tensor | None] = (math.inf, None)
        for direction in directions:
            arriving = surface.at_pixels(visibility(points, surface.triangles, direction))
            reached = cost((surface.normals @ direction).clamp(min=0) * arriving)
            if reached < found[0]:
                found = reached, direction
        return found

    if not len(seen):
        return None
    with torch.no_grad():
        least, towards = best(one for one in sphere(_CANDIDATES).to(points.dtype) if one[2] > _BEHIND)
        if towards is None or least >= cost(None):
            return None
        for angle in _RINGS:
            reached, other = best(_around(towards, angle))
            if other is not None and reached < least:
                least, towards = reached, other
    return towards


def _around(direction: Tensor, angle: float) -> list[Tensor]:
    """Eight unit directions at an angle from one."""
    least = torch.zeros_like(direction)
    least[int(direction.abs().argmin())] = 1
    across = torch.nn.functional.normalize(torch.linalg.cross(least, direction), dim=0)
    up = torch.linalg.cross(direction, across)
    turns = [2 * math.pi * k / 8 for k in range(8)]
    return [
        direction * math.cos(angle) + (across * math.cos(turn) + up * math.sin(turn)) * math.sin(angle)
        for turn in turns
    ]
