"""Light on a face: lamps that stay with the camera, portrait light of a dome and softboxes, light of a photo."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.vectors import dot_columns, unit_vectors
from facepipe.parts import KeyLamp, PhotoView
from facepipe.pictures.occlusion import Sky, depth_map, visible_sky

Color = tuple[float, float, float]
_LEAST_FACING = 0.05  # cosine between a normal and the direction to the viewer
_LEAST_ALPHA = 0.003  # squared roughness; sharper reflections have no numbers
_BOUNCED = (0.45, 0.32, 0.27)  # share of the dome's light that flesh passes on where no sky is seen, as in mouths
_COAT = 0.04  # share of light that a clear coat reflects at normal incidence
_SCATTER = 0.7  # of the light that enters skin, in the channel that scatters farthest
_CREEP = 0.30  # how far light creeps around the terminator in the channel that scatters farthest
_SKY_RESOLUTION = 256  # map pixels
_LAMP_RESOLUTION = 448
_SOFT = 3  # map pixels of a lamp's shadow's edge: photos' lamps are no points
_FILM = 0.1  # roughness: on a cornea's film the wide highlight that skin has would be a veil
_RETURNED = 0.9  # of the light that a surface sends to what hides the sky from it
_FACING = 0.04  # share of light that skin mirrors where it falls straight on


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Surface samples to be lit, m of them, in camera axes."""

    normals: FloatArray  # (m, 3) unit, towards the viewer's side
    towards_eye: FloatArray  # (m, 3) unit
    up: FloatArray  # (3,) the world's up in camera axes
    base: FloatArray  # (m, 3) linear diffuse colour
    roughness: FloatArray  # (m,)
    carried: FloatArray  # (m, c) what the studio computed at the points, for the side that is seen
    mirror: FloatArray  # (m, 3) share of light reflected straight back at normal incidence
    coat: FloatArray  # (m,) how much of a clear layer lies over the surface
    coat_roughness: FloatArray  # (m,)
    inside: FloatArray  # (m,) factor of all light; below 1 on the inner side of a single-sided mesh


@dataclass(frozen=True, kw_only=True)
class Lit:
    """Light that leaves samples, apart for the key, which may be hidden from them."""

    diffuse: FloatArray  # (m, 3) to be multiplied by the surface's colour
    highlights: FloatArray  # (m, 3)
    key_diffuse: FloatArray  # (m, 3) of the key where nothing hides it
    key_highlights: FloatArray  # (m, 3)


@dataclass(frozen=True, kw_only=True)
class Light:
    """A distant light. The direction is in camera axes: x right, y up, z towards the viewer."""

    direction: tuple[float, float, float]
    color: Color  # linear
    wrap: Color = (0.0, 0.0, 0.0)  # how far light creeps around the edge of shade, per channel
    highlight: float = 1.0  # strength of its specular reflection

    @property
    def unit(self) -> FloatArray:
        """(3,) float32 unit direction towards the light."""
        towards = np.array(self.direction)
        return np.asarray(towards / np.linalg.norm(towards), dtype=np.float32)


