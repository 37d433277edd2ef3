"""Light that doesn't arrive: shadow maps, and which parts of the sky points see, gathered from many of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from facepipe.core.threads import mapped
from facepipe.geometry.rasterise import crossing, depths

AMBIENT_DIRECTIONS = 24
SKY_RESOLUTION = 256  # map pixels
SHADOW_RESOLUTION = 768
_BACK = np.array([1.0, 1.0, -1.0])  # the other way along the third axis
_FACING = 0.02  # cosine between a normal and a direction from which light can arrive
_TAPS = 12  # samples of a soft shadow, and to find how wide it is
_WIDEST = 40.0  # map pixels of a soft shadow's edge
_TURN = 0.875  # of the spiral: few directions see then on a head about what 300 see
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True, kw_only=True)
class Sky:
    """What points see of a sphere of directions."""

    directions: FloatArray  # (d, 3) unit, world
    seen: npt.NDArray[np.float16]  # (n, d) share of the light from each direction that arrives

    def share(self, normals: FloatArray) -> FloatArray:
        """(n,) share of an even sky's light that arrives at points with unit normals (n, 3), 0..1."""
        return self.shares(normals, np.ones((len(self.directions), 1)))[:, 0]

    def shares(self, normals: FloatArray, light: FloatArray) -> FloatArray:
        """(n, c) shares of light that comes from the directions with strengths (d, c), by the cosine law."""
        cosine = normals @ self.directions.T
        cosine[cosine <= _FACING] = 0.0
        full, arriving = cosine @ light, (cosine * self.seen.astype(np.float32)) @ light
        return np.where(full > 0, arriving / np.where(full > 0, full, 1.0), 1.0)


@dataclass(frozen=True, kw_only=True)
class DepthMap:
    """What a distant light sees of the scene."""

    axes: FloatArray  # (3, 3) rows: right, up, towards the light
    scale: float  # map pixels per unit of length
    origin: FloatArray  # (3,) map coordinates of the world origin
    nearness: Float32Array  # (r, r) map units towards the light, 0 where nothing is

    def lit(self, points: FloatArray, normals: FloatArray, radius: int = 1) -> FloatArray:
        """(n,) share of light that reaches points with unit normals, softened over `radius` map pixels."""
        x, y, limit = self._coordinates(points, normals, 0.6 + radius)
        # percentage-closer filtering: the share of a bilinearly weighted window that is not nearer than the point
        size, steps = self.nearness.shape[0], range(-radius, radius + 2)
        column, row = (np.floor(each - 0.5).astype(np.int32) for each in (x, y))
        right, down = x - 0.5 - column.astype(np.float32), y - 0.5 - row.astype(np.float32)
        columns = [np.clip(column + step, 0, size - 1) for step in steps]
        flat, lit = self.nearness.ravel(), np.zeros(len(x), np.float32)
        for dy in steps:
            line = np.clip(row + dy, 0, size - 1) * size
            along = np.zeros(len(x), np.float32)
            for dx, place in zip(steps, columns, strict=True):
                along += _windowed(dx, radius, right, flat.take(line + place) <= limit)
            lit += _windowed(dy, radius, down, along)
        return lit / (2 * radius + 1) ** 2

    def softly_lit(self, points: FloatArray, normals: FloatArray, spread: float, turn: FloatArray) -> FloatArray:
        """(n,) share of the light of a disc that reaches points: sharp at the contact, softer away from it.

        Percentage-closer soft shadows (Fernando 2005): the mean distance of what stands before a point sets the width.

        :param spread: tangent of half the angle under which the light is seen
        :param turn: (n,) radians by which each point's sample pattern is turned, which makes noise of bands
        """
        at = self._coordinates(points, normals, 1.2)
        gap, blockers = np.zeros_like(at[0]), np.zeros_like(at[0])
        for x, y in _spiral(turn):
            above = self._above(at, x * _WIDEST * 0.6, y * _WIDEST * 0.6)
            blocked = above > 0
            gap += np.where(blocked, above, 0)
            blockers += blocked
        width = np.clip(gap / np.maximum(blockers, 1) * spread, 1.0, _WIDEST)
        lit = np.zeros_like(at[0])
        for x, y in _spiral(turn):
            # a wide kernel reaches along the surface: what is not clearly above the point does not hide it.
            lit += self._above(at, x * width, y * width) <= 0.5 * width * np.hypot(x, y)
        return np.where(blockers > 0, lit / _TAPS, 1.0)

    def _above(self, at: Float32Array, x: FloatArray, y: FloatArray) -> FloatArray:
        """(n,) how far what the light sees beside map coordinates (3, n) is above them, map pixels."""
        size = self.nearness.shape[0]
        column = np.clip(at[0] + x, 0, size - 1).astype(np.int32)
        row = np.clip(at[1] + y, 0, size - 1).astype(np.int32)
        return np.asarray(self.nearness.ravel().take(row * size + column) - at[2])

    def _coordinates(self, points: FloatArray, normals: FloatArray, reach: float) -> Float32Array:
        """(3, n) column, row and nearness of points lifted from their surface by what `reach` map pixels need.

        Leaving the surface along its normal, more at grazing light, keeps it from shading itself.
        """
        facing = np.abs(normals @ self.axes[2])
        lift = reach * np.sqrt(np.maximum(1 - facing**2, 0)) + 0.3
        lifted = points + normals * (lift / self.scale)[:, None]
        return np.asarray(self.scale * self.axes @ lifted.T + self.origin[:, None], dtype=np.float32)


