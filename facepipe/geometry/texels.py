"""Texels of a texture that lie on a surface, where each is on it, and textures completed that are known in part."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import Float32Array, FloatArray, IntArray
from facepipe.geometry.factor import factorise
from facepipe.geometry.gradient_system import cotangent_weights, incidence
from facepipe.geometry.polygons import point_areas
from facepipe.geometry.rasterise import Raster, edge_planes, rasterise, screen_triangles, shares

_RUN = 1 << 16  # texels whose colours fit into a processor's cache: whole textures take twice as long
_ZERO_WEIGHT = 1e-12  # weight of an offset of 0, which surfaces without anything known have


@dataclass(frozen=True, kw_only=True)
class Texels:
    """Texels whose centres a surface covers in its texture coordinates."""

    size: int  # texels a side of the texture
    at: IntArray  # (m,) row * size + column, top row first, ascending
    corners: IntArray  # (m, 3) points of the triangle that covers it, int32 as `texels_of` makes them
    weights: Float32Array  # (m, 3) barycentrics there

    def carried(self, values: FloatArray) -> Float32Array:
        """(m, c) values (n, c) of the surface's points, interpolated."""
        return np.asarray(self._shares(len(values)) @ np.asarray(values, np.float32))

    def summed(self, values: FloatArray, count: int) -> FloatArray:
        """(count, c) sums over texels of values (m, c), shared out to points by barycentrics: `carried`, transposed."""
        sums = np.zeros((count, values.shape[1]))
        for run, part in self.runs():
            sums += part._shares(count).T @ np.asarray(values[run], np.float64)
        return sums

    def runs(self) -> Iterator[tuple[slice, Texels]]:
        """Texels one after another, with where they are among all."""
        for start in range(0, len(self.at), _RUN):
            run = slice(start, start + _RUN)
            yield run, Texels(size=self.size, at=self.at[run], corners=self.corners[run], weights=self.weights[run])

    def by_runs(self, rows: Callable[..., FloatArray], *columns: FloatArray) -> Float32Array:
        """(m, c) the rows that a function makes of a run of texels and of what `columns` (m, ...) have there."""
        made = np.zeros((0, 0), np.float32)
        for run, part in [*self.runs()] or [(slice(None), self)]:
            some = rows(part, *(each[run] for each in columns))
            made = made if made.size else np.empty((len(self.at), some.shape[1]), np.float32)
            made[run] = some
        return made

    def _shares(self, count: int) -> Any:
        """(m, count) scipy's sparse matrix of the barycentrics: a product with it takes a sixth of three gathers."""
        from scipy.sparse import csr_array

        ends = np.arange(0, self.corners.size + 1, 3, dtype=np.int32)
        return csr_array((self.weights.ravel(), self.corners.ravel(), ends), shape=(len(self.at), count))

    def taken(self, places: IntArray) -> Texels:
        """Those at `places`, in that order."""
        parts = {name: np.take(getattr(self, name), places, axis=0) for name in ("at", "corners", "weights")}
        return Texels(size=self.size, **parts)

    def picture(self, values: FloatArray, otherwise: FloatArray) -> FloatArray:
        """(size, size, c) values (m, c) at the texels, and `otherwise` (size, size, c) beside them."""
        filled = np.array(otherwise, np.float32).reshape(self.size**2, -1)
        filled[self.at] = values
        return filled.reshape(self.size, self.size, -1)


def texels_of(uv_corners: FloatArray, triangles: IntArray, size: int) -> Texels:
    """The texels that triangles cover; where several do, those of the first.

    :param uv_corners: (t, 3, 2) texture coordinates, v up, which repeat: a triangle lies in the unit square of its mean
    :param triangles: (t, 3) points
    """
    inside = uv_corners - np.floor(uv_corners.mean(axis=1, keepdims=True))
    flat = inside.reshape(-1, 2)
    screen = np.column_stack([flat[:, 0] * size, (1.0 - flat[:, 1]) * size, np.ones(len(flat)), np.ones(len(flat))])
    numbers = np.arange(len(flat)).reshape(-1, 3)
    key = rasterise(screen_triangles(screen, numbers), size, size).key.ravel()
    at, points, planes = np.flatnonzero(key != 0), triangles.astype(np.int32), edge_planes(screen, numbers)
    texels = Texels(
        size=size, at=at, corners=np.empty((len(at), 3), np.int32), weights=np.empty((len(at), 3), np.float32)
    )
    for _, part in texels.runs():
        row = part.at // size
        ids = Raster(key=np.take(key, part.at)).triangle
        part.corners[:] = np.take(points, ids, axis=0)
        part.weights[:] = shares(planes, ids, part.at - size * row + 0.5, row + 0.5).T
    return texels


