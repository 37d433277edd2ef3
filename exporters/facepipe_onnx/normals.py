"""Point normals as nodes: area-weighted over the triangles at each point, of the deformed points."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import IntArray
from facepipe.onnx_graph import Nodes

_SMALLEST = 1e-18  # of a squared length: shorter sums stay as they are, and give (near) zero normals


def normal_nodes(nodes: Nodes, points: str, count: int, triangles: IntArray, batch: int) -> str:
    """Adds [batch, points, 3] `normals` of [batch, points, 3] points; (0, 1, 0) where a point has no triangle.

    :param triangles: (t, 3) point indices
    """
    degree = np.bincount(triangles.ravel(), minlength=count)
    pieces = []
    if len(triangles):
        corners = [nodes.gather(points, 1, triangles[:, i]) for i in range(3)]
        areas = _cross(nodes, nodes.add("Sub", corners[1], corners[0]), nodes.add("Sub", corners[2], corners[0]))
        pieces.append(_units(nodes, nodes.concat(_sums(nodes, areas, degree, triangles, batch), 1)))
    if not degree.all():
        up = np.tile([0.0, 1.0, 0.0], (batch, int(np.count_nonzero(degree == 0)), 1))
        pieces.append(nodes.constant("loose_normals", up))  # not scaled: some runtimes' roots of 1 are not 1
    order = np.argsort(np.where(degree == 0, len(triangles) * 3 + 1, degree), kind="stable")
    position = nodes.indices(np.argsort(order, kind="stable"))
    return nodes.add("Gather", nodes.concat(pieces, 1), position, axis=1, name="normals")


def _units(nodes: Nodes, vectors: str) -> str:
    squares = nodes.add("MatMul", nodes.add("Mul", vectors, vectors), nodes.constant("sum_of_axes", np.ones((3, 1))))
    smallest = nodes.constant("smallest", np.array(_SMALLEST))
    return nodes.add("Div", vectors, nodes.add("Sqrt", nodes.add("Clip", squares, smallest)))


def _cross(nodes: Nodes, first: str, second: str) -> str:
    turned = [[nodes.gather(one, 2, axes) for axes in ((1, 2, 0), (2, 0, 1))] for one in (first, second)]
    ahead, behind = nodes.add("Mul", turned[0][0], turned[1][1]), nodes.add("Mul", turned[0][1], turned[1][0])
    return nodes.add("Sub", ahead, behind)


def _sums(nodes: Nodes, areas: str, degree: IntArray, triangles: IntArray, batch: int) -> list[str]:
    """[batch, points, 3] sums over the triangles at each point that has some; points of one number of them at a time.

    :param degree: (n,) triangles at each point
    """
    around = np.argsort(triangles.ravel(), kind="stable") // 3  # triangles, point by point
    first = np.cumsum(degree) - degree
    pieces = []
    for size in np.unique(degree[degree > 0]):
        members = np.flatnonzero(degree == size)
        own = nodes.gather(areas, 1, around[first[members, None] + np.arange(size)].ravel())
        grouped = nodes.reshape(own, batch, len(members), int(size), 3)
        total = nodes.add("MatMul", nodes.constant(f"sum_{size}", np.ones((1, size))), grouped)
        pieces.append(nodes.reshape(total, batch, len(members), 3))
    return pieces
