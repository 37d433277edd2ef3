"""Chooses the points of the scheme ``dense``: `python samples/head/dense_points.py`.

Farthest points of the face, of both sides alike, beside the inner landmarks: the nearer to lids, nostrils and lips, the
closer together. Writes `dense.json` here, which `build.py` copies; the networks of `training/` know these very points.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.heads.asset import asset

_COUNT = 255  # with the 51 inner landmarks
_FACE = 9409  # points of ICT-FaceKit's face, which come first
_LOW, _HIGH, _BACK, _TURNED = -9.5, 12.0, 2.5, -0.2  # cm, and z of normals: limits of the front
_APART, _GROWING = 0.32, 0.30  # cm between points on lids and lips, and how much more a centimetre away


def chosen() -> list[int]:
    """The points, without the landmarks."""
    head = asset()
    points = head.points[: head.parts["Head"].points.stop]
    normals = point_normals(head.points, point_triangles(head.counts, head.indices))[: len(points)]
    mirror = cKDTree(points).query(points * [-1, 1, 1])[1]
    _, y, z = points.T
    front = (np.arange(len(points)) < _FACE) & (y > _LOW) & (y < _HIGH) & (z > _BACK) & (normals[:, 2] > _TURNED)
    fine = points[np.concatenate([head.landmarks[36:68], head.landmarks[30:36]])]
    apart = _APART + _GROWING * cKDTree(fine).query(points)[0]
    inner = head.landmarks[17:].tolist()
    found = list(dict.fromkeys([*inner, *mirror[inner].tolist()]))
    off = cKDTree(points[found]).query(points)[0]
    while len(found) < _COUNT:
        best = int(np.where(front, off / apart, -1.0).argmax())
        for point in {best, int(mirror[best])}:
            found.append(point)
            off = np.minimum(off, np.linalg.norm(points - points[point], axis=1))
    return found[len(inner) :]


if __name__ == "__main__":
    Path(__file__).with_name("dense.json").write_text(json.dumps(chosen()) + "\n")
