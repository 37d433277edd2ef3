"""Scans of known faces: what a scanner sees of them, on another triangulation, noisy, with holes, anywhere in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scan_actors import ict

from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.polygons import edges
from facepipe.geometry.rasterise import Raster, rasterise, screen_triangles
from facepipe.geometry.similarity import Similarity

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]
BoolArray = npt.NDArray[np.bool_]

_PIXELS = 640
_CLEAR_PARTS = tuple(range(9, 17))  # fluid, blends, occlusion, lashes: no scanner sees them


@dataclass(frozen=True, kw_only=True)
class SimulatedScan:
    """A scan, and where its truth lies: ``truth = pose.undo(points)`` but for noise."""

    points: FloatArray  # (n, 3) in the scan's own unit and place
    triangles: IntArray  # (t, 3)
    landmarks: FloatArray  # (68, 3) as someone placed them
    pose: Similarity  # from the truth in millimetres to the scan


@dataclass(frozen=True, kw_only=True)
class ScanOptions:
    """What the scanner does."""

    noise: float = 0.1  # mm, standard deviation along each axis
    holes: int = 4
    jitter: float = 0.5  # mm, standard deviation of landmarks along each axis, before they are put onto the surface
    moved: bool = True  # turned, shifted and scaled at random


def simulate(truth: FloatArray, seed: int, options: ScanOptions | None = None) -> SimulatedScan:
    """A scan of whole ICT points (n, 3), millimetres."""
    options = options or ScanOptions()
    rng = np.random.default_rng([seed, 77])
    seen = visible_triangles(truth)
    landmarks = _placed(truth, seen, options.jitter, rng)
    points, triangles = retriangulated(truth, seen, rng)
    points = points + options.noise * rng.standard_normal(points.shape)
    triangles = _with_holes(points, triangles, options.holes, rng)
    used, triangles = np.unique(triangles, return_inverse=True)
    pose = _random_pose(rng) if options.moved else Similarity(rotation=np.eye(3), translation=np.zeros(3))
    return SimulatedScan(
        points=pose.apply(points[used]),
        triangles=triangles.reshape(-1, 3),
        landmarks=pose.apply(landmarks),
        pose=pose,
    )


def visible_triangles(points: FloatArray) -> IntArray:
    """(s, 3) triangles of solid parts that some view from around the head sees, from outside."""
    model = ict()
    part = np.searchsorted(model.part_faces[:, 1], model.triangle_faces, side="right")
    solid = np.flatnonzero(~np.isin(part, _CLEAR_PARTS))
    seen = np.zeros(len(solid), bool)
    for direction in _directions():
        seen |= _seen_from(points, model.triangles[solid], direction, ~seen)
    return np.asarray(model.triangles[solid[seen]])


def _directions() -> list[FloatArray]:
    turns = [(yaw, pitch) for pitch in (-0.5, 0.0, 0.5) for yaw in np.linspace(-np.pi, np.pi, 13)[:-1]]
    found = [np.array([np.sin(y) * np.cos(p), np.sin(p), np.cos(y) * np.cos(p)]) for y, p in turns]
    return [*found, np.array([0.0, 1.0, 0.1])]


def _seen_from(points: FloatArray, triangles: IntArray, direction: FloatArray, wanted: BoolArray) -> BoolArray:
    """(t,) those of the `wanted` triangles that are seen; only what covers one of these is drawn beside them."""
    right = np.cross([0.0, 1.0, 0.0], direction)
    right /= np.linalg.norm(right)
    local = points @ np.stack([right, np.cross(direction, right), direction], axis=1)
    used = local[triangles.ravel()]
    low, high = used.min(axis=0), used.max(axis=0)
    scale = (_PIXELS - 2) / float((high - low)[:2].max())
    flat = (local - low) * [scale, -scale, 1.0] + [1.0, _PIXELS - 1.0, 1.0]
    a, b, c = flat[triangles].transpose(1, 0, 2)
    towards = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    asked = wanted & (towards < 0)  # y down turns the corners round
    screen = screen_triangles(np.c_[flat, np.ones(len(flat))], triangles)
    alone = rasterise(screen.select(asked), _PIXELS, _PIXELS)
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    others = ~asked & _touch(alone.triangle >= 0, low, high)
    key = np.maximum(alone.key, rasterise(screen.select(others), _PIXELS, _PIXELS).key)
    hit = Raster(key=key).triangle
    seen = np.zeros(len(triangles), bool)
    seen[hit[hit >= 0]] = True
    return seen & asked


def _touch(mask: BoolArray, low: FloatArray, high: FloatArray) -> BoolArray:
    """(t,) rectangles on the screen that hold a marked pixel."""
    sums = np.zeros((_PIXELS + 1, _PIXELS + 1), np.int64)
    sums[1:, 1:] = mask.cumsum(axis=0).cumsum(axis=1)
    (left, top), (right, bottom) = (
        np.clip(one[:, :2].astype(np.int64) + more, 0, _PIXELS).T for one, more in ((low, 0), (high, 1))
    )
    return np.asarray(sums[bottom, right] + sums[top, left] > sums[top, right] + sums[bottom, left])


def retriangulated(points: FloatArray, triangles: IntArray, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
    """The same surface on other points: one somewhere on every edge, and one near every point, inside a triangle."""
    pairs, _ = edges(np.full(len(triangles), 3), triangles.ravel())
    share = rng.uniform(0.3, 0.7, (len(pairs), 1))
    on_edges = (1.0 - share) * points[pairs[:, 0]] + share * points[pairs[:, 1]]
    corners = rng.permutation(len(triangles))
    moved = points.copy()
    for corner in range(3):
        others = triangles[corners][:, [(corner + 1) % 3, (corner + 2) % 3]]
        away = points[others].mean(axis=1) - points[triangles[corners, corner]]
        moved[triangles[corners, corner]] = points[triangles[corners, corner]] + 0.15 * away
    number = {(int(a), int(b)): i + len(points) for i, (a, b) in enumerate(pairs)}
    middle = np.array(
        [[number[min(a, b), max(a, b)] for a, b in ((x, y), (y, z), (z, x))] for x, y, z in triangles.tolist()]
    )
    a, b, c = triangles.T
    ab, bc, ca = middle.T
    pieces = [np.stack(one, axis=1) for one in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
    return np.concatenate([moved, on_edges]), np.concatenate(pieces)


def _with_holes(points: FloatArray, triangles: IntArray, count: int, rng: np.random.Generator) -> IntArray:
    kept = np.ones(len(triangles), bool)
    centres = points[triangles].mean(axis=1)
    for middle in centres[rng.integers(0, len(centres), count)]:
        kept &= np.linalg.norm(centres - middle, axis=1) > rng.uniform(4.0, 9.0)
    return np.asarray(triangles[kept])


def _placed(truth: FloatArray, seen: IntArray, jitter: float, rng: np.random.Generator) -> FloatArray:
    """Landmarks as placed by hand: beside the truth, on the surface."""
    wanted = truth[ict().landmarks] + jitter * rng.standard_normal((68, 3))
    return np.asarray(closest_places(wanted, truth, seen).places)


def _random_pose(rng: np.random.Generator) -> Similarity:
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    q[:, 0] *= np.sign(np.linalg.det(q))
    scale = 10.0 ** rng.uniform(-1.0, 1.0)
    return Similarity(rotation=q, translation=scale * rng.normal(0.0, 300.0, 3), scale=scale)
