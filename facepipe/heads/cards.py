"""Brows, lashes and hair: cards with the pictures of hairs, held by the skin under them.

`samples/head/cards.py` makes them of the average head. Here they follow a person, and what moves that person's skin.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.spatial import cKDTree

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.heads.asset import STEP, arrays
from facepipe.parts import Blendshape, Inbetween, Mesh, Skin, UvSet

_STILL = 2e-3  # cm: smaller moves are none
_FAR = 0.3  # cm: cards that turn further beside what holds them may dip into other skin
_HANGING = 4.0  # cm off what holds it, where hair hangs
_CLEAR = 0.04  # cm that each row of a card stays farther off the skin than the one before


@dataclass(frozen=True, kw_only=True)
class Cards:
    """A set of cards: n points."""

    grid: tuple[int, int, int]  # cards, rows, columns of points
    corners: IntArray  # (n, 3) points of Head
    shares: FloatArray  # (n, 3) barycentric
    offsets: FloatArray  # (n, 3) from there, cm
    uv: FloatArray  # (n, 2)
    motion: Mapping[str, FloatArray]  # shape -> (n, 3) how it moves cards beside what holds them

    def carry(self, values: FloatArray) -> FloatArray:
        """(n, ...) values of the head (points, ...) where the cards hold on."""
        return np.asarray(np.einsum("nk,nk...->n...", self.shares, values[self.corners]))


@cache
def cards(name: str) -> Cards:
    """A set by name: brows, lashes, or a style of hair."""
    data = {key.removeprefix(f"{name}_"): value for key, value in arrays("cards").items() if key.startswith(f"{name}_")}
    first_two = data.pop("shares") / 255
    rows, columns, count = data.pop("grid")
    return Cards(
        grid=(int(rows), int(columns), int(count)),
        corners=data.pop("corners").astype(np.int64),
        shares=np.column_stack([first_two, 1 - first_two.sum(axis=1)]),
        offsets=data.pop("offsets") * STEP,
        uv=data.pop("uv") / 65535,
        motion={shape: offsets * STEP for shape, offsets in data.items()},
    )


def mesh(name: str, held: Cards, head: Mesh, region: str) -> Mesh:
    """Cards on a head, moved by its shapes and joints, all in one region, with the material of their name."""
    counts, indices = _faces(held.grid)
    triangles = point_triangles(head.face_vertex_counts, head.face_vertex_indices)
    shapes = (_shape(held, shape, head.points, triangles) for shape in head.blendshapes)
    zeros = np.zeros(len(held.uv))
    return Mesh(
        name=name,
        points=held.carry(head.points) + held.offsets,
        face_vertex_counts=counts,
        face_vertex_indices=indices,
        normals=_normals(held, head.points, triangles),
        uv_sets=(UvSet(values=held.uv),),
        skin=None if head.skin is None else _skin(held, head.skin),
        blendshapes=tuple(shape for shape in shapes if shape is not None),
        regions={one: zeros + (one == region) for one in head.regions},
        material=name,
        double_sided=True,
    )


def _normals(held: Cards, skin: FloatArray, triangles: IntArray) -> FloatArray:
    """(n, 3) those of the skin where cards lie on it, level and outwards where they hang."""
    outwards = (held.carry(skin) + held.offsets - skin.mean(axis=0)) * [1, 0, 1]
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    lying = np.exp(-((np.linalg.norm(held.offsets, axis=1, keepdims=True) / _HANGING) ** 2))
    normals = outwards + lying * (held.carry(point_normals(skin, triangles)) - outwards)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _faces(grid: tuple[int, int, int]) -> tuple[IntArray, IntArray]:
    points = np.arange(np.prod(grid)).reshape(grid)
    quads = [points[:, :-1, :-1], points[:, :-1, 1:], points[:, 1:, 1:], points[:, 1:, :-1]]
    indices = np.stack(quads, axis=-1).reshape(-1, 4)
    return np.full(len(indices), 4, np.int32), indices.ravel().astype(np.int32)


def _shape(held: Cards, shape: Blendshape, skin: FloatArray, triangles: IntArray) -> Blendshape | None:
    """How cards on skin (n, 3) move with a shape."""
    motion = held.motion.get(shape.name, np.zeros((1, 3)))

    def offsets(values: FloatArray, weight: float) -> FloatArray:
        whole = np.zeros_like(skin)
        whole[shape.point_indices] = values
        moved = held.carry(whole) + weight * motion
        if np.abs(motion).max() < _FAR:
            return moved
        lift = _lift(held, held.carry(skin) + held.offsets + moved, skin + whole, triangles)
        return moved + np.where(np.abs(moved).max(axis=1, keepdims=True) > _STILL, lift, 0.0)

    moves = {inbetween.weight: offsets(inbetween.offsets, inbetween.weight) for inbetween in shape.inbetweens}
    full = offsets(shape.offsets, 1.0)
    moved = np.flatnonzero(np.max([np.abs(move).max(axis=1) for move in (full, *moves.values())], axis=0) > _STILL)
    if not len(moved):
        return None
    inbetweens = (
        Inbetween(name=inbetween.name, weight=inbetween.weight, offsets=moves[inbetween.weight][moved])
        for inbetween in shape.inbetweens
    )
    indices, between = moved.astype(np.int32), tuple(inbetweens)
    return replace(shape, point_indices=indices, offsets=full[moved], normal_offsets=None, inbetweens=between)


def _lift(held: Cards, points: FloatArray, skin: FloatArray, triangles: IntArray) -> FloatArray:
    """(n, 3) what takes cards that dip into the skin out of it."""
    low, high = points.min(axis=0), points.max(axis=0)
    near = np.flatnonzero(((skin > low) & (skin < high)).all(axis=1))
    closest = near[cKDTree(skin[near]).query(points)[1]]
    normals = point_normals(skin, triangles)[closest]
    height = np.einsum("nc,nc->n", points - skin[closest], normals)
    rows = np.broadcast_to(np.arange(held.grid[1])[:, None], held.grid).ravel()
    return np.asarray(np.where(rows > 0, np.maximum(_CLEAR * rows - height, 0.0), 0.0)[:, None] * normals)


def _skin(held: Cards, skin: Skin) -> Skin:
    """The strongest four of the influences of what holds each point."""
    joints = skin.joint_indices[held.corners].reshape(len(held.shares), -1)
    weights = (skin.joint_weights[held.corners] * held.shares[..., None]).reshape(joints.shape)
    dense = np.zeros((len(joints), int(skin.joint_indices.max()) + 1))
    np.add.at(dense, (np.arange(len(joints))[:, None], joints), weights)
    strongest = np.argsort(-dense, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(dense, strongest, axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    return replace(skin, joint_indices=np.where(weights > 0, strongest, 0).astype(np.int32), joint_weights=weights)
