"""The skin's texture: the head's point colours baked over its texture coordinates."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.parts import Texture, TextureInput
from procedural_head import topology, uv

SIZE = 512


def skin(colors: FloatArray) -> TextureInput:
    """The head's (n, 3) linear colours as an sRGB picture of SIZE pixels a side."""
    corners, shares = _pixels()
    values = np.einsum("pk,pkc->pc", shares, srgb(colors)[_points()[corners]])
    pixels = (np.clip(values, 0.0, 1.0) * 255 + 0.5).astype(np.uint8).reshape(SIZE, SIZE, 3)
    return TextureInput(texture=Texture(name="skin.png", data=png(pixels)))


def srgb(linear: FloatArray) -> FloatArray:
    """Linear colours 0..1 in sRGB's encoding."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def png(pixels: Any) -> bytes:
    """PNG bytes of (h, w, 3) 8-bit pixels."""
    from io import BytesIO

    from PIL import Image

    stream = BytesIO()
    Image.fromarray(pixels).save(stream, format="PNG", compress_level=9)
    return stream.getvalue()


@cache
def _used() -> tuple[IntArray, IntArray]:
    """Texture coordinates in use, and the head point of each."""
    indices = uv.head().indices
    assert indices is not None
    used, first = np.unique(indices, return_index=True)
    return used, topology.build().face_vertex_indices[first]


def _points() -> IntArray:
    return _used()[1]


@cache
def _pixels() -> tuple[IntArray, FloatArray]:
    """For each pixel, top row first, three of the used coordinates around its middle and their shares.

    The triangles are those of a Delaunay triangulation, which also fills the gaps between the islands, so that
    filtering finds no edge. Pixels outside all of them take the nearest coordinate.
    """
    from scipy.spatial import Delaunay, cKDTree

    values = uv.head().values[_used()[0]]
    mesh = Delaunay(values)
    middle = (np.arange(SIZE) + 0.5) / SIZE
    v, u = np.meshgrid(middle[::-1], middle, indexing="ij")
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    triangle = mesh.find_simplex(pixels)
    transform = mesh.transform[triangle]
    two = np.einsum("pij,pj->pi", transform[:, :2], pixels - transform[:, 2])
    shares = np.column_stack([two, 1 - two.sum(axis=1)])
    corners = mesh.simplices[triangle]
    outside = triangle < 0
    corners[outside] = cKDTree(values).query(pixels[outside])[1][:, None]
    shares[outside] = (1.0, 0.0, 0.0)
    return corners, shares
