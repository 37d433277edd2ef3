"""Pictures of the gums with the tongue, and of the teeth.

usage: python samples/head/mouth.py ../shared/data facepipe/heads/data
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from anatomy import GUMS, TEETH, tongue_of
from model import Model, read
from PIL import Image
from scipy.ndimage import gaussian_filter
from skin_maps import baked, step

from facepipe.geometry.colors import to_srgb
from facepipe.geometry.polygons import triangulate
from facepipe.heads.skin import to_bytes

Array = Any
SIZE = 512  # texels a side
GUM, TONGUE, THROAT = np.array([0.54, 0.21, 0.19]), np.array([0.50, 0.20, 0.175]), np.array([0.20, 0.055, 0.05])
IVORY, NECK, EDGE = np.array([0.76, 0.70, 0.58]), np.array([0.62, 0.51, 0.35]), np.array([0.68, 0.66, 0.60])


@dataclass(frozen=True)
class Piece:
    """A loose part as `baked` takes it."""

    uv: Array
    triangles: Array
    uv_triangles: Array

    @classmethod
    def of(cls, model: Model, faces: tuple[int, int]) -> Piece:
        """The faces from the first to the last."""
        ends = np.concatenate([[0], np.cumsum(model.counts)])[list(faces)]
        corners, _ = triangulate(model.counts[slice(*faces)])
        own = slice(*ends)
        return cls(model.uvs, model.indices[own][corners], model.uv_indices[own][corners])


def gums(model: Model) -> Array:
    """(n, 3) linear colours of the model's points: gums, tongue, darker towards the throat."""
    tongue, z = tongue_of(model), model.points[:, 2]
    share, along = np.zeros(len(model.points)), np.zeros(len(model.points))
    share[tongue.points], along[tongue.points] = 1, tongue.along
    colors = GUM + share[:, None] * (TONGUE * (1 + 0.12 * along[:, None]) - GUM)
    return colors + step(5.5, 1.5, z)[:, None] * (THROAT - colors)


def teeth(model: Model, ranges: Array) -> Array:
    """(n, 3) linear colours of the model's points: darker at the necks, clearer at the edges, molars yellower."""
    colors = np.tile(IVORY, (len(model.points), 1))
    for first, last in ranges:
        own = model.points[first:last]
        height = (own[:, 1] - own[:, 1].min()) / np.ptp(own[:, 1])
        if own[:, 1].mean() > -3.35:  # an upper one: its edge is below
            height = 1 - height
        back = step(9.5, 5.5, own[:, 2].mean())
        one = IVORY * (1 - back * np.array([0.08, 0.12, 0.2]))
        one = one + step(0.62, 0.25, height)[:, None] * (NECK - one) * 0.8
        colors[first:last] = one + step(0.86, 1.0, height)[:, None] * (EDGE - one) * 0.6
    return colors


def picture(model: Model, faces: tuple[int, int], tile: int, colors: Array, grain: float) -> Image.Image:
    """Colours baked over a tile, with some mottling."""
    rng = np.random.default_rng(40 + tile)
    texels = baked(Piece.of(model, faces), tile, colors, SIZE)
    mottle = sum(gaussian_filter(rng.standard_normal((SIZE, SIZE)), s) * s for s in (1.5, 6))
    texels = texels * np.exp(grain * mottle[..., None] * (0.4, 1.0, 1.0))
    return Image.fromarray(to_bytes(to_srgb(texels)))


def main(data: Path, folder: Path) -> None:
    """Draw and save."""
    model = read(data)
    with np.load(data / "ict_facekit" / "ict_facekit.npz") as arrays:
        ranges = arrays["tooth_vertex_range"]
    tongue = picture(model, GUMS.faces, 2, gums(model), 0.10)
    tongue.save(folder / "gums.jpg", quality=88)
    picture(model, TEETH.faces, 3, teeth(model, ranges), 0.02).save(folder / "teeth.jpg", quality=88)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
