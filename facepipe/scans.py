"""Scans of a face as plain numpy arrays, and where landmarks and painted markers lie on them.

Coordinates are those of the scan's own file: any rotation, any unit. Rebuild finds both when it fits the neutral.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import Float32Array, FloatArray, IntArray

LANDMARK_SCHEME = "multipie68"
LANDMARK_COUNT = 68


def no_triangles() -> IntArray:
    """(0, 3) int32: what a point cloud has."""
    return np.zeros((0, 3), np.int32)


@dataclass(frozen=True, kw_only=True)
class ScanPicture:
    """An image file on a scan: colours are ``linear texel * gain + bias``."""

    data: bytes
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class ScanTexture:
    """Pictures on the triangles of a scan."""

    uvs: FloatArray  # (t, 3, 2) of the corners, v up; pictures repeat
    picture: IntArray  # (t,) into `pictures`, -1 where there is none
    pictures: tuple[ScanPicture, ...]

    def on_triangles(self, kept: npt.NDArray[np.bool_]) -> ScanTexture:
        """That of the triangles marked in `kept` (t,)."""
        return replace(self, uvs=self.uvs[kept], picture=self.picture[kept])


class SurfaceColors(Protocol):
    """What shows a scan's surface besides its points and pictures on it: photos."""

    def __call__(self, points: FloatArray, normals: FloatArray, spacing: float) -> Float32Array:
        """(m, 3) linear colours at places (m, 3) of the surface; NaN where they are unknown.

        :param normals: (m, 3) unit, outward
        :param spacing: about how far apart the places are
        """


@dataclass(frozen=True, kw_only=True)
class ScanHints:
    """What a file says of its triangles that helps to find a face among them."""

    pieces: tuple[str, ...] = ()  # names of meshes, objects or groups
    piece: IntArray = field(default_factory=lambda: np.zeros(0, np.int32))  # (t,) into `pieces`, -1: of none
    head: npt.NDArray[np.bool_] | None = None  # (t,) those that the joint of a head carries
    # (3, 3) the person's left and right eye, and the mouth, where shapes of such names move points; NaN: unknown.
    features: FloatArray | None = None
    swapped: bool = False  # names say left of what lies right of the face, and right of what lies left
    mm_per_unit: float | None = None  # None: the file has no unit
    vertices: Mapping[str, FloatArray] = field(default_factory=dict)  # mesh -> (v, 3) points in the file's order

    def on_triangles(self, kept: npt.NDArray[np.bool_]) -> ScanHints:
        """Those of the triangles marked in `kept` (t,)."""
        piece = self.piece[kept] if len(self.piece) else self.piece
        return replace(self, piece=piece, head=None if self.head is None else self.head[kept])


@dataclass(frozen=True, kw_only=True)
class Scan:
    """One scanned surface, or a cloud of points."""

    name: str
    points: FloatArray  # (n, 3) float64
    triangles: IntArray = field(default_factory=no_triangles)  # (t, 3) int32, none in a point cloud
    normals: FloatArray | None = None  # (n, 3) unit vectors, outward
    colors: FloatArray | None = None  # (n, 3) linear 0..1
    texture: ScanTexture | None = None  # on the file's triangles: what mends triangles drops it
    photos: SurfaceColors | None = None  # before other colours, where they show the surface
    hints: ScanHints = field(default_factory=ScanHints)  # of the file's triangles, too
    warnings: tuple[str, ...] = ()  # of the reader, one line each

    @property
    def is_cloud(self) -> bool:
        """Whether it has points alone."""
        return len(self.triangles) == 0


def no_landmarks() -> FloatArray:
    """(68, 3) NaN: no landmark is known."""
    return np.full((LANDMARK_COUNT, 3), np.nan)


def no_sigmas() -> FloatArray:
    """(68,) NaN: a fit takes the sigma of its options."""
    return np.full(LANDMARK_COUNT, np.nan)


@dataclass(frozen=True, kw_only=True)
class ScanLandmarks:
    """Where the landmarks of a face lie on a scan, and markers that were painted on the actor."""

    scheme: str = LANDMARK_SCHEME
    points: FloatArray = field(default_factory=no_landmarks)  # (68, 3) float64, rows of NaN where unknown
    # (68,) mm: how far off each may be, the standard deviation of each coordinate; NaN: that of a fit's options.
    sigma_mm: FloatArray = field(default_factory=no_sigmas)
    markers: Mapping[str, FloatArray] = field(default_factory=dict)  # name -> (3,)

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """(68,) which landmarks have a place."""
        return np.asarray(np.isfinite(self.points).all(axis=1))
