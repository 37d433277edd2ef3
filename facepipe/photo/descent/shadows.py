"""What a face keeps from light in one photo.

The share of each light harmonic that creases, nostrils and lips lose is precomputed radiance transfer (Sloan, Kautz,
Snyder, "Precomputed Radiance Transfer for Real-Time Rendering in Dynamic, Low-Frequency Lighting Environments",
SIGGRAPH 2002) for matt surfaces and nine harmonics, without interreflection. What is kept is the difference to a
surface that nothing shades, so that gradients still flow through the normals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from facepipe.photo.renderer.camera import Camera
from facepipe.photo.renderer.face_model import FaceModel
from facepipe.photo.renderer.light import KERNEL, basis
from facepipe.photo.renderer.rasterise import rasterise

DIRECTIONS = 96
RESOLUTION = 224  # pixels a side of the view from each direction
_FAR = 30.0  # sizes of the face that a view is taken from: nearly parallel rays
_SLACK = 0.008  # of that size, by which something must be nearer to shade a point
_SHARP = 448  # pixels a side of a lamp's view


def sky_visibility(points: Tensor, triangles: Tensor, directions: int | None = None) -> Tensor:
    """(directions, n) share of the light from each direction of `sphere`, None: `DIRECTIONS`, that reaches points."""
    all_around = sphere(DIRECTIONS if directions is None else directions).to(points.dtype)
    if not len(triangles):
        return points.new_ones((len(all_around), len(points)))
    used = torch.unique(triangles)
    with torch.no_grad():
        return torch.stack([visibility(points, triangles, direction, used=used) for direction in all_around])


def transfer_of(sky: Tensor, normals: Tensor) -> Tensor:
    """(n, 9) what self-shadowing adds to the harmonics of unit normals (n, 3): ``shade = (basis + this) light``.

    Without gradients; `sky` (directions, n) is as `sky_visibility` gives it.
    """
    with torch.no_grad():
        all_around = sphere(len(sky)).to(normals.dtype)
        lost = ((normals @ all_around.mT).clamp(min=0) * (1 - sky.mT)) @ basis(all_around)
        # light coefficients hold the cosine's share, as normals take them; what arrives from a direction does not
        return -lost * (4 / len(sky)) / lost.new_tensor(KERNEL)


def visibility(
    points: Tensor, triangles: Tensor, direction: Tensor, resolution: int = RESOLUTION, *, used: Tensor | None = None
) -> Tensor:
    """(n,) share of the light from a unit direction (3,) that reaches points (n, 3), of four pixels; without gradients.

    :param resolution: pixels a side of the view from that direction
    :param used: numbers of the points that triangles have, each once; None: found, for each view anew
    """
    used = torch.unique(triangles) if used is None else used
    low, high = points[used].amin(0), points[used].amax(0)
    points, size = points - (low + high) / 2, float((high - low).norm())
    least = torch.zeros_like(direction)
    least[int(direction.abs().argmin())] = 1
    right = torch.linalg.cross(least, direction)
    right = right / right.norm()
    across = right, torch.linalg.cross(right, direction)
    middle, scale = resolution / 2, resolution / (1.02 * size)
    depth = _FAR * size - points @ direction
    shrink = _FAR * size / depth
    x, y = (middle + points @ one * scale * shrink for one in across)
    # Compared as 1 / depth, which is what the rasteriser gives; without the slack, surfaces shadow themselves.
    nearness = rasterise(torch.stack([x, y, depth], dim=1), triangles, resolution, resolution).nearness
    limit = 1 / (depth - _SLACK * size)
    left, top = (x - 0.5).floor(), (y - 0.5).floor()
    fx, fy = x - 0.5 - left, y - 0.5 - top
    arriving = torch.zeros_like(x)
    for step in range(4):
        column, row = left + step % 2, top + step // 2
        share = (fx if step % 2 else 1 - fx) * (fy if step // 2 else 1 - fy)
        at = row.clamp(0, resolution - 1).long() * resolution + column.clamp(0, resolution - 1).long()
        arriving += share * (nearness[at] <= limit)
    return arriving


def sphere(count: int) -> Tensor:
    """(count, 3) unit directions, evenly spread (a Fibonacci lattice)."""
    number = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * number / count
    turn = math.pi * (1 + math.sqrt(5)) * number
    flat = (1 - z * z).sqrt()
    return torch.stack([flat * turn.cos(), flat * turn.sin(), z], dim=1)


@dataclass(frozen=True, kw_only=True)
class Shadows:
    """Of each point, without gradients: a face that moves a little keeps them, one that moves far needs new ones."""

    transfer: Tensor  # (n, 9) as `Look.shadow`
    arriving: Tensor  # (n,) as `KeyLight.arriving`

    @classmethod
    def from_lamp(cls, model: FaceModel, points: Tensor, camera: Camera, lamp: Tensor) -> Shadows:
        """Those of world points (n, 3) for a lamp (8,) as `KeyLight`."""
        sky = sky_visibility(camera.to_camera(points), model.outline.triangles)
        transfer = shadows_of_harmonics(model, points, camera, sky)
        return cls(transfer=transfer, arriving=shadows_of_lamp(model, points, camera, lamp))


def shadows_of_harmonics(model: FaceModel, points: Tensor, camera: Camera, sky: Tensor) -> Tensor:
    """(n, 9) as `Look.shadow`, of world points (n, 3) and their `sky_visibility` in camera coordinates."""
    with torch.no_grad():
        transfer = transfer_of(sky, model.normals(points) @ camera.matrix.mT)
        return transfer * transfer.new_tensor(KERNEL)  # a window: nine harmonics of sharp shadows ring


def shadows_of_lamp(model: FaceModel, points: Tensor, camera: Camera, lamp: Tensor) -> Tensor:
    """(n,) as `KeyLight.arriving`, of world points (n, 3) and a lamp (8,); of a dark one nothing: it stays dark."""
    with torch.no_grad():
        if not bool((lamp[3:6] > 0).any()):
            return points.new_zeros(len(points))
        local = camera.to_camera(points)
        return visibility(local, model.outline.triangles, normalize(lamp[:3], dim=0), _SHARP)
