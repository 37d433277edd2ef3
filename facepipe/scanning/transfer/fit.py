"""A head's own mesh, and the template on it: identity modes, a smooth residual, and the rims of eyes and mouth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.geodesics import surface_graph
from facepipe.geometry.polygons import components, edges, point_normals, welded_points
from facepipe.geometry.similarity import Similarity
from facepipe.scanning.database import FaceDatabase
from facepipe.scanning.rebuild.declared import FitNeutralOptions
from facepipe.scanning.rebuild.fit_neutral import FitNeutralReport, fit_neutral
from facepipe.scanning.rebuild.template import Template
from facepipe.scans import Scan, ScanLandmarks

_SAME = 1e-6  # border points nearer than this share of the head's size are one
_USUAL = FitNeutralOptions()


@dataclass(frozen=True, kw_only=True)
class HeadMesh:
    """The mesh of a head in millimetres, and what connects its points.

    Points that lie on one another at borders are sewn, so that seams of UVs cut nothing: each of `points` stands for
    all of them.
    """

    points: FloatArray  # (s, 3) sewn
    triangles: IntArray  # (t, 3) of these, each with three points
    group: IntArray  # (m,) sewn point of every point of the head

    @classmethod
    def of(cls, points: FloatArray, triangles: IntArray) -> HeadMesh:
        """Points (m, 3), millimetres, and triangles (t, 3).

        :raises InputError: no triangle
        """
        if not len(triangles):
            raise InputError("head", "no triangles, expected a surface to put shapes on")
        pairs, uses = edges(np.full(len(triangles), 3), triangles.ravel())
        border = np.zeros(len(points), bool)
        border[pairs[uses == 1].ravel()] = True
        group = welded_points(points, border, _SAME * float(np.ptp(points[triangles.ravel()], axis=0).max()))
        first = np.unique(group, return_index=True)[1]
        sewn = group[triangles]
        return cls(points=points[first], triangles=sewn[(sewn != sewn[:, [1, 2, 0]]).all(axis=1)], group=group)

    @cached_property
    def normals(self) -> FloatArray:
        """(s, 3)."""
        return point_normals(self.points, self.triangles)

    @cached_property
    def graph(self) -> Any:
        """(s, s) lengths along the surface."""
        return surface_graph(self.points, np.pad(self.triangles, ((0, 0), (0, 1)), constant_values=-1))

    @cached_property
    def component(self) -> IntArray:
        """(s,) number of the connected piece of each."""
        return components(len(self.points), np.concatenate([self.triangles[:, :2], self.triangles[:, 1:]]))


@dataclass(frozen=True, kw_only=True)
class HeadFit:
    """The template on a head."""

    points: FloatArray  # (n, 3) whole points of the template, in its own place, millimetres
    place: Similarity  # from the head's coordinates to there
    head: HeadMesh  # there
    report: FitNeutralReport


def fit_head(
    template: Template,
    database: FaceDatabase,
    points: FloatArray,
    triangles: IntArray,
    landmarks: ScanLandmarks,
    options: FitNeutralOptions = _USUAL,
    name: str = "head",
    progress: Callable[[int], None] = lambda step: None,
) -> HeadFit:
    """Lay the template onto the head.

    :param database: who people may be, on the template's topology: `built_in_head.people` for the head in the box
    :param points: (m, 3) of the head, in any unit and place
    :param triangles: (t, 3) of them
    :param landmarks: in the head's coordinates
    :param name: of the head in errors and warnings
    :raises InputError: no triangles, too few landmarks or a mirrored head
    :raises FitError: a head that does not show a face
    """
    scan = Scan(name=name, points=np.asarray(points, np.float64), triangles=np.asarray(triangles, np.int32))
    neutral, place, report = fit_neutral(template, scan, landmarks, database, options, progress)
    head = HeadMesh.of(place.apply(scan.points), np.asarray(triangles, np.int64))
    return HeadFit(points=neutral.points, place=place, head=head, report=report)
