"""Where the 68 landmarks of a posed face lie in a picture, with the face's outline found on its mesh.

Written apart from the fit, and unlike it: the fit slides contour landmarks along rows of points, here the whole mesh is
cut by a plane through each of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.geometry.polygons import edges, point_normals, point_triangles
from facepipe.parts import FaceParts, Mesh
from facepipe.pictures.camera import Camera

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

SCHEME = "multipie68"
CONTOUR = 17  # landmarks 0 to 16
FRONT = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class FaceLandmarks:
    """The landmarks of one Y-up face whose first mesh has them."""

    count: int  # points of that mesh
    points: IntArray  # (68,) labelled points
    triangles: IntArray  # (t, 3)
    edges: IntArray  # (e, 2) outside the ears
    outward: FloatArray  # (17, 3) unit directions across the contour, upright in the plane of the picture

    @classmethod
    def of(cls, parts: FaceParts) -> FaceLandmarks:
        """The first mesh's landmarks."""
        mesh = parts.meshes[0]
        points = np.asarray(mesh.landmarks[SCHEME].indices, dtype=np.int64)
        pairs, _ = edges(mesh.face_vertex_counts, mesh.face_vertex_indices)
        ears = np.asarray(mesh.regions["ears"]) > 0.5
        return cls(
            count=len(mesh.points),
            points=points,
            triangles=point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices),
            edges=pairs[~ears[pairs].any(axis=1)],
            outward=_across(mesh, points[:CONTOUR]),
        )

    def project(self, points: FloatArray, camera: Camera) -> FloatArray:
        """(68, 2) pixels of the landmarks of all meshes' posed points (n, 3).

        A contour landmark that the camera sees stays on its point. One that turns away lies where the outline of the
        face is: the mesh is cut by the plane through it that holds the face's front direction and the direction across
        the contour, and the outermost point of the cut that faces the camera, nearer to the front, is taken.
        """
        head = np.asarray(points[: self.count], dtype=np.float64)
        normals = point_normals(head, self.triangles)
        places = head[self.points]
        facing = np.einsum("kc,kc->k", normals[self.points], camera.eye - places) >= 0
        for number in np.flatnonzero(~facing[:CONTOUR]):
            places[number] = self._outline(number, head, normals, camera)
        return pixels(camera, places)

    def _outline(self, number: int, head: FloatArray, normals: FloatArray, camera: Camera) -> FloatArray:
        start, outward = head[self.points[number]], self.outward[number]
        cut, turned = _cut(head, normals, self.edges, (head - start) @ np.cross(FRONT, outward))
        seen = (np.einsum("mc,mc->m", turned, camera.eye - cut) >= 0) & (cut[:, 2] >= start[2])
        if not seen.any():
            return start
        a, b = pixels(camera, np.stack([start, start + 0.01 * outward]))
        reach = pixels(camera, cut[seen]) @ (b - a)
        return np.asarray(cut[seen][reach.argmax()])


def pixels(camera: Camera, points: FloatArray) -> FloatArray:
    """(k, 2) pixel positions of world points (k, 3)."""
    screen = camera.project(points)
    return np.asarray(screen[:, :2] / screen[:, 3:])


def _cut(head: FloatArray, normals: FloatArray, pairs: IntArray, side: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points and normals (m, 3) where edges pass from one side of a plane to the other; `side` (n,) is signed."""
    crossing = pairs[(side[pairs[:, 0]] < 0) != (side[pairs[:, 1]] < 0)]
    near, far = side[crossing].T
    share = (near / (near - far))[:, None]
    a, b = crossing.T
    return head[a] + share * (head[b] - head[a]), normals[a] + share * (normals[b] - normals[a])


def _across(mesh: Mesh, contour: IntArray) -> FloatArray:
    """(17, 3) unit directions across the contour of a neutral face seen from the front, away from its middle."""
    line = np.asarray(mesh.points, dtype=np.float64)[contour, :2]
    along = np.gradient(line, axis=0)
    across = np.stack([along[:, 1], -along[:, 0], np.zeros(len(line))], axis=1)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    outer = ((line - line.mean(axis=0)) * across[:, :2]).sum(axis=1) >= 0
    return np.where(outer[:, None], across, -across)
