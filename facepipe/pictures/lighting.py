"""Lamps that stay with the camera: plain light on a surface, for colours that must be read and for known scenes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.pictures.occlusion import Sky

Color = tuple[float, float, float]


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

    def dimmed(self, share: FloatArray) -> Lit:
        """With a share (m,) of all light but the key's."""
        return replace(self, diffuse=self.diffuse * share[:, None], highlights=self.highlights * share[:, None])


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
                shine = _highlight(samples, light) * np.maximum(cosine[:, 0], 0) * light.highlight
                glossy = lit.key_highlights if of_key else lit.highlights
                glossy += (shine * (arriving @ GREY))[:, None] * color_row(light.color)
        return lit

    def tone(self, color: FloatArray) -> FloatArray:
        """Linear light as linear colours 0..1 of a screen."""
        return shoulder(color) if self.compress else np.minimum(color, 1.0)


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


def shoulder(color: FloatArray) -> FloatArray:
    """Colours above white bent below it, dark ones kept: ``x / (1 + x^4)^(1/4)``."""
    square = color * color
    return np.asarray(color / np.sqrt(np.sqrt(1 + square * square)))


def _highlight(samples: Samples, light: Light) -> FloatArray:
    """Normalised Blinn-Phong with Schlick's Fresnel term at 4 % (ior 1.5)."""
    half = samples.towards_eye + light.unit
    half /= np.sqrt(np.einsum("mc,mc->m", half, half))[:, None]
    alpha = np.maximum(samples.roughness, SHARPEST) ** 2
    exponent = 2 / alpha**2 - 2
    cosine = np.clip(np.einsum("mc,mc->m", samples.normals, half), 0, 1)
    grazing = 1 - np.clip(np.einsum("mc,mc->m", samples.towards_eye, half), 0, 1)
    fresnel = 0.04 + 0.96 * grazing**5
    return np.asarray(fresnel * (exponent + 2) / 8 * np.exp(exponent * np.log(np.maximum(cosine, 1e-6))))
