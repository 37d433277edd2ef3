"""Where the lamp of a photo stands whose shadows and highlights a face of known shape shows."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from facepipe.learn.key_light import DARK, KeyLight
from facepipe.learn.photo.relight import light_of
from facepipe.learn.photo.seen_surface import SeenSurface
from facepipe.learn.self_shadow import sphere, visibility

_CANDIDATES = 96
_BEHIND = -0.2  # cosine to the view below which a lamp hardly lights what the photo shows
_RINGS = (math.radians(10.0), math.radians(5.0))  # around the best so far, each of eight more
_SAMPLES = 4000  # pixels
_OUTLIER = 0.1  # of linear light: wider than shadows and highlights, which tell where a lamp stands
_SHINE = (0.1, 2.0)  # of a lamp to begin with
_COVERED = 0.3  # cost without a lamp from which on pixels show hair, clothes or make-up rather than a face's shading


@dataclass(frozen=True)
class _Candidate:
    cost: float
    numbers: Tensor  # (8,) as `KeyLight`


def find_key(surface: SeenSurface, points: Tensor, seen: Tensor, harmonics: Tensor, colors: Tensor) -> Tensor | None:
    """(8,) as `KeyLight`: the lamp that, beside harmonics, explains a photo best; None: none does, or nothing can.

    Directions are tried, all around and then nearer and nearer; colour and highlight are robust least squares. What is
    compared is the material with the most pixels, the skin: hair and eyes shine otherwise.

    :param points: (n, 3) camera coordinates
    :param seen: (p, 3) linear light of the photo at the surface's pixels
    :param harmonics: (p, 9) how white surfaces there take the light that is no lamp
    :param colors: (p, 3) linear colours of the surface
    """
    if not len(seen):
        return None
    with torch.no_grad():
        search = _Search(surface, points, seen, harmonics, colors)
        without = search.cost_without()
        if without >= _COVERED:
            return None
        found = search.best(one for one in sphere(_CANDIDATES).to(points.dtype) if one[2] > _BEHIND)
        if found.cost >= without:
            return None
        for angle in _RINGS:
            other = search.best(_around(found.numbers[:3], angle))
            found = other if other.cost < found.cost else found
        return found.numbers


class _Search:
    """The pixels that lamps are tried on."""

    def __init__(self, surface: SeenSurface, points: Tensor, seen: Tensor, harmonics: Tensor, colors: Tensor) -> None:
        main = torch.bincount(surface.materials).argmax()
        chosen = (surface.materials == main).nonzero()[:, 0]
        self._chosen = chosen[:: max(1, len(chosen) // _SAMPLES)]
        self._surface, self._points = surface, points
        self._normals, self._towards_eye = surface.normals[self._chosen], surface.towards_eye[self._chosen]
        self._seen, self._harmonics, self._colors = (one[self._chosen] for one in (seen, harmonics, colors))

    def best(self, directions: Iterable[Tensor]) -> _Candidate:
        """The lamp of the least cost in one of the directions (3,)."""
        return min((self._lamp(one) for one in directions), key=lambda candidate: candidate.cost)

    def cost_without(self) -> float:
        """What harmonics alone leave."""
        light, _ = light_of(self._harmonics, self._colors, self._seen, outlier=_OUTLIER)
        return self._cost(self._harmonics @ light * self._colors)

    def _lamp(self, towards: Tensor) -> _Candidate:
        numbers = self._seen.new_tensor(DARK)
        numbers[:3], numbers[3:7] = towards, 1.0
        arriving = visibility(self._points, self._surface.triangles, towards)
        lamp = KeyLight(numbers=numbers, arriving=arriving)
        here = self._surface.at_pixels(arriving)[self._chosen]
        matt, mirrored = (one[:, :1] for one in lamp.shade(self._normals, self._towards_eye, here))
        shape = torch.cat([self._harmonics, matt], dim=1)
        light, glint = light_of(shape, self._colors, self._seen, mirrored, _OUTLIER)
        if float(light[-1].mean()) <= 0:
            return _Candidate(math.inf, numbers)
        numbers[3:6] = light[-1].clamp(min=0)
        numbers[6] = (glint.mean() / numbers[3:6].mean()).clamp(*_SHINE)
        shown = shape @ light * self._colors + mirrored * numbers[6] * numbers[3:6]
        return _Candidate(self._cost(shown), numbers)

    def _cost(self, shown: Tensor) -> float:
        square = ((shown - self._seen) / _OUTLIER) ** 2
        return float((square / (1 + square)).mean())


def _around(direction: Tensor, angle: float) -> list[Tensor]:
    """Eight unit directions at an angle from one."""
    least = torch.zeros_like(direction)
    least[int(direction.abs().argmin())] = 1
    across = normalize(torch.linalg.cross(least, direction), dim=0)
    up = torch.linalg.cross(direction, across)
    turns = [2 * math.pi * k / 8 for k in range(8)]
    return [
        direction * math.cos(angle) + (across * math.cos(turn) + up * math.sin(turn)) * math.sin(angle)
        for turn in turns
    ]