def depth_map(points: FloatArray, triangles: IntArray, towards: FloatArray, resolution: int) -> DepthMap:
    """The scene's triangles (t, 3) as seen from the direction `towards` (3,), a distant light."""
    return _Blockers(points, triangles).maps(towards, resolution, back=False)[0]


def depth_maps(
    points: FloatArray, triangles: IntArray, towards: FloatArray, resolution: int
) -> tuple[DepthMap, DepthMap]:
    """The scene's triangles (t, 3) as distant lights see them, one from `towards` (3,), one from the other side."""
    return _Blockers(points, triangles).maps(towards, resolution)


class _Blockers:
    """What keeps light away, as distant lights see it."""

    def __init__(self, points: FloatArray, triangles: IntArray) -> None:
        """Of triangles (t, 3) between points (n, 3)."""
        drawn = np.zeros(len(points), dtype=bool)
        drawn[triangles] = True
        self._points = np.ascontiguousarray(points[drawn].T)  # others would stretch what a light looks at
        self._triangles = np.asfortranarray((np.cumsum(drawn) - 1).take(triangles))

    def maps(self, towards: FloatArray, resolution: int, *, back: bool = True) -> tuple[DepthMap, DepthMap]:
        """Maps of the light from `towards` (3,), and with `back` from the other side."""
        backward = towards / np.linalg.norm(towards)
        helper = np.eye(3)[np.argmin(np.abs(backward))]
        right = np.cross(helper, backward)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(backward, right), backward])
        placed = axes @ self._points
        low, high = placed.min(axis=1), placed.max(axis=1)
        scale = (resolution - 8) / max(float(np.max(high - low)), 1e-12)
        # Nearness starts at 1: 0 marks an empty pixel.
        origin = np.array([resolution / 2, resolution / 2, 1.0]) - scale * np.append((low + high)[:2] / 2, low[2])
        at = (scale * placed + origin[:, None]).astype(np.float32)
        nearest, farthest = depths(crossing(at, self._triangles), resolution, resolution, far=back)
        # From the other side, nearness counts down from the farthest.
        most = 2 + scale * (high - low)[2]
        turned = np.where(np.isinf(farthest), np.float32(0), np.float32(most) - farthest)
        return (
            DepthMap(axes=axes, scale=scale, origin=origin, nearness=nearest),
            DepthMap(axes=axes * _BACK[:, None], scale=scale, origin=origin * _BACK + (0, 0, most), nearness=turned),
        )


