"""Light and colours that bring a face of known shape nearest to its photos, by the measure of the joint loss.

`relight` solves least squares of linear light, robustly; the joint loss sees sRGB in bands. Shape and pose held, what a
pixel shows of the face stays, and a step costs little: many of them fit before a descent.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from facepipe.learn.light import KeyLight, hue_cost, shade
from facepipe.learn.photo.descent import Adam
from facepipe.learn.photo.joint_loss import JointLoss, color_loss
from facepipe.learn.photo.seen_surface import SeenSurface
from facepipe.learn.photo.unknowns import Unknowns
from facepipe.learn.photo.working_photo import to_srgb

_STEPS, _RATE, _SLOWEST = 60, 0.05, 0.1


class _View:
    """What a photo says of light, in which nothing but light and colours moves."""

    def __init__(self, loss: JointLoss, at: Unknowns, view: int) -> None:
        photo, look = loss.photos[view], loss.look(at, view)
        points = loss.model.rig(loss.sliders(at.shares), loss.weights(at.expressions[view]))
        self.surface = SeenSurface.from_camera(loss.model, points, look.camera, photo.size)
        self.shadow = None if look.shadow is None else self.surface.at_pixels(look.shadow)
        self.arriving = None if look.key is None else self.surface.at_pixels(look.key.arriving)
        self.photo, self.spread, self.options = photo, loss.spreads[view], loss.options
        covered = torch.zeros(photo.size).flatten()
        self.coverage = covered.index_fill(0, self.surface.raster.pixels, 1.0).reshape(photo.size)

    def loss(self, light: Tensor, key: Tensor, tint: Tensor) -> Tensor:
        """The terms that light changes, weighted."""
        surface = self.surface
        albedo, white = surface.colors * tint.exp()[surface.materials], shade(surface.normals, light, self.shadow)
        color = white * albedo
        if self.arriving is not None:
            lamp = KeyLight(numbers=key, arriving=self.arriving)
            matt, mirrored = lamp.shade(surface.normals, surface.towards_eye, self.arriving)
            color = color + matt * albedo + mirrored
        image = to_srgb(surface.raster.paint(color, self.photo.linear))
        color = color_loss(image, self.photo.pixels, self.coverage, self.spread)
        return self.options.color * color + self.options.hue * hue_cost(light, key)


def in_better_light(loss: JointLoss, at: Unknowns, steps: int = _STEPS) -> Unknowns:
    """The same face and poses in light and tints of less joint loss; gradient descent, the best of all steps."""
    with torch.no_grad():
        views = [_View(loss, at, view) for view in range(len(loss.photos))]
    unknowns = [one.detach().clone().requires_grad_() for one in (at.light, at.key, at.tint)]
    best, least, move = unknowns, math.inf, Adam()
    for step in range(steps):
        total = torch.stack(
            [view.loss(unknowns[0][i], unknowns[1][i], unknowns[2]) for i, view in enumerate(views)]
        ).mean()
        if float(total.detach()) < least:
            best, least = [one.detach().clone() for one in unknowns], float(total.detach())
        slopes = torch.autograd.grad(total, unknowns, allow_unused=True, materialize_grads=True)
        pace = _RATE * (1 - (1 - _SLOWEST) * step / steps)
        with torch.no_grad():
            for unknown, change in zip(unknowns, move(slopes), strict=True):
                unknown -= pace * change
            unknowns[1][:, 3:7].clamp_(min=0)
    light, key, tint = (one.detach().clone().requires_grad_() for one in best)
    return replace(at, light=light, key=key, tint=tint)
