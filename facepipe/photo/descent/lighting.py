"""The light that photos show on a face of known shape: harmonics, a lamp, shadows, tints of the face's colours.

Harmonics and tints have a closed form where points and camera are known; the lamp is searched for over directions.
`relight` solves least squares of linear light, robustly; the joint loss sees sRGB in bands, so `in_better_light`
descends on that: shape and pose are held, so what a pixel shows of the face stays, and a step costs little.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from operator import itemgetter

import torch
from torch import Tensor
from torch.nn.functional import normalize

from facepipe.photo.descent.descent import Adam, Unknowns
from facepipe.photo.descent.joint_loss import JointLoss, color_loss, single
from facepipe.photo.descent.landmark_fit import State
from facepipe.photo.descent.shadows import (
    Shadows,
    shadows_of_harmonics,
    shadows_of_lamp,
    sky_visibility,
    sphere,
    visibility,
)
from facepipe.photo.descent.working_photo import to_srgb
from facepipe.photo.renderer.camera import Camera
from facepipe.photo.renderer.face_model import FaceModel
from facepipe.photo.renderer.light import DARK, KeyLight, ambient, basis, hue_cost, shade
from facepipe.photo.renderer.rasterise import Raster, barycentrics, facing, interpolate, rasterise

_SHOWN = 0.5
_ROUNDS = 4
OUTLIER = 0.06  # of linear light, beyond which pixels hardly count: shadows, highlights, hair over the brow
_RIDGE = (1e-5, *(1e-3,) * 3, *(4e-3,) * 5, 1e-3, 1e-6)  # keeps harmonics that few normals show small
_DOUBT = 2e-4  # of all the light, with which a material keeps its own colour among the others
_LEAST, _LARGEST = 0.05, 20.0  # factor of a colour
_BEHIND = -0.2  # cosine to the view below which a lamp hardly lights what the photo shows
_RINGS = (math.radians(10.0), math.radians(5.0))  # around the best so far, each of eight more
_SAMPLES = 4000  # pixels
_OUTLIER = 0.1  # of linear light: wider than shadows and highlights, which show where a lamp stands
_SHINE = (0.1, 2.0)  # of a lamp to begin with
_COVERED = 0.3  # cost without a lamp from which on pixels show hair, clothes or make-up rather than a face's shading
_STEPS, _RATE, _SLOWEST = 60, 0.05, 0.1


@dataclass(frozen=True, kw_only=True)
class SeenSurface:
    """The covered pixels, p of them, without gradients."""

    raster: Raster
    triangles: Tensor  # (t, 3) of the face
    weights: Tensor  # (p, 3) barycentric coordinates
    normals: Tensor  # (p, 3) unit, camera coordinates, towards the viewer's side
    towards_eye: Tensor  # (p, 3) unit
    colors: Tensor  # (p, 3) linear, of the face's own materials
    materials: Tensor  # (p,) numbers into the names of the face's colours

    @classmethod
    def from_camera(cls, model: FaceModel, points: Tensor, camera: Camera, face: Tensor) -> SeenSurface:
        """:param points: (n, 3) world points
        :param face: (h, w) share of face in each pixel of the picture that the camera is for: where it is little,
            something else covers the surface
        """
        with torch.no_grad():
            local, triangles = camera.to_camera(points), model.outline.triangles
            screen = camera.to_pixels(local)
            raster = rasterise(screen, triangles, *face.shape)
            shown = face.reshape(-1)[raster.pixels] > _SHOWN
            raster = replace(raster, pixels=raster.pixels[shown], triangles=raster.triangles[shown])
            weights = barycentrics(screen, triangles, raster)
            normals = model.normals(points) @ camera.matrix.mT
            normals = interpolate(normals, triangles, raster, weights) * facing(screen, triangles, raster)
            return cls(
                raster=raster,
                triangles=triangles,
                weights=weights,
                normals=normalize(normals, dim=1),
                towards_eye=normalize(-interpolate(local, triangles, raster, weights), dim=1),
                colors=model.colors(raster, weights),
                materials=model.colors.materials[raster.triangles],
            )

    def at_pixels(self, values: Tensor) -> Tensor:
        """(p, ...) what points (n, ...) have, interpolated."""
        flat = values if values.ndim > 1 else values[:, None]
        found = interpolate(flat, self.triangles, self.raster, self.weights)
        return found if values.ndim > 1 else found[:, 0]


def relight(surface: SeenSurface, seen: Tensor, shape: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Light (k, 3) and factors of the materials' colours (count, 3) that bring a face nearest to a photo.

    Robust least squares, light and colours in turn; the material with the most pixels keeps its own colour, since
    light and colour can't be separated but for their ratios.

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
            light, _ = _light_of(shape, surface.colors * tint[surface.materials], seen)
            # Harmonics fall below 0 where little light comes: no colour can be found there.
            lit = surface.colors * (shape @ light).clamp(min=1e-3)
            # (materials, 3) factors of lit colours, robust against single pixels; those hardly seen change as all do
            off = (lit * tint[surface.materials] - seen).abs().sum(dim=1, keepdim=True)
            trust = 1 / (1 + (off / (3 * OUTLIER)) ** 2)
            above, below = (
                lit.new_zeros((count, 3)).index_add_(0, surface.materials, trust * lit * each) for each in (seen, lit)
            )
            ratio, doubt = above.sum(dim=0) / below.sum(dim=0).clamp(min=1e-9), _DOUBT * below.sum(dim=0)
            tint = ((above + doubt * ratio) / (below + doubt).clamp(min=1e-9)).clamp(_LEAST, _LARGEST)
        main = int(torch.bincount(surface.materials, minlength=count).argmax())
        return light * tint[main], tint / tint[main]


def _light_of(
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
            # reweighted by Cauchy's function; the ridge follows the rows' size, so that exposure does not matter
            solution = torch.linalg.solve(rows.T @ (rows * trust[:, None]) + ridge, rows.T @ (trust * target))
            trust = 1 / (1 + ((rows @ solution - target) / outlier) ** 2)
        columns.append(solution)
    light, glint = torch.stack(columns, dim=1).split([shape.shape[1], white.shape[1]])
    return light, glint


def _find_key(
    surface: SeenSurface, points: Tensor, seen: Tensor, harmonics: Tensor, colors: Tensor, sky: Tensor
) -> Tensor | None:
    """(8,) as `KeyLight`: the lamp that, beside harmonics, explains a photo best; None: none does, or nothing can.

    Directions are tried, all around and then nearer and nearer; colour and highlight are robust least squares. What is
    compared is the material with the most pixels, the skin: hair and eyes shine otherwise.

    :param points: (n, 3) camera coordinates
    :param seen: (p, 3) linear light of the photo at the surface's pixels
    :param harmonics: (p, 9) how white surfaces there take the light that is no lamp
    :param colors: (p, 3) linear colours of the surface
    :param sky: (directions, n) `sky_visibility` of the points: the directions that are tried first
    """
    if not len(seen):
        return None
    with torch.no_grad():
        search = _Search(surface, seen, harmonics, colors)
        without = search.cost_without()
        if without >= _COVERED:  # a lamp would take the colours of what covers the face for shading
            return None
        towards = sphere(len(sky)).to(points.dtype)
        lamp = search.best((one, arriving) for one, arriving in zip(towards, sky, strict=True) if one[2] > _BEHIND)
        if lamp[0] >= without:
            return None
        for angle in _RINGS:
            direction = lamp[1][:3]
            least = torch.zeros_like(direction)
            least[int(direction.abs().argmin())] = 1
            across = normalize(torch.linalg.cross(least, direction), dim=0)
            up = torch.linalg.cross(direction, across)
            turns = [2 * math.pi * k / 8 for k in range(8)]
            nearby = [
                direction * math.cos(angle) + (across * math.cos(turn) + up * math.sin(turn)) * math.sin(angle)
                for turn in turns
            ]
            other = search.best((one, visibility(points, surface.triangles, one)) for one in nearby)
            lamp = min(lamp, other, key=itemgetter(0))
        return lamp[1]


class _Search:
    """The pixels that lamps are tried on."""

    def __init__(self, surface: SeenSurface, seen: Tensor, harmonics: Tensor, colors: Tensor) -> None:
        main = torch.bincount(surface.materials).argmax()
        chosen = (surface.materials == main).nonzero()[:, 0]
        self._chosen = chosen[:: max(1, len(chosen) // _SAMPLES)]
        self._surface = surface
        self._normals, self._towards_eye = surface.normals[self._chosen], surface.towards_eye[self._chosen]
        self._seen, self._harmonics, self._colors = (one[self._chosen] for one in (seen, harmonics, colors))

    def best(self, lamps: Iterable[tuple[Tensor, Tensor]]) -> tuple[float, Tensor]:
        """The least cost of some lamps, and the one (8,) as `KeyLight` that has it.

        :param lamps: directions (3,), and shares (n,) of their light that reach points
        """
        found = []
        for towards, arriving in lamps:
            numbers = self._seen.new_tensor(DARK)
            numbers[:3], numbers[3:7] = towards, 1.0
            lamp = KeyLight(numbers=numbers, arriving=arriving)
            here = self._surface.at_pixels(arriving)[self._chosen]
            matt, mirrored = (one[:, :1] for one in lamp.shade(self._normals, self._towards_eye, here))
            shape = torch.cat([self._harmonics, matt], dim=1)
            light, glint = _light_of(shape, self._colors, self._seen, mirrored, _OUTLIER)
            if float(light[-1].mean()) <= 0:
                found.append((math.inf, numbers))
                continue
            numbers[3:6] = light[-1].clamp(min=0)
            numbers[6] = (glint.mean() / numbers[3:6].mean()).clamp(*_SHINE)
            shown = shape @ light * self._colors + mirrored * numbers[6] * numbers[3:6]
            found.append((self._cost(shown), numbers))
        return min(found, key=itemgetter(0))

    def cost_without(self) -> float:
        """What harmonics alone leave."""
        light, _ = _light_of(self._harmonics, self._colors, self._seen, outlier=_OUTLIER)
        return self._cost(self._harmonics @ light * self._colors)

    def _cost(self, shown: Tensor) -> float:
        square = ((shown - self._seen) / _OUTLIER) ** 2
        return float((square / (1 + square)).mean())


def lit(loss: JointLoss, state: State) -> Unknowns:
    """The unknowns of a state in the light that its photos show, with the shadows that the face casts on itself."""
    model = loss.model
    lights, keys, tints = [], [], []
    for view, photo in enumerate(loss.photos):
        with torch.no_grad():
            sliders = loss.sliders(torch.as_tensor(state.shares, dtype=torch.float32))
            weights = loss.weights(torch.as_tensor(state.expressions[view], dtype=torch.float32))
            camera = single(photo.camera(loss.fit.spaces[view].camera(torch.as_tensor(state.poses[view]))))
            points, count = model.rig(sliders, weights), len(model.colors.names)
            surface = SeenSurface.from_camera(model, points, camera, photo.face)
            seen = photo.linear.reshape(-1, 3)[surface.raster.pixels]
            local, key = camera.to_camera(points), photo.linear.new_tensor(DARK)
            sky = sky_visibility(local, model.outline.triangles)
            transfer = shadows_of_harmonics(model, points, camera, sky)
            shape = basis(surface.normals) + surface.at_pixels(transfer)
            light, tint = relight(surface, seen, shape, count)
            lamp = _find_key(surface, local, seen, shape, surface.colors * tint[surface.materials], sky)
            key = key if lamp is None else lamp
            arriving = shadows_of_lamp(model, points, camera, key)
            loss.shadows[view] = Shadows(transfer=transfer, arriving=arriving)
            # All once more: without the lamp, harmonics and tints took over what is its.
            if lamp is not None:
                column = (surface.normals @ lamp[:3]).clamp(min=0) * surface.at_pixels(arriving)
                light, tint = relight(surface, seen, torch.cat([shape, column[:, None]], dim=1), count)
                key[3:6] = light[9].clamp(min=0)
            lights.append(light[:9])
            keys.append(key)
            tints.append(tint.log())
    return Unknowns.from_state(state, lights, torch.stack(tints).mean(dim=0), keys)


def renew_shadows(loss: JointLoss, at: Unknowns) -> None:
    """The lamps' shadows of the face as it is by now; what creases lose of harmonics hardly changes."""
    with torch.no_grad():
        for view, shadows in enumerate(loss.shadows):
            assert shadows is not None
            points = loss.model.rig(loss.sliders(at.shares), loss.weights(at.expressions[view]))
            arriving = shadows_of_lamp(loss.model, points, loss.look(at, view).camera, at.key[view])
            loss.shadows[view] = replace(shadows, arriving=arriving)


class _View:
    """What a photo shows of light, in which nothing but light and colours moves."""

    def __init__(self, loss: JointLoss, at: Unknowns, view: int) -> None:
        photo, look = loss.photos[view], loss.look(at, view)
        points = loss.model.rig(loss.sliders(at.shares), loss.weights(at.expressions[view]))
        self.surface = SeenSurface.from_camera(loss.model, points, look.camera, photo.face)
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
            # a lamp takes no light away: descent alone may send it below 0.
            unknowns[1][:, 3:7].clamp_(min=0)
    light, key, tint = (one.detach().clone().requires_grad_() for one in best)
    return replace(at, light=light, key=key, tint=tint)
