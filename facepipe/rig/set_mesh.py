"""A mesh with a person as its rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.parts import Blendshape, Inbetween, Mesh
from facepipe.rig.activation import curves
from facepipe.rig.build_rig import inverse

_KNOTS_APART = 1e-6  # of weights: nearer knots are one


def set_mesh(mesh: Mesh, weights: Mapping[str, float], moved: FloatArray | None) -> Mesh:
    """The mesh under shape weights and then affine matrices, its shapes on top.

    :param weights: of the person, by shape
    :param moved: (n, 3, 4) matrices of the points in skeleton space at bind time; None leaves points where shapes take
        them
    :raises TopologyError: a singular bind transform
    """
    points = np.array(mesh.points, dtype=np.float64)
    for shape in mesh.blendshapes:
        if weights.get(shape.name):
            offsets = [sculpt.offsets for _, _, sculpt in shape.sculpts]
            points[shape.point_indices] += _blended(shape, weights[shape.name], offsets)
    linear = None
    if moved is not None and mesh.skin is not None:
        space = np.asarray(mesh.skin.geom_bind_transform, dtype=np.float64)
        back = inverse(space, f"{mesh.name} -> geomBindTransform")
        whole = np.zeros((len(points), 4, 4))
        whole[:, :3], whole[:, 3, 3] = moved, 1.0
        # points and offsets lie before geomBindTransform B, the matrices M after it: B^-1 M B
        whole = back @ whole @ space
        linear = whole[:, :3, :3]
        points = np.einsum("nij,nj->ni", linear, points) + whole[:, :3, 3]
    if np.array_equal(points, mesh.points) and linear is None:
        return mesh
    turn = _normal_turn(mesh, points, linear)
    shapes = tuple(_on_top(shape, weights.get(shape.name, 0.0), linear, turn) for shape in mesh.blendshapes)
    return replace(mesh, points=points.astype(np.float32), normals=_normals(mesh, turn), blendshapes=shapes)


def _blended(shape: Blendshape, weight: float, sculpts: list[FloatArray]) -> FloatArray:
    """(k, 3) what a weight of the shape adds, through its inbetweens; `sculpts` as of `Blendshape.sculpts`."""
    by_weight = curves(tuple(inbetween.weight for inbetween in shape.inbetweens))
    amounts = [float(by_weight[at](weight)) for _, at, _ in shape.sculpts]
    total: FloatArray = np.zeros(np.shape(sculpts[0]))
    for amount, sculpt in zip(amounts, sculpts, strict=True):
        total = total + amount * np.asarray(sculpt, dtype=np.float64)
    return total


def _on_top(shape: Blendshape, weight: float, linear: FloatArray | None, turn: FloatArray) -> Blendshape:
    """The shape as what it adds to the person, who has `weight` of it already."""
    shape = _from(shape, weight)
    rows = np.asarray(shape.point_indices, dtype=np.int64)

    def moved(offsets: FloatArray) -> FloatArray:
        return np.asarray(offsets if linear is None else np.einsum("nij,nj->ni", linear[rows], offsets))

    return shape.changed(moved, lambda offsets: np.asarray(np.einsum("nij,nj->ni", turn[rows], offsets)))


def _from(shape: Blendshape, start: float) -> Blendshape:
    """The shape whose weight 0 is `start` of the old one: the same piecewise-linear way of its points from there."""
    if not start or not shape.inbetweens:
        return shape
    positions = [sculpt.offsets for _, _, sculpt in shape.sculpts]
    normals = [sculpt.normal_offsets for _, _, sculpt in shape.sculpts]
    known = [normal for normal in normals if normal is not None]
    filled = [np.zeros(np.shape(shape.offsets)) if normal is None else normal for normal in normals]

    def at(weight: float) -> tuple[FloatArray, FloatArray | None]:
        ends = [
            _blended(shape, start + weight, sculpts) - _blended(shape, start, sculpts)
            for sculpts in (positions, filled)
        ]
        return ends[0], ends[1] if known else None

    # the old 0 and 1 are knots as well: pieces end there, and the outermost ones go on beyond with the slope they have
    knots = sorted({0.0 - start, 1.0 - start, *(inbetween.weight - start for inbetween in shape.inbetweens)})
    knots = [knot for knot in knots if min(abs(knot), abs(knot - 1.0)) > _KNOTS_APART]
    names = {0.0 - start: "neutral", 1.0 - start: "full"}
    names |= {inbetween.weight - start: inbetween.name for inbetween in shape.inbetweens}
    inbetweens = []
    for knot in knots:
        offsets, normal_offsets = at(knot)
        inbetweens.append(Inbetween(name=names[knot], weight=knot, offsets=offsets, normal_offsets=normal_offsets))
    offsets, normal_offsets = at(1.0)
    return replace(shape, offsets=offsets, normal_offsets=normal_offsets, inbetweens=tuple(inbetweens))


def _normal_turn(mesh: Mesh, points: FloatArray, linear: FloatArray | None) -> FloatArray:
    """(n, 3, 3) what takes normals along: the cofactor of `linear`, then the turn that the surface makes beside it."""
    triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    before, after = point_normals(mesh.points, triangles), point_normals(points, triangles)
    cofactor = np.tile(np.eye(3), (len(points), 1, 1)) if linear is None else _cofactors(linear)
    carried = np.einsum("nij,nj->ni", cofactor, before)
    length = np.linalg.norm(carried, axis=1, keepdims=True)
    carried /= np.where(length == 0, 1.0, length)
    sign = np.where(np.linalg.det(cofactor) < 0, -1.0, 1.0)  # a mirrored surface is wound the other way
    size = np.where(length == 0, 1.0, length)[:, :, None]
    return np.asarray(_rotations(carried, after * sign[:, None]) @ (cofactor / size))


def _cofactors(linear: FloatArray) -> FloatArray:
    rows = [np.cross(linear[:, (i + 1) % 3], linear[:, (i + 2) % 3]) for i in range(3)]
    return np.stack(rows, axis=1)


def _rotations(start: FloatArray, end: FloatArray) -> FloatArray:
    """(n, 3, 3) the smallest rotation from each unit vector (n, 3) to another; none where they are opposed."""
    axis = np.cross(start, end)
    cosine = np.einsum("ni,ni->n", start, end)
    K = np.zeros((len(axis), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    K -= np.swapaxes(K, 1, 2)
    opposed = cosine < -1 + 1e-6
    factor = np.where(opposed, 0.0, 1 / np.where(opposed, 1.0, 1 + cosine))
    K[opposed] = 0.0
    return np.eye(3) + K + factor[:, None, None] * (K @ K)  # Rodrigues: sin = |axis|, (1 - cos) / sin^2 = 1 / (1 + cos)


def _normals(mesh: Mesh, turn: FloatArray) -> FloatArray | None:
    if mesh.normals is None:
        return None
    normals = np.asarray(mesh.normals, dtype=np.float64)
    per_point = len(normals) == len(turn)
    rows = np.arange(len(turn)) if per_point else np.asarray(mesh.face_vertex_indices, dtype=np.int64)
    turned = np.einsum("nij,nj->ni", turn[rows], normals)
    length = np.linalg.norm(turned, axis=1, keepdims=True)
    return np.asarray(turned / np.where(length == 0, 1.0, length))
