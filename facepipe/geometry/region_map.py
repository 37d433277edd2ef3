"""Soft region masks of a mesh from a map painted over its UV layout, one colour a region."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.geometry.map_sampling import FIRST_TILE, MapSampling
from facepipe.geometry.region_texels import Image8, Palette, texel_shares

_TAPS = 8  # lookups a side of a footprint, at most
_SLACK = 1e-6  # in UV: what exporters leave of an exact 0 or 1


class RegionMasks(NamedTuple):
    """Masks (n, k), rows of sum 1 or 0, and the points (n,) that the map covers: those of sum 1."""

    masks: FloatArray
    covered: BoolArray


def region_masks(
    image: Image8,
    colors: Image8,
    uv: FloatArray,
    face_vertex_counts: IntArray,
    face_vertex_indices: IntArray,
    point_count: int,
    sampling: MapSampling,
    *,
    background: Image8 | None = None,
    where: str = "region map",
) -> RegionMasks:
    """Masks of the regions whose colours a map shows at the points of a mesh.

    A corner takes the texel that its UV lies in, v up: column ``floor(u w)``, row ``floor((1 - v) h)``; or the mean
    over a footprint of texels around it. `texel_shares` says what a texel counts for. Corners belong to the tile in
    which the middle of their face lies. A point takes the mean over its corners, those in other tiles or on unpainted
    texels left out; one without any corner left is not covered.

    :param image: (h, w, 3|4) RGB or RGBA, top row first; alpha below 128 is unpainted
    :param colors: (k, 3) one colour per mask
    :param uv: (corners, 2) texture coordinates
    :param face_vertex_counts: (faces,) corners of each face
    :param face_vertex_indices: (corners,) the corner's point
    :param background: (3,) a colour that is unpainted
    :param where: the trail to the map for messages
    :raises InputError: a colour that the legend lacks, or an image or colours of another shape
    :raises TopologyError: lists of corners that don't fit each other
    """
    _check_arrays(image, colors, uv, face_vertex_counts, face_vertex_indices)
    palette = Palette(colors=colors, background=background, tolerance=sampling.tolerance, edge=sampling.edge)
    place, inside = _in_tile(np.asarray(uv, dtype=np.float64), face_vertex_counts, sampling.tile)
    points = np.asarray(face_vertex_indices)[inside]
    lookup = _Lookup(image, palette)
    shares = lookup.sample(place[inside], sampling.footprint)
    if lookup.unknown:
        raise _unknown_color(where, image, palette, lookup, points)
    summed = np.stack([np.bincount(points, column, minlength=point_count) for column in shares.T], axis=1) + 0.0
    total = summed.sum(axis=1, keepdims=True)
    return RegionMasks(np.divide(summed, total, out=np.zeros_like(summed), where=total > 0), total[:, 0] > 0)


class _Lookup:
    """A map being sampled; remembers the texels of unknown colour and the UVs that hit them."""

    def __init__(self, image: Image8, palette: Palette) -> None:
        self.image, self.palette = image, palette
        self.unknown: list[tuple[IntArray, IntArray]] = []  # (texels, rows of the UVs), parallel

    def sample(self, place: FloatArray, footprint: int) -> FloatArray:
        """(m, k) shares at (m, 2) places in 0..1: rows of sum 1, or 0 where nothing is painted."""
        height, width = self.image.shape[:2]
        column, row = place[:, 0] * width, (1.0 - place[:, 1]) * height
        found = np.zeros((len(place), len(self.palette.colors)))
        taps = min(footprint, _TAPS)
        offsets = (np.arange(taps) + 0.5) / taps * footprint - footprint / 2
        for down in offsets if len(place) else ():
            for right in offsets:
                x = np.clip(np.floor(column + right), 0, width - 1).astype(np.int64)
                y = np.clip(np.floor(row + down), 0, height - 1).astype(np.int64)
                found += self._texels(y * width + x)
        total = found.sum(axis=1, keepdims=True)
        return np.asarray(np.divide(found, total, out=found, where=total > 0))

    def _texels(self, texels: IntArray) -> FloatArray:
        distinct, back = np.unique(texels, return_inverse=True)
        shares, unknown = texel_shares(self.image, distinct, self.palette)
        if unknown.any():
            rows = np.flatnonzero(unknown[back.ravel()])
            self.unknown.append((texels[rows], rows))
        return np.asarray(shares[back.ravel()])


def _in_tile(uv: FloatArray, counts: IntArray, tile: int | None) -> tuple[FloatArray, BoolArray]:
    """Places (corners, 2) in 0..1 of the map, and the corners (corners,) that lie on it.

    A face's middle says which tile its corners belong to: those on the line between two tiles lie in either.
    """
    face = np.repeat(np.arange(len(counts)), counts)
    sums = np.stack([np.bincount(face, axis, minlength=len(counts)) for axis in uv.T], axis=1)
    corner = np.floor(sums / np.maximum(counts, 1)[:, None])[face]
    place = uv - corner
    if tile is None:
        unit = np.asarray(((place >= 0) & (place <= 1)).all(axis=1))
        return np.where(unit[:, None], place, uv - np.floor(uv)), np.ones(len(uv), dtype=bool)
    row, column = divmod(tile - FIRST_TILE, 10)
    inside = (corner == (column, row)) & (place >= -_SLACK) & (place <= 1 + _SLACK)
    return np.clip(place, 0.0, 1.0), np.asarray(inside.all(axis=1))


def _unknown_color(where: str, image: Image8, palette: Palette, lookup: _Lookup, points: IntArray) -> InputError:
    """The colour that hits the most points, with how many, where, and the nearest that the legend has."""
    texels, rows = (np.concatenate(group) for group in zip(*lookup.unknown, strict=True))
    colors, of_hit = np.unique(image.reshape(-1, image.shape[2])[texels, :3], axis=0, return_inverse=True)
    pairs = np.unique(np.stack([of_hit.ravel(), points[rows]]), axis=1)
    hits = np.bincount(pairs[0], minlength=len(colors))
    worst = int(hits.argmax())
    y, x = divmod(int(texels[of_hit.ravel() == worst].min()), image.shape[1])
    distance = np.linalg.norm(palette.colors.astype(np.float64) - colors[worst], axis=1)
    nearest = int(distance.argmin())
    more = f" ({len(colors)} such colours at {len(np.unique(pairs[1]))} points in all)" if len(colors) > 1 else ""
    return InputError(
        f"{where} -> texel {x}, {y}",
        f"colour {hex_color(colors[worst])} at {hits[worst]} points{more}, expected one of the legend: the nearest, "
        f"{hex_color(palette.colors[nearest])}, is {distance[nearest]:.0f} away, the tolerance {palette.tolerance:g}",
    )


def hex_color(color: npt.ArrayLike) -> str:
    """``#rrggbb`` of three numbers 0..255."""
    return "#" + "".join(f"{int(channel):02x}" for channel in np.asarray(color)[:3])


def _check_arrays(
    image: Image8, colors: Image8, uv: FloatArray, face_vertex_counts: IntArray, face_vertex_indices: IntArray
) -> None:
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4) or not image.size:
        raise InputError("region map", f"{image.dtype} of shape {image.shape}, expected uint8 (height, width, 3 or 4)")
    if colors.dtype != np.uint8 or colors.ndim != 2 or colors.shape[1] != 3 or not len(colors):
        raise InputError("legend", f"{colors.dtype} colours of shape {colors.shape}, expected uint8 (k, 3), k above 0")
    if len(np.unique(colors, axis=0)) != len(colors):
        raise InputError("legend", "a colour twice, expected each once")
    corners = len(face_vertex_indices)
    if np.shape(uv) != (corners, 2) or int(np.sum(face_vertex_counts)) != corners:
        what = f"UVs of shape {np.shape(uv)} and faces of {int(np.sum(face_vertex_counts))} corners"
        raise TopologyError("UV set", f"{what}, expected those of {corners}")