@dataclass(frozen=True, kw_only=True)
class SkyMaps:
    """What stands before each part of the sky; points look it up."""

    directions: FloatArray  # (d, 3) unit, world
    maps: tuple[DepthMap, ...]  # d; none where nothing stands anywhere

    @classmethod
    def of(cls, points: FloatArray, triangles: IntArray, resolution: int) -> SkyMaps:
        """Of triangles (t, 3), `resolution` pixels a side of the map that each direction has."""
        directions = sphere_directions(AMBIENT_DIRECTIONS)
        if not len(triangles):
            return cls(directions=directions, maps=())
        blockers = _Blockers(points, triangles)
        half = directions[: len(directions) // 2]
        front, back = zip(*mapped(lambda towards: blockers.maps(towards, resolution), half), strict=True)
        return cls(directions=directions, maps=front + back)

    def seen(self, points: FloatArray, normals: FloatArray, two_sided: BoolArray) -> Sky:
        """What points (n, 3) with unit normals see of the sky.

        :param two_sided: (n,) whether to look at what the backs of the points see too; else nothing
        """
        seen = np.zeros((len(points), len(self.directions)), np.float16)

        def look(number: int) -> None:
            cosine = normals @ self.directions[number]
            facing = np.flatnonzero(np.where(two_sided, np.abs(cosine), cosine) > _FACING)
            outward = normals.take(facing, axis=0) * np.sign(cosine.take(facing))[:, None]
            lit = self.maps[number].lit(points.take(facing, axis=0), outward) if self.maps else 1.0
            seen[facing, number] = lit

        mapped(look, range(len(self.directions)))
        return Sky(directions=self.directions, seen=seen)


def visible_sky(
    points: FloatArray, normals: FloatArray, triangles: IntArray, two_sided: BoolArray, resolution: int
) -> Sky:
    """What points (n, 3) with unit normals see of the sky past triangles (t, 3), as `SkyMaps` has it."""
    return SkyMaps.of(points, triangles, resolution).seen(points, normals, two_sided)


def ambient_occlusion(points: FloatArray, normals: FloatArray, triangles: IntArray) -> FloatArray:
    """(n,) share of the sky that each point sees, 0..1, weighted by the cosine with its normal."""
    return visible_sky(points, normals, triangles, np.zeros(len(points), bool), SKY_RESOLUTION).share(normals)


def sphere_directions(count: int) -> FloatArray:
    """(count, 3) even directions, mirror-symmetric in X: a quarter of a Fibonacci sphere, its mirror image, and then
    the opposites of these.
    """
    number = np.arange(count // 4) + 0.5
    y = 1 - number / (count // 4)
    turn = (number * (np.sqrt(5) - 1) / 2 + _TURN) % 1.0 * np.pi  # longitudes of the half with x >= 0
    ring = np.sqrt(1 - y**2)
    quarter = np.stack([ring * np.sin(turn), y, ring * np.cos(turn)], axis=1)
    upper = np.concatenate([quarter, quarter * (-1, 1, 1)])
    return np.concatenate([upper, -upper])


def _spiral(turn: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Points spread evenly over the unit disc (Vogel 1979), turned by angles (n,): `_TAPS` x and y (n,)."""
    cosine, sine = np.cos(turn).astype(np.float32), np.sin(turn).astype(np.float32)
    for number in range(_TAPS):
        radius, angle = np.sqrt((number + 0.5) / _TAPS), number * _GOLDEN
        x, y = np.float32(radius * np.cos(angle)), np.float32(radius * np.sin(angle))
        yield x * cosine - y * sine, x * sine + y * cosine


def _windowed(step: int, radius: int, fraction: Float32Array, values: FloatArray | BoolArray) -> FloatArray | BoolArray:
    """Values in a box of 2 radius + 1 pixels, moved by a fraction of a pixel: its ends fade in and out."""
    if step == -radius:
        return (1 - fraction) * values
    return fraction * values if step == radius + 1 else values