@dataclass(frozen=True, kw_only=True)
class KnownOffsets:
    """Offsets of one texture from its guide, as far as they are known."""

    texels: Texels
    offsets: FloatArray  # (m, c) at the texels
    confidence: FloatArray  # (m,) 0 to 1; where it is 0, offsets don't count


def membrane(
    points: FloatArray, triangles: IntArray, values: FloatArray, weights: FloatArray, reach: float
) -> FloatArray:
    """(n, c) the smooth function of a surface that is near `values` where `weights` are, and harmonic elsewhere.

    It minimises the integral of ``weight |f - value|^2 + reach^2 |grad f|^2`` (a screened Poisson equation), by linear
    finite elements. Connected parts without any weight have 0.

    :param points: (n, 3)
    :param triangles: (t, 3)
    :param values: (n, c)
    :param weights: (n,) 0 or more
    :param reach: what is smaller than this in `values` is smoothed, in the unit of the points
    """
    from scipy.sparse import diags_array

    edges, stiffness = cotangent_weights(points, triangles)
    differences = incidence(edges, len(points))
    areas = point_areas(points, triangles)
    held = areas * weights
    smooth = differences.T @ diags_array(stiffness * reach**2) @ differences
    # a piece of surface without known colours has the constants as its kernel: held to 0 by next to nothing
    floor = _ZERO_WEIGHT * max(float(areas.mean()), np.finfo(np.float64).tiny)
    return factorise(diags_array(held + floor) + smooth).solve(held[:, None] * values)


def completed(
    points: FloatArray, triangles: IntArray, known: Sequence[KnownOffsets], reach: float
) -> list[Float32Array]:
    """Offsets (m, c) at all texels of each texture: the known ones, and what continues them over the surface.

    Where an offset is known with a confidence below 1, it is mixed with the smooth one: details fade out there.

    :param points: (n, 3) that the texels' corners number
    :param triangles: (t, 3) of all of the surface
    :param reach: `membrane`
    """
    counts, sums = np.zeros((len(points), 1)), np.zeros((len(points), known[0].offsets.shape[1] + 1))
    for texture in known:
        columns = np.column_stack([texture.offsets, np.ones(len(texture.offsets))]) * texture.confidence[:, None]
        sums += texture.texels.summed(columns, len(points))
        counts += texture.texels.summed(np.ones((len(texture.offsets), 1)), len(points))
    total = sums[:, -1:]
    means = np.divide(sums[:, :-1], total, out=np.zeros_like(sums[:, :-1]), where=total > 0)
    # at the points, not the texels: 14,062 unknowns for the head in the box, not the 4 million of a texture of 2048
    smooth = membrane(points, triangles, means, total[:, 0] / np.maximum(counts[:, 0], 1e-12), reach)
    mixed = []
    for texture in known:
        carried, share = texture.texels.carried(smooth), texture.confidence.astype(np.float32)[:, None]
        offsets = np.where(share > 0, texture.offsets, 0).astype(np.float32)
        mixed.append(np.asarray(carried + share * (offsets - carried)))
    return mixed


def spread(texels: Texels, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(size, size, c) values (m, c) of the texels, and beside them those of the nearest one: a gutter without end.

    Renderers and smaller mipmaps average over the borders of what a surface covers.
    """
    from scipy.ndimage import distance_transform_edt

    empty = np.ones(texels.size**2, bool)
    empty[texels.at] = False
    row, column = distance_transform_edt(empty.reshape(texels.size, -1), return_distances=False, return_indices=True)
    place = np.zeros(texels.size**2, np.int32)
    place[texels.at] = np.arange(len(texels.at), dtype=np.int32)
    return np.asarray(np.take(values, place[row * texels.size + column], axis=0))
