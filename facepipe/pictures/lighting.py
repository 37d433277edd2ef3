"""Light on a surface: studio lights that stay with the camera, skin-like wrap, highlights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray

Color = tuple[float, float, float]


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
    """The lights of a picture; the first one, the key, casts shadows."""

    lights: tuple[Light, ...]
    sky: Color
    ground: Color
    shadows: bool = True
    compress: bool = True  # bend highlights below white; off where colours must be exact


GREY = np.full(3, 1 / 3, np.float32)
SHARPEST = 0.22  # roughness; a lamp is no point, so that its glint has a size
# Red light scatters farthest below skin, so the edge of shade is warm.
SKIN_WRAP = (0.34, 0.20, 0.15)
PORTRAIT = Studio(
    lights=(
        Light(direction=(-0.62, 0.62, 0.78), color=(1.36, 1.28, 1.18), wrap=SKIN_WRAP),
        Light(direction=(0.85, 0.05, 0.55), color=(0.22, 0.245, 0.28), wrap=(0.3, 0.3, 0.3), highlight=0.5),
        Light(direction=(0.75, 0.45, -0.75), color=(0.75, 0.79, 0.86), highlight=0.6),
        Light(direction=(-0.8, 0.35, -0.85), color=(0.3, 0.315, 0.34), highlight=0.6),
    ),
    sky=(0.31, 0.335, 0.38),
    ground=(0.15, 0.125, 0.11),
)
# For reading colours: from the camera, grey, the same left and right.
EVEN = Studio(
    lights=(Light(direction=(0.0, 0.25, 1.0), color=(0.62, 0.62, 0.62), highlight=0.0),),
    sky=(0.42, 0.42, 0.42),
    ground=(0.36, 0.36, 0.36),
    shadows=False,
    compress=False,
)


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Surface samples to be lit, m of them, in camera axes."""

    normals: FloatArray  # (m, 3) unit, towards the viewer's side
    towards_eye: FloatArray  # (m, 3) unit
    up: FloatArray  # (3,) the world's up in camera axes
    base: FloatArray  # (m, 3) linear diffuse colour
    roughness: FloatArray  # (m,)
    opacity: FloatArray  # (m,)
    ambient: FloatArray  # (m,) share of the sky seen
    key_light: FloatArray  # (m,) share of the key light that arrives


def lit(samples: Samples, studio: Studio) -> FloatArray:
    """(m, 3) linear light that leaves the samples, compressed into 0..1 and premultiplied by their opacity.

    As in UsdPreviewSurface a see-through surface keeps its highlights whole: a clear cornea glints.
    """
    # Light lost in a crease comes back from its coloured walls (geometric series of bounces).
    seen = samples.ambient[:, None] / (1 - samples.base * (1 - samples.ambient[:, None]) * 0.9)
    height = (0.5 + 0.5 * (samples.normals @ samples.up))[:, None]
    diffuse = seen * (_row(studio.ground) * (1 - height) + _row(studio.sky) * height)
    highlights = np.zeros_like(diffuse)
    for number, light in enumerate(studio.lights):
        arriving = seen
        if number == 0 and studio.shadows:
            arriving = samples.key_light[:, None] * (0.4 + 0.6 * seen)
        cosine = (samples.normals @ light.unit)[:, None]
        wrap = _row(light.wrap)
        diffuse += np.maximum((cosine + wrap) / (1 + wrap), 0) * arriving * _row(light.color)
        if light.highlight:
            shine = _highlight(samples, light) * np.maximum(cosine[:, 0], 0) * light.highlight
            highlights += (shine * (arriving @ GREY))[:, None] * _row(light.color)
    color = samples.base * diffuse * samples.opacity[:, None] + highlights
    return shoulder(color) if studio.compress else np.minimum(color, 1.0)


def _row(color: Color) -> FloatArray:
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
