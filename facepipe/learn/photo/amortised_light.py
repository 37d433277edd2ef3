"""Light and colours that bring a face of known shape nearest to its photos, by the measure of the joint loss.

`relight` solves least squares of linear light, robustly; the joint loss sees sRGB in bands. Shape and pose held, what a
pixel shows of the face stays, and a step costs little: many of them fit before a descent of few steps.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from facepipe.learn.camera import rotation_matrices
from facepipe.learn.light import shade
from facepipe.learn.photo.color_loss import color_loss
from facepipe.learn.photo.descent import Adam
from facepipe.learn.photo.joint_loss import JointLoss
from facepipe.learn.photo.unknowns import Unknowns
from facepipe.learn.photo.working_photo import to_srgb
from facepipe.learn.rasterise import Raster, barycentrics, facing, interpolate, rasterise

_STEPS, _RATE, _SLOWEST = 60, 0.05, 0.1


class _View:
    """What the pixels of one photo show of a face."""

    def __init__(self, loss: JointLoss, at: Unknowns, view: int) -> None:
        model, photo, look = loss.model, loss.photos[view], loss.look(at, view)
        points = model.rig(loss.sliders(at.shares), loss.weights(at.expressions[view]))
        screen, triangles = look.camera.project(points), model.outline.triangles
        self.raster: Raster = rasterise(screen, triangles, *photo.size)
        weights = barycentrics(screen, triangles, self.raster)
        normals = model.normals(points) @ rotation_matrices(look.camera.rotation).mT
        normals = interpolate(normals, triangles, self.raster, weights) * facing(screen, triangles, self.raster)
        self.normals = functional.normalize(normals, dim=1)
        self.shadow = None if look.shadow is None else interpolate(look.shadow, triangles, self.raster, weights)
        self.colors = model.colors(self.raster, weights)
        self.material = model.colors.materials[self.raster.triangles]
        self.photo, self.spread = photo, loss.spreads[view]
        covered = torch.zeros(photo.size).flatten()
        self.coverage = covered.index_fill(0, self.raster.pixels, 1.0).reshape(photo.size)

    def loss(self, light: Tensor, tint: Tensor) -> Tensor:
        """The colours' term."""
        lit = shade(self.normals, light, self.shadow) * self.colors * tint.exp()[self.material]
        image = to_srgb(self.raster.paint(lit, self.photo.linear))
        return color_loss(image, self.photo.pixels, self.coverage, self.spread)


def in_better_light(loss: JointLoss, at: Unknowns, steps: int = _STEPS) -> Unknowns:
    """The same face and poses in light and tints of less joint loss; gradient descent, the best of all steps."""
    with torch.no_grad():
        views = [_View(loss, at, view) for view in range(len(loss.photos))]
    found = [at.light.detach().clone().requires_grad_(), at.tint.detach().clone().requires_grad_()]
    best, least, move = found, math.inf, Adam()
    for step in range(steps):
        total = torch.stack([view.loss(found[0][i], found[1]) for i, view in enumerate(views)]).mean()
        if float(total.detach()) < least:
            best, least = [one.detach().clone() for one in found], float(total.detach())
        slopes = torch.autograd.grad(total, found)
        pace = _RATE * (1 - (1 - _SLOWEST) * step / steps)
        with torch.no_grad():
            for unknown, change in zip(found, move(slopes, [pace, pace]), strict=True):
                unknown -= change
    light, tint = (one.detach().clone().requires_grad_() for one in best)
    return replace(at, light=light, tint=tint)
