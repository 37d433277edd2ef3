"""Pictures of hairs with alpha for the cards of brows and lashes: grey, coloured where they are used.

usage: python samples/head/strokes.py facepipe/heads/data
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from brows_lashes import LASH_BANDS
from PIL import Image
from scipy.interpolate import PchipInterpolator

Array = Any
FINE = 2  # samples a texel and direction


@dataclass
class Canvas:
    """Strokes drawn one over the other, (height, width) in texels."""

    height: int
    width: int
    value: Array = field(init=False)
    alpha: Array = field(init=False)

    def __post_init__(self) -> None:
        shape = (self.height * FINE, self.width * FINE)
        self.value, self.alpha = np.full(shape, 0.5, np.float32), np.zeros(shape, np.float32)

    def stroke(self, x: Array, y: Array, width: Array, value: Array, strength: float = 1.0) -> None:
        """A hair through places (m,) in texels; `width` in texels and `value` (grey) along it."""
        count = int(4 * FINE * (np.abs(np.diff(x)).sum() + np.abs(np.diff(y)).sum())) + 2
        t, fine = np.linspace(0, 1, len(x)), np.linspace(0, 1, count)
        x, y, width, value = (
            np.interp(fine, t, broadcast_array) for broadcast_array in np.broadcast_arrays(x, y, width, value)
        )
        reach = int(np.ceil(width.max() * FINE / 2 + 1))
        for dy in range(-reach, reach + 1):
            for dx in range(-reach, reach + 1):
                column, row = np.floor(x * FINE).astype(int) + dx, np.floor(y * FINE).astype(int) + dy
                away = np.hypot(column + 0.5 - x * FINE, row + 0.5 - y * FINE)
                cover = strength * np.clip(width * FINE / 2 - away + 0.5, 0, 1)
                seen = (cover > 0) & (row >= 0) & (row < self.alpha.shape[0])
                seen &= (column >= 0) & (column < self.alpha.shape[1])
                at = row[seen], column[seen]
                self.value[at] += (cover[seen] > 0.5) * (value[seen] - self.value[at])
                self.alpha[at] = np.maximum(self.alpha[at], cover[seen])

    def save(self, path: Path) -> None:
        """As PNG, its sides powers of two, 16 steps of grey, which goes on beyond the hairs' edges, and of alpha."""
        from scipy.ndimage import distance_transform_edt

        nearest = distance_transform_edt(self.alpha < 0.5, return_distances=False, return_indices=True)
        value = self.value[tuple(nearest)]
        shape = (self.height, FINE, self.width, FINE)
        grey, alpha = (one.reshape(shape).mean(axis=(1, 3)) for one in (value, self.alpha))
        pixels = np.stack([grey, alpha], axis=-1)
        image = Image.fromarray((np.clip(pixels, 0, 1) * 255 + 0.5).astype(np.uint8), "LA")
        image = image.resize((1 << (self.width - 1).bit_length(), 1 << (self.height - 1).bit_length()))
        steps = np.rint(np.asarray(image) / 17).astype(np.uint8)
        Image.fromarray(17 * steps, "LA").save(path, compress_level=9)


@dataclass(frozen=True)
class Brow:
    """How a brow is shaped: along it, from the nose outwards, at 0, 0.3, 0.62, 0.85 and 1."""

    fullness: float  # 0..1
    rise: tuple[float, ...] = (0, 0, 0, 0, 0)  # texels above its usual line
    height: tuple[float, ...] = (1, 1, 1, 1, 1)  # times its usual height


BROWS = {
    "brows0": Brow(0.15),
    "brows1": Brow(0.5),
    "brows2": Brow(0.9),
    "brows_arched": Brow(0.35, (-16, 0, 26, 14, -14), (0.75, 0.7, 0.55, 0.5, 0.6)),
    "brows_straight": Brow(0.95, (14, -6, -16, 0, 14), (1.1, 1.1, 1.15, 1.2, 1.2)),
}


def brows(brow: Brow) -> Canvas:
    """A left brow: u from the nose outwards, v up; it fills the middle two thirds of the height."""
    rng, canvas, fullness = np.random.default_rng(11), Canvas(224, 896), brow.fullness
    places = (0, 0.3, 0.62, 0.85, 1)
    rise, height = PchipInterpolator(places, brow.rise), PchipInterpolator(places, brow.height)
    count = int(240 + 420 * fullness)
    for t, s in zip(rng.beta(1.15, 1.35, count), rng.uniform(-1, 1, count), strict=True):
        half = 62 * np.interp(t, [0, 0.1, 0.45, 0.8, 1.0], [0.75, 1.0, 0.95, 0.62, 0.25]) * (0.72 + 0.28 * fullness)
        half *= float(height(t))
        x, y = 40 + 790 * t, 118 - float(rise(t)) - s * half * (0.85 if t > 0.1 else 1.0)
        angle = np.interp(t, [0, 0.12, 0.35, 0.7, 1], [1.45, 1.0, 0.52, 0.2, -0.12]) - 0.42 * max(s, -0.4) * min(
            4 * t, 1
        )
        angle += rng.normal(0, 0.10)
        length = rng.uniform(0.75, 1.15) * np.interp(t, [0, 0.2, 0.8, 1], [58, 84, 88, 60])
        u = np.linspace(0, 1, 8)
        bend = angle - 0.35 * u * np.sign(angle)
        xs, ys = x + np.cumsum(np.cos(bend)) * length / 8, y - np.cumsum(np.sin(bend)) * length / 8
        width = np.interp(u, [0, 0.25, 1], [2.0, 2.9, 0.5]) * (0.8 + 0.3 * fullness) * rng.uniform(0.75, 1.1)
        fade = np.interp(t, [0, 0.08, 0.9, 1], [0.55, 1, 1, 0.7])
        canvas.stroke(xs, ys, width, rng.uniform(0.45, 0.85), fade)
    return canvas


def lashes() -> Canvas:
    """Upper lashes in the upper band, lower ones in the lower; roots at the bottom of each, tips up."""
    rng, canvas = np.random.default_rng(12), Canvas(512, 1024)
    for (low, _), count, long, thick in ((LASH_BANDS["upper"], 78, 175, 6.5), (LASH_BANDS["lower"], 50, 122, 4.2)):
        for root in (np.arange(count) + rng.uniform(0.1, 0.9, count)) / count:
            clump = (np.round(root * count / 3) * 3 + 0.5) / count
            tip = root + 0.45 * (clump - root) + rng.normal(0, 0.004) + 0.02 * (root - 0.5)
            edge = np.interp(root, [0, 0.12, 0.6, 0.92, 1], [0.35, 0.7, 1, 0.95, 0.5])
            u = np.linspace(0, 1, 12)
            length = long * edge * rng.uniform(0.72, 1.05)
            xs = 1024 * (root + (tip - root) * u**1.5)
            width = thick * (1 - u) ** 0.7 * rng.uniform(0.7, 1.05) + 0.5
            canvas.stroke(xs, 512 - low - 5 - length * u, width, 0.5)
    return canvas


def main(folder: Path) -> None:
    """Draw and save."""
    for name, brow in BROWS.items():
        brows(brow).save(folder / f"{name}.png")
    lashes().save(folder / "lashes.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
