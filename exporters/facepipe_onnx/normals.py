"""Point normals as nodes: area-weighted over the triangles at each point, of the deformed points."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facepipe_onnx.nodes import Nodes

IntArray = npt.NDArray[np.integer]

_SMALLEST = 1e-18  # of a squared length: shorter sums stay as they are, and give (near) zero normals


def normal_nodes(nodes: Nodes, points: str, count: int, triangles: IntArray, batch: int) -> str:
    """Adds [batch, points, 3] `normals` of [batch, points, 3] points; (0, 1, 0) where a point has no triangle.

    :param triangles: (t, 3) point indices
    """
    corners = [nodes.gather(points, 1, triangles[:, i]) for i in range(3)]
    areas = _cross(nodes, nodes.add("Sub", corners[1], corners[0]), nodes.add("Sub", corners[2], corners[0]))
    summed = _sums(nodes, areas, count, triangles, batch)
    squares = nodes.add("MatMul", nodes.add("Mul", summed, summed), nodes.constant("sum_of_axes", np.ones((3, 1))))
    smallest = nodes.constant("smallest", np.array(_SMALLEST))
    return nodes.add("Div", summed, nodes.add("Sqrt", nodes.add("Clip", squares, smallest)), name="normals")


def _cross(nodes: Nodes, first: str, second: str) -> str:
    turned = [[nodes.gather(one, 2, axes) for axes in ((1, 2, 0), (2, 0, 1))] for one in (first, second)]
    ahead, behind = nodes.add("Mul", turned[0][0], turned[1][1]), nodes.add("Mul", turned[0][1], turned[1][0])
    return nodes.add("Sub", ahead, behind)


def _sums(nodes: Nodes, areas: str, count: int, triangles: IntArray, batch: int) -> str:
    """[batch, points, 3] sums over the triangles at each point; points of one number of triangles at a time."""
    around = np.argsort(triangles.ravel(), kind="stable") // 3  # triangles, point by point
    degree = np.bincount(triangles.ravel(), minlength=count)
    first = np.cumsum(degree) - degree
    pieces, order = [], []
    for size in np.unique(degree):
        members = np.flatnonzero(degree == size)
        order.append(members)
        if size == 0:
            up = np.tile([0.0, 1.0, 0.0], (batch, len(members), 1))
            pieces.append(nodes.constant("loose_normals", up))
            continue
        own = nodes.gather(areas, 1, around[first[members, None] + np.arange(size)].ravel())
        grouped = nodes.reshape(own, batch, len(members), int(size), 3)
        total = nodes.add("MatMul", nodes.constant(f"sum_{size}", np.ones((1, size))), grouped)
        pieces.append(nodes.reshape(total, batch, len(members), 3))
    position = np.argsort(np.concatenate(order), kind="stable")
    return nodes.gather(nodes.concat(pieces, 1), 1, position)
