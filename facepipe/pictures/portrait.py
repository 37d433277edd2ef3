"""Portrait light: a dome and softboxes that stay with the camera, on skin, hair, teeth and eyes.

Diffuse light creeps around the terminator as it does in skin, redder than it came. What is reflected follows GGX, with
the box's nearest point to the mirror direction as the light (Karis 2013, "Real Shading in Unreal Engine 4").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.pictures.lighting import GREY, Color, Lit, Samples, color_row
from facepipe.pictures.occlusion import Sky

_LEAST_FACING = 0.05  # cosine between a normal and the direction to the viewer
_LEAST_ALPHA = 0.003  # squared roughness; sharper reflections have no numbers
_BOUNCED = (0.45, 0.32, 0.27)  # share of the dome's light that flesh passes on where no sky is seen, as in mouths
_COAT = 0.04  # share of light that a clear coat reflects at normal incidence
_SCATTER = 0.7  # of the light that enters skin, in the channel that scatters farthest
_CREEP = 0.30  # how far light creeps around the terminator in the channel that scatters farthest


@dataclass(frozen=True, kw_only=True)
class Softbox:
    """A distant bright rectangle. The direction is in camera axes: x right, y up, z towards the viewer."""

    direction: tuple[float, float, float]
    color: Color  # linear light on a surface that faces it
    size: tuple[float, float]  # tangents of half its width and height
    glare: float = 1.0  # strength of its reflections

    @cached_property
    def axes(self) -> FloatArray:
        """(3, 3) float32 rows: its right, its up, and the unit direction towards it."""
        towards = np.array(self.direction) / np.linalg.norm(self.direction)
        right = np.cross((0.0, 1.0, 0.0), towards)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(towards, right), towards]).astype(np.float32)

    @property
    def spread(self) -> float:
        """Tangent of half the angle under which a disc of the same area is seen."""
        return float(np.sqrt(self.size[0] * self.size[1] * 4 / np.pi))


@dataclass(frozen=True, kw_only=True)
class Portrait:
    """The light of a portrait; the first box, the key, casts shadows."""

    boxes: tuple[Softbox, ...]  # one at least
    sky: Color
    ground: Color
    exposure: float = 1.0
    soft = True

    @property
    def key(self) -> FloatArray:
        """(3,) unit direction towards the light that casts shadows."""
        return np.asarray(self.boxes[0].axes[2])

    @property
    def spread(self) -> float:
        """Tangent of half the angle under which the key is seen."""
        return self.boxes[0].spread

    def carried(self, sky: Sky, normals: FloatArray, axes: FloatArray) -> FloatArray:
        """(n, boxes) share of the dome's light that arrives at points, then of each box's but the key's."""
        weights = [_mixed(GREY @ color_row(self.ground), GREY @ color_row(self.sky), sky.directions[:, 1])]
        for box in self.boxes[1:]:
            weights.append(np.maximum(sky.directions @ (box.axes[2] @ axes), 0.0) ** 4 + 1e-4)
        return sky.shares(normals, np.stack(weights, axis=1))

    def light(self, samples: Samples) -> Lit:
        """The light of the dome and of all boxes."""
        shares = samples.carried * samples.inside[:, None]
        hidden = 1 - shares[:, :1]
        open_sky = 1 - hidden + color_row(_BOUNCED) * samples.inside[:, None] * hidden**2
        boxes = [
            color_row(box.color) * (shares[:, number] if number else samples.inside)[:, None]
            for number, box in enumerate(self.boxes)
        ]
        view = _View(samples)
        diffuse, key_diffuse = (one * (1 - view.sheen) for one in self._diffuse(samples, open_sky, boxes))
        highlights, key_highlights = self._reflected(view, samples.up, open_sky, boxes)
        if samples.coat.any():
            coat = _View(replace(samples, mirror=np.full_like(samples.mirror, _COAT), roughness=samples.coat_roughness))
            amount = samples.coat[:, None]
            for light in (diffuse, key_diffuse, highlights, key_highlights):
                light *= 1 - amount * coat.sheen
            dome, key = self._reflected(coat, samples.up, open_sky, boxes)
            highlights, key_highlights = highlights + amount * dome, key_highlights + amount * key
        return Lit(diffuse=diffuse, highlights=highlights, key_diffuse=key_diffuse, key_highlights=key_highlights)

    def _diffuse(
        self, samples: Samples, open_sky: FloatArray, boxes: Sequence[FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """(m, 3) diffuse light of all but the key, and of the key."""
        # Light lost in a crease comes back from its coloured walls (geometric series of bounces).
        seen = open_sky / (1 - samples.base * (1 - open_sky) * 0.9)
        # The mean of a linear dome over the cosine lobe.
        total = seen * self._dome(samples.normals @ samples.up * 2 / 3)
        creep = _creep(samples.base)
        each = []
        for box, light in zip(self.boxes, boxes, strict=True):
            wrap = creep + 0.4 * box.spread
            cosine = (samples.normals @ box.axes[2])[:, None]
            each.append(light * np.maximum(cosine + wrap, 0) / (1 + wrap) ** 2)
        return sum(each[1:], start=total), each[0]

    def _reflected(
        self, view: _View, up: FloatArray, open_sky: FloatArray, boxes: Sequence[FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """(m, 3) what is reflected to the viewer of all but the key, and of the key."""
        dome = open_sky * self._dome(view.mirrored @ up) * view.sheen
        each = [view.reflection(box, light) for box, light in zip(self.boxes, boxes, strict=True)]
        return sum(each[1:], start=dome), each[0]

    def tone(self, color: FloatArray) -> FloatArray:
        """Linear light as linear colours 0..1 of a screen: a film's toe and shoulder."""
        return filmic(color * np.float32(self.exposure))

    def _dome(self, height: FloatArray) -> FloatArray:
        """(m, 3) light of the dome towards unit vectors of this height (m,)."""
        return _mixed(color_row(self.ground), color_row(self.sky), height[:, None])


class _View:
    """Samples as their viewer sees them."""

    def __init__(self, samples: Samples) -> None:
        self.towards_eye, self.mirror = samples.towards_eye, samples.mirror
        # At outlines smooth normals turn away from the viewer, who sees no such surface.
        away = np.maximum(_LEAST_FACING - _dot(samples.normals, samples.towards_eye), 0)
        self.normals = _unit(samples.normals + away[:, None] * samples.towards_eye)
        self.alpha = np.maximum(samples.roughness**2, _LEAST_ALPHA)
        self.facing = np.maximum(_dot(self.normals, self.towards_eye), _LEAST_FACING)
        self.mirrored = 2 * self.facing[:, None] * self.normals - self.towards_eye
        self.sheen = _sheen(self.mirror, samples.roughness, self.facing)

    def reflection(self, box: Softbox, light: FloatArray) -> FloatArray:
        """(m, 3) what of a box's light (m, 3) is reflected to the viewer."""
        reflected = np.zeros_like(light)
        at = np.flatnonzero((light @ GREY > 0) & (self.normals @ box.axes[2] > -box.spread))
        if len(at):
            reflected[at] = light[at] * self._lobe(box, at)
        return reflected

    def _lobe(self, box: Softbox, at: IntArray) -> FloatArray:
        """(k, 3) share of a box's light that samples `at` (k,) reflect to the viewer."""
        normals, alpha, facing, towards_eye = (
            each[at] for each in (self.normals, self.alpha, self.facing, self.towards_eye)
        )
        across, along, ahead = box.axes @ self.mirrored[at].T
        ahead = np.maximum(ahead, 0.02)
        width, height = box.size
        place = np.stack([np.clip(across / ahead, -width, width), np.clip(along / ahead, -height, height)], axis=1)
        light = _unit(place @ box.axes[:2] + box.axes[2])
        half = _unit(light + towards_eye)
        cosine = np.maximum(_dot(normals, light), 0)
        lobe = alpha / (_dot(normals, half) ** 2 * (alpha**2 - 1) + 1)
        widened = np.minimum(alpha + 0.35 * box.spread, 1.0)  # keeps the energy of what is no point
        masking = alpha / 2
        unmasked = (cosine * (1 - masking) + masking) * (facing * (1 - masking) + masking)
        strength = box.glare * cosine * (lobe * alpha / widened) ** 2 / (4 * unmasked)
        mirror = self.mirror[at]
        return np.asarray((mirror + (1 - mirror) * ((1 - _dot(light, half)) ** 5)[:, None]) * strength[:, None])


def _sheen(mirror: FloatArray, roughness: FloatArray, facing: FloatArray) -> FloatArray:
    """(m, 3) share of even light that a rough surface reflects: Karis' fit of the split-sum integral."""
    r0, r1, r2, r3 = (a * roughness + b for a, b in ((-1, 1), (-0.0275, 0.0425), (-0.572, 1.04), (0.022, -0.04)))
    bend = np.minimum(r0 * r0, np.exp2(-9.28 * facing)) * r0 + r1
    scale, offset = r2 - 1.04 * bend, r3 + 1.04 * bend
    return np.asarray(mirror * scale[:, None] + np.maximum(offset, 0)[:, None])


def _creep(base: FloatArray) -> FloatArray:
    """(m, 3) how far light creeps around the terminator: farthest in the colour that a surface absorbs least."""
    return _CREEP / _SCATTER * scatter_share(base)


def scatter_share(base: FloatArray) -> FloatArray:
    """(m, 3) share of diffuse light that leaves a surface away from where it entered, by its colour (m, 3).

    Red light goes farthest in skin because skin absorbs it least; white things scatter all colours alike.
    """
    return np.asarray(_SCATTER * (base / np.maximum(base.max(axis=1, keepdims=True), 1e-4)) ** 1.25)


def filmic(color: FloatArray) -> FloatArray:
    """A film-like curve from light, 0 to infinity, to 0..1 (a fit of ACES by Narkowicz 2015)."""
    return np.asarray(np.clip(color * (2.51 * color + 0.03) / (color * (2.43 * color + 0.59) + 0.14), 0, 1))


def _mixed(low: FloatArray, high: FloatArray, height: FloatArray) -> FloatArray:
    return np.asarray(low + (high - low) * (0.5 + 0.5 * height))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("mc,mc->m", a, b))


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.sqrt(_dot(vectors, vectors))[:, None])


PORTRAIT = Portrait(
    boxes=(
        Softbox(direction=(-0.58, 0.62, 0.82), color=(0.98, 0.905, 0.82), size=(0.15, 0.22)),
        Softbox(direction=(0.95, 0.10, 0.60), color=(0.10, 0.112, 0.128), size=(0.5, 0.8)),
        Softbox(direction=(0.75, 0.35, -0.75), color=(0.34, 0.365, 0.40), size=(0.2, 0.8), glare=0.5),
        Softbox(direction=(-0.85, 0.35, -0.80), color=(0.16, 0.17, 0.185), size=(0.2, 0.8), glare=0.5),
        Softbox(direction=(0.0, 0.05, -1.0), color=(0.30, 0.31, 0.33), size=(0.9, 0.9), glare=0.8),
    ),
    sky=(0.19, 0.20, 0.22),
    ground=(0.095, 0.082, 0.074),
)
