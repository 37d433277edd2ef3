"""Textures completed where colours are known in part: in the gradient domain, across seams of texture coordinates.

What is completed is the offset of colours from a guide (the template's own texture): where nothing is known, the
gradients of the result are the guide's, and no step shows at the border (Perez et al. 2003, whose Poisson equation for
colours is Laplace's for offsets). It is solved on the surface, where seams and borders of textures are no borders, and
offsets between what is known are smooth enough for the surface's points to hold them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import Float32Array, FloatArray, IntArray
from facepipe.geometry.differences import cotangent_weights, incidence
from facepipe.geometry.factor import factorise
from facepipe.geometry.polygons import point_areas
from facepipe.geometry.texels import Texels

_ZERO_WEIGHT = 1e-12  # weight of an offset of 0, which surfaces without anything known have


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
    return [_mixed(texture, texture.texels.carried(smooth)) for texture in known]


def _mixed(known: KnownOffsets, smooth: Float32Array) -> Float32Array:
    share = known.confidence.astype(np.float32)[:, None]
    offsets = np.where(share > 0, known.offsets, 0).astype(np.float32)
    return np.asarray(smooth + share * (offsets - smooth))


def spread(texels: Texels, values: FloatArray) -> Float32Array:
    """(size, size, c) values (m, c) of the texels, and beside them those of the nearest one: a gutter without end.

    Renderers and smaller mipmaps average over the borders of what a surface covers.
    """
    from scipy.ndimage import distance_transform_edt

    empty = np.ones(texels.size**2, bool)
    empty[texels.at] = False
    row, column = distance_transform_edt(empty.reshape(texels.size, -1), return_distances=False, return_indices=True)
    place = np.zeros(texels.size**2, np.int64)
    place[texels.at] = np.arange(len(texels.at))
    return np.asarray(np.asarray(values, np.float32)[place[row * texels.size + column]])
