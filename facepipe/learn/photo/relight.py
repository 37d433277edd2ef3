"""The light of a photo and the colours of a face in it, in closed form where points and camera are known."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from facepipe.learn.camera import Camera, rotation_matrices
from facepipe.learn.face_model import FaceModel
from facepipe.learn.light import ambient, basis
from facepipe.learn.photo.working_photo import WorkingPhoto
from facepipe.learn.rasterise import barycentrics, facing, interpolate, rasterise

_ROUNDS = 4
_OUTLIER = 0.06  # of linear light, beyond which pixels hardly count: shadows, highlights, hair over the brow
_RIDGE = (1e-5, *(1e-3,) * 3, *(4e-3,) * 5)  # keeps harmonics that few normals show small
_DOUBT = 2e-4  # of all the light, with which a material keeps its own colour among the others
_LEAST, _LARGEST = 0.05, 20.0  # factor of a colour


def relight(
    model: FaceModel, points: Tensor, camera: Camera, photo: WorkingPhoto, shadow: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Light (9, 3) and factors of the materials' colours (materials, 3) that bring the face nearest to a photo.

    Robust least squares, light and colours in turn; the material with the most pixels keeps its own colour, since
    light and colour can't be told apart but for their ratios.

    :param points: (n, 3) world points
    :param camera: of the photo's working pixels
    :param shadow: (n, 9) as `Look.shadow`
    """
    with torch.no_grad():
        local, triangles = camera.to_camera(points), model.outline.triangles
        screen = camera.to_pixels(local)
        raster = rasterise(screen, triangles, *photo.size)
        weights = barycentrics(screen, triangles, raster)
        normals = model.normals(points) @ rotation_matrices(camera.rotation).mT
        normals = interpolate(normals, triangles, raster, weights) * facing(screen, triangles, raster)
        shape = basis(functional.normalize(normals, dim=1))
        if shadow is not None:
            shape = shape + interpolate(shadow, triangles, raster, weights)
        own = model.colors(raster, weights)
        seen = photo.linear.reshape(-1, 3)[raster.pixels]
        material = model.colors.materials[raster.triangles]
        count = len(model.colors.names)
        tint = own.new_ones((count, 3))
        light = ambient(own.new_full((3,), 0.5))
        if not len(own):
            return light, tint
        for _ in range(_ROUNDS):
            light = _light(shape, own * tint[material], seen)
            tint = _tint(tint, own * (shape @ light).clamp(min=1e-3), seen, material, count)
        main = int(torch.bincount(material, minlength=count).argmax())
        return light * tint[main], tint / tint[main]


def _light(shape: Tensor, color: Tensor, seen: Tensor) -> Tensor:
    """(9, 3) harmonics under which surfaces of these colours look as seen."""
    columns = []
    for channel in range(3):
        rows, target = shape * color[:, channel : channel + 1], seen[:, channel]
        ridge = torch.diag(rows.new_tensor(_RIDGE)) * (rows * rows).sum() / 3
        trust = torch.ones_like(target)
        for _ in range(3):
            solution = torch.linalg.solve(rows.T @ (rows * trust[:, None]) + ridge, rows.T @ (trust * target))
            trust = 1 / (1 + ((rows @ solution - target) / _OUTLIER) ** 2)
        columns.append(solution)
    return torch.stack(columns, dim=1)


def _tint(tint: Tensor, lit: Tensor, seen: Tensor, material: Tensor, count: int) -> Tensor:
    """(materials, 3) factors of lit colours, robust against single pixels; those hardly seen change as all do."""
    off = (lit * tint[material] - seen).abs().sum(dim=1, keepdim=True)
    trust = 1 / (1 + (off / (3 * _OUTLIER)) ** 2)
    above, below = (lit.new_zeros((count, 3)).index_add_(0, material, trust * lit * each) for each in (seen, lit))
    ratio, doubt = above.sum(dim=0) / below.sum(dim=0).clamp(min=1e-9), _DOUBT * below.sum(dim=0)
    return ((above + doubt * ratio) / (below + doubt).clamp(min=1e-9)).clamp(_LEAST, _LARGEST)
