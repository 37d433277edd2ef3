"""A scan as a dense cloud of coloured points, whatever it has its colours from: points, pictures, a surface or none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from facepipe.core.images import open_image, pixels
from facepipe.geometry.cloud_normals import cloud_normals
from facepipe.geometry.colors import from_srgb
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.similarity import Similarity
from facepipe.scans import Scan, ScanPicture, ScanTexture, SurfaceColors

_MOST = 6_000_000  # samples of a scan
_STEPS = 64  # of a triangle's side, at most
_NEIGHBOURS = 16  # of a point of a cloud


@dataclass(frozen=True, kw_only=True)
class ScanSamples:
    """s places of a scan's surface."""

    points: FloatArray  # (s, 3)
    normals: FloatArray  # (s, 3) unit, outward as far as the scan's are
    colors: Float32Array | None  # (s, 3) linear; None where the scan has none
    spacing: float  # about how far apart they are


def scan_samples(scan: Scan, place: Similarity, low: FloatArray, high: FloatArray, spacing: float) -> ScanSamples:
    """Samples of a scan within a box.

    :param place: from the scan's coordinates to those of the samples
    :param low: (3,) corner of the box
    :param high: (3,) the other
    :param spacing: how far apart they may be; clouds are taken as they are
    :raises InputError: a picture that can't be read
    """
    points = place.apply(scan.points)
    inside = np.asarray(((points >= low) & (points <= high)).all(axis=1))
    if scan.is_cloud:
        return _of_cloud(scan, points, inside, place)
    # Any corner, not all: else the box would have a rim without samples, as wide as the scan's triangles.
    triangles = np.flatnonzero(inside[scan.triangles].any(axis=1))
    normals = point_normals(points, scan.triangles)
    owners, shares, spacing = _lattice(points[scan.triangles[triangles]], spacing)
    owners = triangles[owners]
    corners = scan.triangles[owners]
    samples = ScanSamples(
        points=_mixed(points, corners, shares),
        normals=unit(_mixed(normals, corners, shares)),
        colors=_colors(scan, owners, corners, shares),
        spacing=spacing,
    )
    return samples if scan.photos is None else _photographed(samples, scan.photos, place)


def _photographed(samples: ScanSamples, photos: SurfaceColors, place: Similarity) -> ScanSamples:
    """The samples with the colours of the photos where these show them."""
    assert samples.colors is not None  # scans of photos have some at their points
    colors = photos(place.undo(samples.points), samples.normals @ place.rotation, samples.spacing / place.scale)
    return replace(samples, colors=np.where(np.isfinite(colors), colors, samples.colors))


def _of_cloud(scan: Scan, points: FloatArray, inside: BoolArray, place: Similarity) -> ScanSamples:
    normals = cloud_normals(points, _NEIGHBOURS).normals if scan.normals is None else scan.normals @ place.rotation.T
    from scipy.spatial import cKDTree

    kept = np.flatnonzero(inside)
    near = cKDTree(points[kept]).query(points[kept], k=2)[0][:, 1] if len(kept) > 1 else np.ones(1)
    return ScanSamples(
        points=points[kept],
        normals=normals[kept],
        colors=None if scan.colors is None else scan.colors[kept].astype(np.float32),
        spacing=float(np.median(near)),
    )


def _lattice(corners: FloatArray, spacing: float) -> tuple[IntArray, FloatArray, float]:
    """Owners (s,) and barycentric shares (s, 3) of points spread evenly over triangles (t, 3, 3), and their spacing."""
    sides = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).max(axis=1, initial=0.0)
    while True:
        steps = np.clip(np.ceil(sides / spacing), 1, _STEPS).astype(np.int64)
        if (steps**2).sum() <= _MOST:
            break
        spacing *= 1.2
    owners, shares = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    for count in np.unique(steps):
        here = np.flatnonzero(steps == count)
        middles = _middles(int(count))
        owners.append(np.repeat(here, len(middles)))
        shares.append(np.tile(middles, (len(here), 1)))
    return np.concatenate(owners), np.concatenate(shares), spacing


def _middles(steps: int) -> FloatArray:
    """(steps^2, 3) barycentrics of the middles of the triangles that a triangle is cut into."""
    first, second = (axis.ravel() for axis in np.meshgrid(np.arange(steps), np.arange(steps), indexing="ij"))
    up, down = first + second < steps, first + second < steps - 1
    ups = np.column_stack([first[up] + 1 / 3, second[up] + 1 / 3])
    downs = np.column_stack([first[down] + 2 / 3, second[down] + 2 / 3])
    two = np.concatenate([ups, downs]) / steps
    return np.column_stack([two, 1 - two.sum(axis=1)])


def _colors(scan: Scan, owners: IntArray, corners: IntArray, shares: FloatArray) -> Float32Array | None:
    colors = None if scan.colors is None else _mixed(scan.colors, corners, shares).astype(np.float32)
    if scan.texture is None or colors is None:
        return colors
    for number, texels in enumerate(_texels(scan.texture)):
        here = np.flatnonzero(scan.texture.picture[owners] == number)
        uv = np.einsum("sk,skc->sc", shares[here], scan.texture.uvs[owners[here]])
        colors[here] = _looked_up(texels, uv, scan.texture.pictures[number])
    return colors


def _texels(texture: ScanTexture) -> Iterator[npt.NDArray[np.uint8]]:
    """(h, w, 3) sRGB bytes of each picture."""
    for number, picture in enumerate(texture.pictures):
        where = f"picture {number + 1} of the scan"
        yield pixels(open_image(picture.data, where), "RGB", where)


def _looked_up(texels: npt.NDArray[np.uint8], uv: FloatArray, picture: ScanPicture) -> Float32Array:
    """(s, 3) linear colours of the texels (h, w, 3) at UVs (s, 2), bilinear."""
    height, width = texels.shape[:2]
    x, y = uv[:, 0] % 1.0 * width - 0.5, (1.0 - uv[:, 1]) % 1.0 * height - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    # Decoded before they are mixed: means of sRGB bytes are too dark.
    levels = from_srgb(np.arange(256) / 255).astype(np.float32)
    total = np.zeros((len(uv), 3), np.float32)
    for column, row, share in (
        (left, top, (1 - x + left) * (1 - y + top)),
        (left + 1, top, (x - left) * (1 - y + top)),
        (left, top + 1, (1 - x + left) * (y - top)),
        (left + 1, top + 1, (x - left) * (y - top)),
    ):
        total += share.astype(np.float32)[:, None] * levels[texels[row % height, column % width]]
    return np.asarray(np.clip(total * np.array(picture.gain) + np.array(picture.bias), 0, 1), np.float32)


def _mixed(values: FloatArray, corners: IntArray, shares: FloatArray) -> FloatArray:
    return np.asarray(sum(values[corner] * share[:, None] for corner, share in zip(corners.T, shares.T, strict=True)))


def unit(vectors: FloatArray) -> FloatArray:
    """(m, 3) of length 1."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))
