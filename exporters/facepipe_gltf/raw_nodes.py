"""Nodes of a raw document: their tree and their world matrices at rest."""

from __future__ import annotations

from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.rig.trs import rotation_matrices
from facepipe_gltf.raw import Json, RawDocument, is_index


def children(node: Json) -> list[int]:
    """Indices that a node names as its children."""
    found = node.get("children")
    return [one for one in found if is_index(one)] if isinstance(found, list) else []


def parents(document: RawDocument) -> dict[int, list[int]]:
    """Every node that is a child -> the nodes that name it."""
    found: dict[int, list[int]] = {}
    for i, node in enumerate(document.items("nodes")):
        for child in children(node):
            found.setdefault(child, []).append(i)
    return found


def local_matrix(node: Json) -> FloatArray:
    """(4, 4) matrix of a node, column vectors; identity for what is no number."""
    matrix = _numbers(node.get("matrix"), 16)
    if matrix is not None:
        return np.asarray(matrix.reshape(4, 4).T)
    result = np.eye(4)
    rotation, scale = _numbers(node.get("rotation"), 4), _numbers(node.get("scale"), 3)
    if rotation is not None and rotation.any():
        result[:3, :3] = rotation_matrices(rotation)
    if scale is not None:
        result[:3, :3] *= scale
    translation = _numbers(node.get("translation"), 3)
    if translation is not None:
        result[:3, 3] = translation
    return result


def _numbers(value: Any, count: int) -> FloatArray | None:
    if not isinstance(value, list) or len(value) != count:
        return None
    if not all(isinstance(one, int | float) and abs(one) < 1e30 for one in value):
        return None
    return np.array(value, dtype=np.float64)


def world_matrix(document: RawDocument, node: int, above: dict[int, list[int]]) -> FloatArray:
    """(4, 4) world matrix of a node at rest; a cycle ends where it closes."""
    result, seen = np.eye(4), set[int]()
    current: int | None = node
    while current is not None and current not in seen:
        seen.add(current)
        result = local_matrix(document.item("nodes", current) or {}) @ result
        current = above[current][0] if current in above else None
    return np.asarray(result)
