"""A face whose teeth and eyeballs are held against its skin."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from facepipe.geometry.polygons import point_triangles
from facepipe.parts import FaceParts
from facepipe.rig.build_rig import build
from facepipe.rig.rig import Rig

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


class Subject:
    """A face in millimetres with its meshes in one index space: Head, Teeth, EyeballLeft, EyeballRight.

    :param shapes: those that count; None: all
    """

    def __init__(self, parts: FaceParts, shapes: tuple[str, ...] | None = None) -> None:
        self._rig: Rig = build(parts)
        self._scale = 1000.0 * parts.meters_per_unit
        starts = np.cumsum([0, *(len(mesh.points) for mesh in parts.meshes)])
        self._meshes = {mesh.name: (mesh, int(start)) for mesh, start in zip(parts.meshes, starts, strict=False)}
        self.shapes: tuple[str, ...] = shapes or tuple(self._rig.shapes)
        self.neutral = self.points({})

    def points(self, weights: Mapping[str, float]) -> FloatArray:
        """(n, 3) mm of weights of shapes."""
        return np.asarray(self._rig.evaluate(weights) * self._scale)

    def triangles(self, name: str) -> IntArray:
        """(t, 3) of a mesh."""
        mesh, start = self._meshes[name]
        return point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices).astype(np.int64) + start
