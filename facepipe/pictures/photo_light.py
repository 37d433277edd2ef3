"""The light of a photo on a face: what a white matt surface shows at each of its points, and what it mirrors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.parts import KeyLamp, PhotoView
from facepipe.pictures.lighting import Lit, Samples
from facepipe.pictures.occlusion import Sky, depth_map, visible_sky

_SKY_RESOLUTION = 256  # map pixels
_LAMP_RESOLUTION = 448
_SOFT = 3  # map pixels of a lamp's shadow's edge: photos' lamps are no points
_FILM = 0.1  # roughness: on a cornea's film the wide highlight that skin has would be a veil
_RETURNED = 0.9  # of the light that a surface sends to what hides the sky from it
_FACING = 0.04  # share of light that skin mirrors where it falls straight on


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
        return np.asarray(np.maximum((harmonics(normals) + hidden) @ self.view.light, 0.0))

    def lamp(self, normals: FloatArray) -> FloatArray:
        """(m, 3) that of the lamp alone, where nothing hides it."""
        if self.view.key is None:
            return np.zeros((len(normals), 3))
        cosine = np.maximum(normals @ _towards(self.view.key), 0.0)
        return np.asarray(cosine[:, None] * np.array(self.view.key.color))

    def mirrored(self, normals: FloatArray, towards_eye: FloatArray, arriving: FloatArray) -> FloatArray:
        """(m, 3) linear light of the lamp's highlight: normalised Blinn-Phong with Schlick's Fresnel term."""
        key = self.view.key
        if key is None:
            return np.zeros((len(normals), 3))
        towards = _towards(key)
        half = towards_eye + towards
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
        grazing = 1 - np.clip((towards_eye * half).sum(axis=1), 0, 1)
        fresnel = _FACING + (1 - _FACING) * grazing**5
        lobe = (key.exponent + 2) / 8 * np.maximum((normals * half).sum(axis=1), 1e-4) ** key.exponent
        matt = np.maximum(normals @ towards, 0.0) * arriving
        return np.asarray((key.shine * fresnel * lobe * matt)[:, None] * np.array(key.color))


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
        light = self._light
        # The first is what a material's map of occlusion left of it; the fit had the shape's own shadows alone.
        hidden = samples.carried[:, 1:] / np.maximum(samples.carried[:, :1], 1e-3) - 1
        diffuse = light.ambient(samples.normals, hidden) * samples.inside[:, None]
        diffuse /= 1 - returned(hidden) * samples.base
        matt = light.lamp(samples.normals) * samples.inside[:, None]
        rough = (samples.roughness > _FILM).astype(np.float64)
        glint = light.mirrored(samples.normals, samples.towards_eye, rough)
        none = np.zeros_like(diffuse)
        return Lit(diffuse=diffuse, highlights=none, key_diffuse=matt, key_highlights=glint)

    @property
    def _light(self) -> PhotoLight:
        return PhotoLight(view=self.view, hidden=np.zeros((0, 9)), arriving=np.zeros(0))

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
    """(n, 1) share of the light that points send out that comes back from what hides the sky from them.

    In a crease whose walls have albedo a, light is 1 / (1 - a share) times what arrives: the series of bounces.

    :param hidden: (n, 9) as `hidden_harmonics` gives
    """
    return np.asarray(_RETURNED * np.clip(-hidden[:, :1] / np.sqrt(1 / (4 * np.pi)), 0.0, 1.0))


def _towards(key: KeyLamp) -> FloatArray:
    direction = np.array(key.direction)
    return np.asarray(direction / np.linalg.norm(direction))


def harmonics(normals: FloatArray) -> FloatArray:
    """(..., 9) real spherical harmonics of unit vectors (..., 3): 1, y, z, x, xy, yz, 3 z^2 - 1, zx, x^2 - y^2.

    Source: Ramamoorthi and Hanrahan, An efficient representation for irradiance environment maps (2001).
    """
    x, y, z = np.moveaxis(np.asarray(normals), -1, 0)
    zeroth, first, second = np.sqrt(1 / (4 * np.pi)), np.sqrt(3 / (4 * np.pi)), np.sqrt(15 / (4 * np.pi))
    rows = [
        np.full_like(x, zeroth),
        first * y,
        first * z,
        first * x,
        second * x * y,
        second * y * z,
        second / np.sqrt(12) * (3 * z * z - 1),
        second * z * x,
        second / 2 * (x * x - y * y),
    ]
    return np.stack(rows, axis=-1)
