"""A face that can follow a scan: its model, what lies beyond that, places known on both, and that scan."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.closest_points import SurfaceSearch, place_shares
from facepipe.geometry.gradient_system import cotangent_weights
from facepipe.geometry.polygons import edges, point_normals
from facepipe.geometry.similarity import Similarity
from facepipe.geometry.vectors import unit_vectors

_SMOOTHINGS = 2  # noise of 0.1 mm turns the triangles of a scan by several degrees
_ON_EDGE = 1e-9
_AS_IT_LIES = Similarity(rotation=np.eye(3), translation=np.zeros(3))


@dataclass(frozen=True, kw_only=True)
class Matches:
    """Counterparts of the face's points on the scan."""

    places: FloatArray  # (m, 3)
    normals: FloatArray  # (m, 3) of the scan there
    distances: FloatArray  # (m,) from the surface: of a cloud, from the plane through the nearest point
    kept: BoolArray  # (m,)


@dataclass(frozen=True, kw_only=True)
class ScanTarget:
    """A surface, or a cloud of points with normals."""

    points: FloatArray  # (n, 3)
    triangles: IntArray  # (t, 3); none in a cloud
    normals: FloatArray  # (n, 3) unit
    border: BoolArray  # (n,) points where the scan ends

    @classmethod
    def of_surface(cls, points: FloatArray, triangles: IntArray) -> ScanTarget:
        """A triangulated scan, oriented outward; its normals are smoothed."""
        points = np.asarray(points, np.float64)
        pairs, uses = edges(np.full(len(triangles), 3), triangles.ravel())
        border = np.zeros(len(points), bool)
        border[pairs[uses == 1].ravel()] = True
        normals = point_normals(points, triangles)
        from scipy.sparse import csr_array

        count = len(normals)
        both = np.concatenate([pairs, pairs[:, ::-1]])
        neighbours = csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
        for _ in range(_SMOOTHINGS):
            normals = unit_vectors(normals + neighbours @ normals)
        return cls(points=points, triangles=triangles, normals=normals, border=border)

    @classmethod
    def of_cloud(cls, points: FloatArray, normals: FloatArray) -> ScanTarget:
        """A cloud with outward normals (n, 3); where it ends is not known."""
        nothing = np.zeros((0, 3), np.int64)
        return cls(
            points=np.asarray(points, np.float64),
            triangles=nothing,
            normals=np.asarray(normals, np.float64),
            border=np.zeros(len(points), bool),
        )

    def moved(self, by: Similarity) -> ScanTarget:
        """The same scan elsewhere."""
        return replace(self, points=by.apply(self.points), normals=self.normals @ by.rotation.T)

    def matches(
        self,
        points: FloatArray,
        normals: FloatArray,
        reach: float,
        angle: float,
        place: Similarity = _AS_IT_LIES,
        *,
        roughly: bool = False,
    ) -> Matches:
        """The nearest places to points (m, 3) with unit normals (m, 3).

        Kept are those up to `reach` away, whose normals differ by up to `angle` radians, and that are not on the
        scan's border: there the face goes on and the scan does not.

        :param place: from the scan to where the points are; what is found is there too. The scan itself stays, so that
            it is sorted once for all searches
        :param roughly: the nearest points of the scan instead of places on its triangles, in a tenth of the time
        """
        local = place.undo(points)
        if roughly or not len(self.triangles):
            distances, number = self._tree.query(local)
            places, facing, ended = self.points[number], self.normals[number], self.border[number]
        else:
            nearest = self._search.closest(local)
            shares = place_shares(nearest, self.points, self.triangles)
            corners = self.triangles[nearest.triangles]
            facing = unit_vectors(np.einsum("mc,mci->mi", shares, self.normals[corners]))
            ended = np.asarray(((shares > _ON_EDGE) & self.border[corners]).any(axis=1))
            places, distances = nearest.places, nearest.distances
        places, facing, distances = place.apply(places), facing @ place.rotation.T, place.scale * distances
        alike = np.einsum("mi,mi->m", facing, normals) >= np.cos(angle)
        kept = alike & ~ended & (distances <= reach)
        if not len(self.triangles):  # gaps between points of a cloud are no distance from what they show
            distances = np.abs(np.einsum("mi,mi->m", points - places, facing))
        return Matches(places=places, normals=facing, distances=distances, kept=kept)

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    @cached_property
    def _search(self) -> SurfaceSearch:
        return SurfaceSearch(self.points, self.triangles)


