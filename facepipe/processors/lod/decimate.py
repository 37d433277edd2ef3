"""The surface of a whole face in fewer triangles: the skin and all else each in their share of the budget."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property

import numpy as np

from facepipe.core.arrays import BoolArray, IntArray
from facepipe.geometry.polygons import components, edges, point_areas
from facepipe.geometry.seams import welded_points
from facepipe.parts import Mesh
from facepipe.processors.lod.kept_points import even_points, marks, strongest
from facepipe.processors.lod.motion import motion_of
from facepipe.processors.lod.simplifier import MOST_ATTRIBUTES, Simplifier
from facepipe.processors.lod.wedges import mesh_of, wedges_of
from facepipe.rig import Rig

_LEAST = 0.5  # of a mesh's share of the triangles that are not of the skin, where no materials meet on it
_SAME = 1e-6  # border points nearer than this share of the face's size are one


class Surface:
    """The meshes of a face in wedges, one mesh after another."""

    def __init__(self, meshes: Sequence[Mesh], rig: Rig) -> None:
        """:param rig: of these meshes"""
        self._wedges = [wedges_of(mesh) for mesh in meshes]
        self._starts = np.cumsum([0, *(len(one.points) for one in self._wedges)])
        firsts = rig.mesh_offsets
        self._point = _joined(one.points + first for one, first in zip(self._wedges, firsts, strict=False))
        self._triangles = _joined(one.triangles + start for one, start in zip(self._wedges, self._starts, strict=False))
        self._marks = _joined(marks(mesh) + first for mesh, first in zip(meshes, firsts, strict=False))
        self._rig = rig
        self._simplify = Simplifier()
        self._motion = motion_of(rig, MOST_ATTRIBUTES)[self._point]
        rims = np.setdiff1d(self._rims(), self.triangles[self.is_skin])
        with_rims = np.isin(np.arange(len(meshes)), np.searchsorted(firsts, rims, side="right") - 1)
        self._least = np.where(with_rims, 1.0, _LEAST)  # by mesh
        stay = np.concatenate([self._marks, strongest(rig), even_points(rig.points, self.triangles, rims)])
        self._fixed = np.isin(self._point, stay)

    @property
    def full(self) -> IntArray:
        """(t, 3) wedges of the full face's triangles."""
        return self._triangles

    @property
    def triangles(self) -> IntArray:
        """(t, 3) points of the same."""
        return self.points_of(self._triangles)

    @cached_property
    def is_skin(self) -> BoolArray:
        """(t,) triangles of the connected part that has most landmarks; without landmarks, of the largest."""
        points, triangles = self._rig.points, self.triangles
        pairs, uses = edges(np.full(len(triangles), 3), triangles.ravel())
        border = np.isin(np.arange(len(points)), pairs[uses == 1])
        sewn = welded_points(points, border, _SAME * float(np.ptp(points, axis=0).max()))
        part = components(len(points), sewn[pairs])[sewn]
        areas = point_areas(points, triangles)
        sizes = np.bincount(part[self._marks]) if len(self._marks) else np.bincount(part, areas)
        return np.asarray(part[triangles[:, 0]] == sizes.argmax())

    def level(self, count: int, skin_share: float, above: IntArray) -> IntArray:
        """(t, 3) wedges of at most `count` triangles, or of what can be reached.

        :param skin_share: of the triangles that the skin gets, or more where all else needs fewer than the rest
        :param above: the level above, which a mesh that would have no triangle left takes its own from
        """
        skin, others = int(self.is_skin.sum()), int((~self.is_skin).sum())
        for_skin = min(skin, max(round(count * skin_share), count - others))
        of_skin = self._simplified(self.is_skin, for_skin)
        return np.concatenate([of_skin, self._others(min(count - for_skin, others), above[~self._on_skin(above)])])

    def _others(self, most: int, above: IntArray) -> IntArray:
        """What is not skin, by errors; but each mesh has at least half of its share by triangles, eyes the whole."""
        mesh, chosen, apart = self._mesh(self._triangles), ~self.is_skin, list[IntArray]()
        sizes = np.bincount(mesh[chosen], minlength=len(self._wedges))
        least = np.ceil(self._least * most * sizes / max(sizes.sum(), 1)).astype(int).tolist()
        while True:
            found = self._simplified(chosen, most)
            short = np.flatnonzero(np.bincount(self._mesh(found), minlength=len(sizes)) < least)
            short = np.intersect1d(short, mesh[chosen])
            if not len(short):
                return np.concatenate([*apart, found])
            for number in short:
                own = self._simplified(chosen & (mesh == number), least[number])
                apart.append(own if len(own) else above[self._mesh(above) == number])
                most -= len(apart[-1])
            chosen &= ~np.isin(mesh, short)

    def _mesh(self, wedges: IntArray) -> IntArray:
        """(t,) number of the mesh of each triangle (t, 3) of wedges."""
        return np.searchsorted(self._starts, wedges[:, 0], side="right") - 1

    def _rims(self) -> IntArray:
        """Points where materials meet."""
        materials = _joined(one.materials for one in self._wedges)
        points, counts = np.unique(np.unique(np.stack([self._point, materials]), axis=1)[0], return_counts=True)
        return np.asarray(points[counts > 1])

    def skin_triangles(self, level: IntArray) -> int:
        """How many triangles of a level are of the skin."""
        return int(self._on_skin(level).sum())

    def _on_skin(self, level: IntArray) -> BoolArray:
        return np.isin(level[:, 0], self._triangles[self.is_skin])

    def points_of(self, level: IntArray) -> IntArray:
        """(t, 3) points of a level's wedges."""
        return np.asarray(self._point[level])

    def meshes(self, level: IntArray) -> tuple[Mesh, ...]:
        """Each mesh at a level; one without triangles as it is."""
        own = [level[self._mesh(level) == i] - self._starts[i] for i in range(len(self._wedges))]
        return tuple(mesh_of(one, rows) if len(rows) else one.mesh for one, rows in zip(self._wedges, own, strict=True))

    def _simplified(self, chosen: BoolArray, most: int) -> IntArray:
        triangles = self._triangles[chosen]
        if most >= len(triangles):
            return np.asarray(triangles)
        return self._simplify(self._rig.points[self._point], self._motion, triangles, self._fixed, most)


def _joined(arrays: Iterable[IntArray]) -> IntArray:
    return np.concatenate(list(arrays))