@dataclass(frozen=True, kw_only=True)
class Studio:
    """The lamps of a picture; the first one, the key, casts shadows."""

    lights: tuple[Light, ...]
    sky: Color
    ground: Color
    shadows: bool = True
    compress: bool = True  # bend highlights below white; off where colours must be exact
    soft = False  # shadows and skin
    spread = 0.0  # lamps are points

    @property
    def key(self) -> FloatArray | None:
        """(3,) unit direction towards the light that casts shadows."""
        return self.lights[0].unit if self.shadows and self.lights else None

    def carried(self, sky: Sky, normals: FloatArray, axes: FloatArray) -> FloatArray:
        """(n, 1) share of the sky that points with normals (n, 3) see."""
        return sky.share(normals)[:, None]

    def light(self, samples: Samples) -> Lit:
        """The light of all lamps; the first is the key where it casts shadows."""
        # Light lost in a crease comes back from its coloured walls (geometric series of bounces).
        ambient = samples.carried * samples.inside[:, None]
        seen = ambient / (1 - samples.base * (1 - ambient) * 0.9)
        height = (0.5 + 0.5 * (samples.normals @ samples.up))[:, None]
        diffuse = seen * (color_row(self.ground) * (1 - height) + color_row(self.sky) * height)
        lit = Lit(diffuse=diffuse, **{name: np.zeros_like(diffuse) for name in ("highlights", *_KEY)})
        for number, light in enumerate(self.lights):
            of_key = number == 0 and self.shadows
            arriving = samples.inside[:, None] * (0.4 + 0.6 * seen) if of_key else seen
            cosine = (samples.normals @ light.unit)[:, None]
            wrap = color_row(light.wrap)
            matt = lit.key_diffuse if of_key else lit.diffuse
            matt += np.maximum((cosine + wrap) / (1 + wrap), 0) * arriving * color_row(light.color)
            if light.highlight:
                # normalised Blinn-Phong with Schlick's Fresnel term at 4 % (ior 1.5)
                half = samples.towards_eye + light.unit
                half /= np.sqrt(np.einsum("mc,mc->m", half, half))[:, None]
                alpha = np.maximum(samples.roughness, SHARPEST) ** 2
                exponent = 2 / alpha**2 - 2
                facing = np.clip(np.einsum("mc,mc->m", samples.normals, half), 0, 1)
                grazing = 1 - np.clip(np.einsum("mc,mc->m", samples.towards_eye, half), 0, 1)
                fresnel = 0.04 + 0.96 * grazing**5
                shine = (
                    np.asarray(fresnel * (exponent + 2) / 8 * np.exp(exponent * np.log(np.maximum(facing, 1e-6))))
                    * np.maximum(cosine[:, 0], 0)
                    * light.highlight
                )
                glossy = lit.key_highlights if of_key else lit.highlights
                glossy += (shine * (arriving @ GREY))[:, None] * color_row(light.color)
        return lit

    def tone(self, color: FloatArray) -> FloatArray:
        """Linear light as linear colours 0..1 of a screen."""
        if not self.compress:
            return np.minimum(color, 1.0)
        square = color * color  # above white bent below it, dark ones kept: ``x / (1 + x^4)^(1/4)``
        return np.asarray(color / np.sqrt(np.sqrt(1 + square * square)))


_KEY = ("key_diffuse", "key_highlights")
GREY = np.full(3, 1 / 3, np.float32)
SHARPEST = 0.22  # roughness; a lamp is no point, so that its glint has a size
# For reading colours: from the camera, grey, the same left and right.
EVEN = Studio(
    lights=(Light(direction=(0.0, 0.25, 1.0), color=(0.62, 0.62, 0.62), highlight=0.0),),
    sky=(0.42, 0.42, 0.42),
    ground=(0.36, 0.36, 0.36),
    shadows=False,
    compress=False,
)


def color_row(color: Color) -> FloatArray:
    """(3,) the colour as an array of float32."""
    return np.array(color, dtype=np.float32)


