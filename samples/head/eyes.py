"""The eyes' pictures: irises of several colours, and the white with its clear front.

usage: python samples/head/eyes.py facepipe/heads/data
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter, map_coordinates

from facepipe.core.arrays import FloatArray
from facepipe.geometry.colors import to_srgb
from facepipe.heads.people import IRIS
from facepipe.heads.skin import to_bytes

# Of the texture's side, from its middle: the asset's texture coordinates are discs around the eye's axis.
_PUPIL, _IRIS = 0.125, 0.415  # on the inner ball
_CLEAR, _WHITE = 0.098, 0.122  # on the outer shell: clear within, white outside
_WHITE_COLOR = np.array([0.60, 0.545, 0.50])


def iris(color: tuple[float, float, float], seed: int, size: int) -> Any:
    """(size, size, 3) sRGB bytes: pupil, fibres, limbal ring."""
    rng = np.random.default_rng(seed)
    radius, angle = _polar(size)
    t = np.clip((radius - _PUPIL) / (_IRIS - _PUPIL), 0, 1.2)
    fibres = rng.standard_normal((64, 720))
    fibres = gaussian_filter(fibres, (7, 1.1), mode=("nearest", "wrap")) * 5
    fibres += gaussian_filter(rng.standard_normal((64, 720)), (3, 5), mode=("nearest", "wrap")) * 6
    wavy = angle + 0.05 * np.sin(9 * angle + 5 * t)
    fibre = map_coordinates(fibres, [t * 52, wavy / (2 * np.pi) * 720 % 720], order=1, mode="grid-wrap")
    ring = np.exp(-(((t - 0.30 - 0.05 * np.sin(7 * angle + fibre)) / 0.14) ** 2))
    base = np.array(color)
    warm = base * (1.45, 1.05, 0.65) + np.array([0.02, 0.008, 0])
    colors = base * (0.85 + 0.38 * fibre.clip(-1.6, 2.2))[..., None]
    colors += ring[..., None] * (warm * (1.1 + 0.3 * fibre)[..., None] - colors) * 0.75
    colors *= (1 - 0.8 * _step(0.72, 1.0, t))[..., None] * (1 - 0.55 * _step(0.10, 0.0, t))[..., None]
    pupil = _step(_PUPIL + 0.006, _PUPIL - 0.006, radius)[..., None]
    return to_bytes(to_srgb(np.clip(colors * (1 - pupil) + 0.0012 * pupil, 0, 1)))


def white(size: int) -> Any:
    """(size, size, 4) sRGB bytes: opaque with veins around the front, which is clear."""
    rng = np.random.default_rng(30)
    radius, angle = _polar(size)
    mottle = gaussian_filter(rng.standard_normal((size, size)), size / 60) * size / 60 * 3.5
    corner = _step(0.17, 0.33, radius) * (0.6 + 0.4 * np.abs(np.cos(angle)))
    colors = _WHITE_COLOR * np.exp(-(corner * 0.42)[..., None] * (0.25, 0.9, 0.9))
    colors *= np.exp(-0.03 * mottle[..., None] * (0.3, 0.8, 1.2))
    colors *= np.exp(-0.12 * _step(0.14, 0.24, radius)[..., None] * (0.15, 0.3, 0.6))
    colors *= np.exp(-_veins(rng, size)[..., None] * (0.10, 0.75, 0.65))
    colors *= (1 - 0.45 * _step(0.15, 0.30, radius) * _step(-0.2, 0.9, np.sin(angle)))[..., None]  # the lid's shade
    colors *= (1 - 0.55 * _step(_WHITE + 0.022, _CLEAR, radius))[..., None] ** (0.9, 1.0, 1.1)
    clear = _step(_WHITE, _CLEAR, radius)
    alpha = 1 - 0.95 * clear
    colors = colors * (1 - clear)[..., None]
    return to_bytes(np.concatenate([to_srgb(np.clip(colors, 0, 1)), alpha[..., None]], axis=-1))


def _veins(rng: np.random.Generator, size: int) -> FloatArray:
    """(size, size) 0..1: thin branching lines that run towards the iris."""
    picture = Image.new("L", (size, size))
    draw = ImageDraw.Draw(picture)
    for _ in range(46):
        angle, start, steps = rng.uniform(0, 2 * np.pi), rng.uniform(0.26, 0.38), int(rng.integers(12, 26))
        turn = np.cumsum(rng.normal(0, 0.035, steps))
        radius = start - np.linspace(0, rng.uniform(0.06, 0.17), steps)
        x, y = 0.5 + radius * np.cos(angle + turn), 0.5 + radius * np.sin(angle + turn)
        draw.line(
            list(zip(x * size, y * size, strict=True)),
            fill=int(rng.integers(60, 190)),
            width=1 + int(rng.random() < 0.3),
        )
    return gaussian_filter(np.asarray(picture, np.float32) / 255, size / 1100)


def _polar(size: int) -> tuple[FloatArray, FloatArray]:
    """Distance from the middle in sides of the texture, and angle counted from the right, up."""
    middle = (np.arange(size) + 0.5) / size - 0.5
    y, x = np.meshgrid(-middle, middle, indexing="ij")
    return np.hypot(x, y), np.arctan2(y, x) % (2 * np.pi)


def _step(low: float, high: float, value: FloatArray) -> FloatArray:
    t = np.clip((value - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def main(folder: Path) -> None:
    """Draw and save."""
    for seed, (name, color) in enumerate(IRIS.items()):
        Image.fromarray(iris(color, seed, 512)).save(folder / f"iris_{name}.jpg", quality=90, subsampling=0)
    Image.fromarray(white(1024)).save(folder / "sclera.png", compress_level=9)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