@dataclass(frozen=True, kw_only=True)
class DeformableSurface:
    """``points = base + sum_k coefficient_k mode_k + residual``, in millimetres, n points.

    Coefficients have a Gaussian prior: `expected`, with variance 1 / `precision`. The residual is a membrane on the
    base, at rest where nothing pulls.
    """

    base: FloatArray  # (n, 3)
    modes: FloatArray  # (k, n, 3)
    expected: FloatArray  # (k,)
    precision: FloatArray  # (k,) above 0
    triangles: IntArray  # (t, 3)
    seen: IntArray  # (m,) points that a scan shows: those look for their places
    held: FloatArray  # (n,) 0 or more: how much the residual is drawn to 0 where it should stay, per mm^2 of area
    # (n,) or none: points of +a and -a never correspond
    labels: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))

    def points(self, coefficients: FloatArray, residual: FloatArray | float = 0.0) -> FloatArray:
        """(n, 3) points of coefficients (k,) and a residual (n, 3)."""
        return np.asarray(self.base + np.tensordot(coefficients, self.modes, axes=1) + residual)

    def with_modes(self, modes: FloatArray, precision: float) -> DeformableSurface:
        """The same with more modes (k, n, 3), expected at 0."""
        return replace(
            self,
            modes=np.concatenate([self.modes, modes]),
            expected=np.append(self.expected, np.zeros(len(modes))),
            precision=np.append(self.precision, np.full(len(modes), precision)),
        )


@dataclass(frozen=True, kw_only=True)
class Shown:
    """Motion that a scan shows besides the surface, such as an expression: modes with weights of a Gaussian prior."""

    modes: FloatArray  # (k, n, 3)
    expected: FloatArray  # (k,)
    precision: FloatArray  # (k,) above 0

    @classmethod
    def nothing(cls, count: int) -> Shown:
        """The surface of `count` points as it is."""
        return cls(modes=np.zeros((0, count, 3)), expected=np.zeros(0), precision=np.zeros(0))


def means_around(base: FloatArray, triangles: IntArray) -> Any:
    """(n, n) sparse: means over the points around each. An anchor that pulled one point alone would draw a spike."""
    from scipy.sparse import csr_array, diags_array, identity

    count = len(base)
    pairs, _ = cotangent_weights(base, triangles)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    near = csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)) + identity(count)
    mean = diags_array(1.0 / near.sum(axis=1)) @ near
    return (mean @ mean).tocsr()


@dataclass(frozen=True, kw_only=True)
class Anchors:
    """l places, each on a triangle (or a point, with share 1), with where the scan has them."""

    corners: IntArray  # (l, 3) points of the surface
    shares: FloatArray  # (l, 3) in sum 1
    targets: FloatArray  # (l, 3) on the scan
    names: tuple[str, ...] = field(default=())  # one each, for reports
    sigmas: FloatArray = field(default_factory=lambda: np.zeros(0))  # (l,) mm or none; NaN: that of the options

    @classmethod
    def at_points(
        cls, points: IntArray, targets: FloatArray, names: tuple[str, ...] = (), sigmas: FloatArray | None = None
    ) -> Anchors:
        """Anchors at points (l,) of the surface; rows of NaN in `targets` (l, 3) are left out."""
        known = np.flatnonzero(np.isfinite(targets).all(axis=1))
        shares = np.tile([1.0, 0.0, 0.0], (len(known), 1))
        corners = np.repeat(np.asarray(points)[known, None], 3, axis=1)
        kept = tuple(names[i] for i in known) if names else ()
        known_sigmas = np.zeros(0) if sigmas is None else np.asarray(sigmas, np.float64)[known]
        targets = np.asarray(targets, np.float64)[known]
        return cls(corners=corners, shares=shares, targets=targets, names=kept, sigmas=known_sigmas)

    def __len__(self) -> int:
        return len(self.targets)

    def variances(self, sigma: float) -> FloatArray:
        """(l,) mm^2, where those without a sigma of their own have `sigma`."""
        variances = np.full(len(self), sigma**2)
        if len(self.sigmas):
            given = np.isfinite(self.sigmas)
            variances[given] = self.sigmas[given] ** 2
        return variances

    def places(self, values: FloatArray) -> FloatArray:
        """(l, ...) values (n, ...) of the surface's points at the anchors."""
        return np.asarray(np.einsum("lc,lc...->l...", self.shares, values[self.corners]))

    def matrix(self, count: int) -> Any:
        """(l, count) sparse: values of points to values at the anchors."""
        from scipy.sparse import csr_array

        rows = np.repeat(np.arange(len(self)), 3)
        return csr_array((self.shares.ravel(), (rows, self.corners.ravel())), shape=(len(self), count))

    def with_more(self, other: Anchors) -> Anchors:
        """These and others."""
        return Anchors(
            corners=np.concatenate([self.corners, other.corners]),
            shares=np.concatenate([self.shares, other.shares]),
            targets=np.concatenate([self.targets, other.targets]),
            names=self.names + other.names,
            sigmas=np.concatenate(
                [anchors.sigmas if len(anchors.sigmas) else np.full(len(anchors), np.nan) for anchors in (self, other)]
            ),
        )