def _column(color: Color) -> FloatArray:
    """(3, 1) the same, for light by columns."""
    return color_row(color)[:, None]


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
        """The light of the dome and of all boxes, computed by columns (3, m): rows of three take five times as long."""
        base, inside = np.ascontiguousarray(samples.base.T), samples.inside
        shares = samples.carried.T * inside
        hidden = 1 - shares[0]
        open_sky = 1 - hidden + _column(_BOUNCED) * (inside * hidden**2)
        boxes = [_column(box.color) * (shares[number] if number else inside) for number, box in enumerate(self.boxes)]
        view = _View(samples, np.ascontiguousarray(samples.mirror.T), samples.roughness)
        # Light lost in a crease comes back from its coloured walls (geometric series of bounces).
        seen = open_sky / (1 - base * (1 - open_sky) * 0.9)
        # The mean of a linear dome over the cosine lobe.
        total = seen * self._dome(samples.normals @ samples.up * 2 / 3)
        creep = _CREEP / _SCATTER * scatter_share(samples.base).T
        each = []
        for box, arriving in zip(self.boxes, boxes, strict=True):
            wrap = creep + 0.4 * box.spread
            cosine = samples.normals @ box.axes[2]
            each.append(arriving * np.maximum(cosine + wrap, 0) / (1 + wrap) ** 2)
        diffuse, key_diffuse = (one * (1 - view.sheen) for one in (sum(each[1:], start=total), each[0]))
        highlights, key_highlights = self._reflected(view, samples.up, open_sky, boxes)
        if samples.coat.any():
            coat = _View(samples, np.full_like(view.mirror, _COAT), samples.coat_roughness)
            amount = samples.coat
            for light in (diffuse, key_diffuse, highlights, key_highlights):
                light *= 1 - amount * coat.sheen
            dome, key = self._reflected(coat, samples.up, open_sky, boxes)
            highlights, key_highlights = highlights + amount * dome, key_highlights + amount * key
        return Lit(
            diffuse=diffuse.T, highlights=highlights.T, key_diffuse=key_diffuse.T, key_highlights=key_highlights.T
        )

    def _reflected(
        self, view: _View, up: FloatArray, open_sky: FloatArray, boxes: Sequence[FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """(3, m) what is reflected to the viewer of all but the key, and of the key."""
        dome = open_sky * self._dome(up @ view.mirrored) * view.sheen
        each = [view.reflection(box, light) for box, light in zip(self.boxes, boxes, strict=True)]
        return sum(each[1:], start=dome), each[0]

    def tone(self, color: FloatArray) -> FloatArray:
        """Linear light as linear colours 0..1 of a screen: a film's toe and shoulder."""
        return filmic(color * np.float32(self.exposure))

    def _dome(self, height: FloatArray) -> FloatArray:
        """(3, m) light of the dome towards unit vectors of this height (m,)."""
        return _mixed(_column(self.ground), _column(self.sky), height)


class _View:
    """Samples as their viewer sees them."""

    def __init__(self, samples: Samples, mirror: FloatArray, roughness: FloatArray) -> None:
        """:param mirror: (3, m) share of light reflected straight back at normal incidence; roughness (m,)"""
        self.towards_eye, self.mirror = np.ascontiguousarray(samples.towards_eye.T), mirror
        normals = np.ascontiguousarray(samples.normals.T)
        # At outlines smooth normals turn away from the viewer, who sees no such surface.
        away = np.maximum(_LEAST_FACING - dot_columns(normals, self.towards_eye), 0)
        self.normals = _unit(normals + away * self.towards_eye)
        self.alpha = np.maximum(roughness**2, _LEAST_ALPHA)
        self.facing = np.maximum(dot_columns(self.normals, self.towards_eye), _LEAST_FACING)
        self.mirrored = 2 * self.facing * self.normals - self.towards_eye
        # (3, m) share of even light that a rough surface reflects: Karis' fit of the split-sum integral
        r0, r1, r2, r3 = (a * roughness + b for a, b in ((-1, 1), (-0.0275, 0.0425), (-0.572, 1.04), (0.022, -0.04)))
        bend = np.minimum(r0 * r0, np.exp2(-9.28 * self.facing)) * r0 + r1
        scale, offset = r2 - 1.04 * bend, r3 + 1.04 * bend
        self.sheen = np.asarray(self.mirror * scale + np.maximum(offset, 0))

    def reflection(self, box: Softbox, light: FloatArray) -> FloatArray:
        """(3, m) what of a box's light (3, m) is reflected to the viewer."""
        reflected = np.zeros_like(light)
        at = np.flatnonzero((GREY @ light > 0) & (box.axes[2] @ self.normals > -box.spread))
        if len(at):
            # (3, k) share of a box's light that samples `at` (k,) reflect to the viewer
            normals, alpha, facing, towards_eye, mirrored, mirror = (
                each.take(at, axis=-1)
                for each in (self.normals, self.alpha, self.facing, self.towards_eye, self.mirrored, self.mirror)
            )
            across, along, ahead = box.axes @ mirrored
            ahead = np.maximum(ahead, 0.02)
            width, height = box.size
            x, y = np.clip(across / ahead, -width, width), np.clip(along / ahead, -height, height)
            right, up, forward = box.axes[:, :, None]
            towards = _unit(x * right + y * up + forward)
            half = _unit(towards + towards_eye)
            cosine = np.maximum(dot_columns(normals, towards), 0)
            lobe = alpha / (dot_columns(normals, half) ** 2 * (alpha**2 - 1) + 1)
            widened = np.minimum(alpha + 0.35 * box.spread, 1.0)  # keeps the energy of what is no point
            masking = alpha / 2
            unmasked = (cosine * (1 - masking) + masking) * (facing * (1 - masking) + masking)
            strength = box.glare * cosine * (lobe * alpha / widened) ** 2 / (4 * unmasked)
            grazing = 1 - dot_columns(towards, half)
            share = mirror + (1 - mirror) * (grazing * grazing * grazing * grazing * grazing)
            reflected[:, at] = light.take(at, axis=1) * share * strength
        return reflected


def scatter_share(base: FloatArray) -> FloatArray:
    """(m, 3) share of diffuse light that leaves a surface away from where it entered, by its colour (m, 3).

    Red light goes farthest in skin because skin absorbs it least; white things scatter all colours alike.
    """
    red, green, blue = base.T
    most = np.maximum(np.maximum(np.maximum(red, green), blue), 1e-4)  # numpy's own maxima are slow over three
    return np.asarray(_SCATTER * (base / most[:, None]) ** 1.25)


def filmic(color: FloatArray) -> FloatArray:
    """A film-like curve from light, 0 to infinity, to 0..1 (a fit of ACES by Narkowicz 2015)."""
    return np.asarray(np.clip(color * (2.51 * color + 0.03) / (color * (2.43 * color + 0.59) + 0.14), 0, 1))


def _mixed(low: FloatArray, high: FloatArray, height: FloatArray) -> FloatArray:
    return np.asarray(low + (high - low) * (0.5 + 0.5 * height))


def _unit(vectors: FloatArray) -> FloatArray:
    """(3, m) of length 1."""
    return np.asarray(vectors / np.sqrt(dot_columns(vectors, vectors)))


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


@dataclass(frozen=True, kw_only=True)
class PhotoLight:
    """The light of a photo at points of a face; vectors are in camera coordinates."""

    view: PhotoView
    hidden: FloatArray  # (n, 9) what self-shadowing adds to the harmonics of the points' normals
    arriving: FloatArray  # (n,) share of the lamp's light that reaches each point

    @classmethod
    def on_points(cls, view: PhotoView, points: FloatArray, normals: FloatArray, opaque: IntArray) -> PhotoLight:
        """Of points (n, 3) with unit normals (n, 3), past triangles (o, 3)."""
        sky = visible_sky(points, normals, opaque, np.zeros(len(points), bool), _SKY_RESOLUTION)
        hidden = hidden_harmonics(sky, normals, np.eye(3))
        arriving: FloatArray = np.ones(len(points))
        if view.key is not None:
            lamp = depth_map(points, opaque, np.array(view.key.direction), _LAMP_RESOLUTION)
            arriving = lamp.lit(points, normals, _SOFT)
        return cls(view=view, hidden=hidden, arriving=arriving)

    def white(self, normals: FloatArray, hidden: FloatArray, arriving: FloatArray) -> FloatArray:
        """(m, 3) linear light of white matt surfaces with unit normals (m, 3)."""
        return self.ambient(normals, hidden) + arriving[:, None] * self.lamp(normals)

    def ambient(self, normals: FloatArray, hidden: FloatArray) -> FloatArray:
        """(m, 3) that of the harmonics alone."""
        return np.asarray(np.maximum((harmonics(normals) + hidden) @ self.view.light.astype(normals.dtype), 0.0))

    def lamp(self, normals: FloatArray) -> FloatArray:
        """(m, 3) that of the lamp alone, where nothing hides it."""
        if self.view.key is None:
            return np.zeros((len(normals), 3), normals.dtype)
        cosine = np.maximum(normals @ _towards(self.view.key).astype(normals.dtype), 0.0)
        return np.asarray(cosine[:, None] * np.array(self.view.key.color, normals.dtype))

    def mirrored(self, normals: FloatArray, towards_eye: FloatArray, arriving: FloatArray) -> FloatArray:
        """(m, 3) linear light of the lamp's highlight: normalised Blinn-Phong with Schlick's Fresnel term."""
        key = self.view.key
        if key is None:
            return np.zeros((len(normals), 3), normals.dtype)
        towards = _towards(key).astype(normals.dtype)
        half = unit_vectors(towards_eye + towards)
        grazing = 1 - np.clip(dot_columns(towards_eye.T, half.T), 0, 1)
        fresnel = _FACING + (1 - _FACING) * grazing**5
        lobe = (key.exponent + 2) / 8 * np.maximum(dot_columns(normals.T, half.T), 1e-4) ** key.exponent
        matt = np.maximum(normals @ towards, 0.0) * arriving
        return np.asarray((key.shine * fresnel * lobe * matt)[:, None] * np.array(key.color, normals.dtype))


@dataclass(frozen=True, kw_only=True)
class PhotoLights:
    """The light that a photo shows, for a picture: harmonics with what the face keeps from them, and a lamp."""

    view: PhotoView
    soft = False  # the fit knows neither light below the skin nor lamps of some size
    spread = 0.0

    @property
    def key(self) -> FloatArray | None:
        """(3,) unit direction towards the lamp."""
        return None if self.view.key is None else _towards(self.view.key).astype(np.float32)

    def carried(self, sky: Sky, normals: FloatArray, axes: FloatArray) -> FloatArray:
        """(n, 10) one, and one more than what self-shadowing adds to the harmonics of normals (n, 3)."""
        return np.column_stack([np.ones(len(normals)), 1 + hidden_harmonics(sky, normals, axes)])

    def light(self, samples: Samples) -> Lit:
        """Matt light of harmonics, and of the lamp with its highlight."""
        light = PhotoLight(view=self.view, hidden=np.zeros((0, 9)), arriving=np.zeros(0))
        # The first is what a material's map of occlusion left of it; the fit had the shape's own shadows alone.
        hidden = samples.carried[:, 1:] / np.maximum(samples.carried[:, :1], 1e-3) - 1
        diffuse = light.ambient(samples.normals, hidden) * samples.inside[:, None]
        diffuse /= 1 - returned(hidden) * samples.base
        matt = light.lamp(samples.normals) * samples.inside[:, None]
        rough = (samples.roughness > _FILM).astype(np.float64)
        glint = light.mirrored(samples.normals, samples.towards_eye, rough)
        none = np.zeros_like(diffuse)
        return Lit(diffuse=diffuse, highlights=none, key_diffuse=matt, key_highlights=glint)

    def tone(self, color: FloatArray) -> FloatArray:
        """Linear light as linear colours 0..1 of a screen."""
        return np.minimum(color, 1.0)


def hidden_harmonics(sky: Sky, normals: FloatArray, axes: FloatArray) -> FloatArray:
    """(n, 9) what self-shadowing adds to the harmonics of unit normals (n, 3), as `facepipe.photo.descent.shadows`.

    :param axes: (3, 3) rows: the harmonics' axes in the frame of sky and normals
    """
    cosine = np.maximum(normals @ sky.directions.T, 0.0) * (1 - sky.seen)
    return np.asarray(-(4 / len(sky.directions)) * cosine @ harmonics(sky.directions @ axes.T))


def returned(hidden: FloatArray) -> FloatArray:
    """(n, 1) share of light sent out by points that comes back from what hides the sky, `hidden_harmonics` (n, 9).

    In a crease whose walls have albedo a, light is 1 / (1 - a share) times what arrives: the series of bounces.
    """
    return np.asarray(_RETURNED * np.clip(-hidden[:, :1] / math.sqrt(1 / (4 * math.pi)), 0.0, 1.0))


def _towards(key: KeyLamp) -> FloatArray:
    direction = np.array(key.direction)
    return np.asarray(direction / np.linalg.norm(direction))


def harmonics(normals: FloatArray) -> FloatArray:
    """(..., 9) real spherical harmonics of unit vectors (..., 3): 1, y, z, x, xy, yz, 3 z^2 - 1, zx, x^2 - y^2.

    Source: Ramamoorthi and Hanrahan, An efficient representation for irradiance environment maps (2001).
    """
    x, y, z = np.moveaxis(np.asarray(normals), -1, 0)
    zeroth, first, second = (math.sqrt(square / (4 * math.pi)) for square in (1, 3, 15))
    rows = [
        np.full_like(x, zeroth),
        first * y,
        first * z,
        first * x,
        second * x * y,
        second * y * z,
        second / math.sqrt(12) * (3 * z * z - 1),
        second * z * x,
        second / 2 * (x * x - y * y),
    ]
    return np.stack(rows, axis=-1)
