"""The surface of a whole face in fewer triangles: the skin and all else each in their share of the budget."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy import sparse

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.threads import one_thread
from facepipe.geometry.polygons import components, edges, point_areas, welded_points
from facepipe.parts import FaceParts, Mesh
from facepipe.rig import Rig, mesh_spaces
from facepipe.verbs.lod.cards import apart, cards_of, widened, within
from facepipe.verbs.lod.simplifier import MOST_ATTRIBUTES, Simplifier
from facepipe.verbs.lod.wedges import mesh_of, wedges_of

_LEAST = 0.5  # of a mesh's share of the triangles that are not of the skin, where no materials meet on it
_HAIR = 0.7  # of its share of the triangles that are not of the skin: cards lie several deep
_WHOLE = 0.9  # power of the share of triangles that is the share of cards; those that stay lose the rest
_SAME = 1e-6  # border points nearer than this share of the face's size are one
_SPACING = 0.2  # of the size of a line, between points of it that stay: some 12 of a circle
_TURN = 0.2  # radians by which joints are taken to turn
_WEIGHT = 15.0  # of an error in motion against one in form: with more, low levels lose their form


class Surface:
    """The meshes of a face in wedges, one mesh after another."""

    def __init__(self, parts: FaceParts, rig: Rig) -> None:
        """:param rig: of these parts"""
        meshes, self._spaces = parts.meshes, mesh_spaces(parts)
        self._wedges = [wedges_of(mesh) for mesh in meshes]
        self._starts = np.cumsum([0, *(len(wedge.points) for wedge in self._wedges)])
        firsts = rig.mesh_offsets
        self._point = _joined(one.points + first for one, first in zip(self._wedges, firsts, strict=False))
        self._triangles = _joined(one.triangles + start for one, start in zip(self._wedges, self._starts, strict=False))
        self._marks = _joined(_marks_of(mesh) + first for mesh, first in zip(meshes, firsts, strict=False))
        self._rig = rig
        self._simplify = Simplifier()
        self._motion = _motion_of(rig, MOST_ATTRIBUTES)[self._point]
        rims = np.setdiff1d(self._rims(), self.triangles[self.is_skin])
        with_rims = np.isin(np.arange(len(meshes)), np.searchsorted(firsts, rims, side="right") - 1)
        self._least = np.where(with_rims, 1.0, _LEAST)  # by mesh
        hairs = self.triangles[self.cards >= 0]
        stay = np.setdiff1d(np.append(_strongest(rig), _even_points(rig.points, self.triangles, rims)), hairs)
        stay = np.append(stay, self._marks)
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

    @cached_property
    def cards(self) -> IntArray:
        """(t,) the card that each triangle is of, -1 for none."""
        mesh = np.where(self.is_skin, len(self._wedges), self._mesh(self._triangles))
        return np.where(self.is_skin, -1, cards_of(self._rig.points, self.triangles, mesh))

    def level(self, count: int, skin_share: float, above: IntArray) -> IntArray:
        """(t, 3) wedges of at most `count` triangles, or of what can be reached.

        :param skin_share: of the triangles that the skin gets, or more where all else needs fewer than the rest
        :param above: the level above, which a mesh that would have no triangle left takes its own from
        """
        skin, others = int(self.is_skin.sum()), int((~self.is_skin).sum())
        for_skin = min(skin, max(round(count * skin_share), count - others))
        pieces, left = [self._simplified(self.is_skin, for_skin)], min(count - for_skin, others)
        mesh, is_card = self._mesh(self._triangles), self.cards >= 0
        for number in np.unique(mesh[is_card]):
            own = is_card & (mesh == number)
            pieces.append(self._fewer_cards(own, int(_HAIR * left * own.sum() / others)))
        rest = ~self.is_skin & ~is_card
        left -= sum(map(len, pieces[1:]))
        return np.concatenate([*pieces, self._others(rest, left, above[~self._among(above, self.is_skin | is_card)])])

    def _fewer_cards(self, chosen: BoolArray, most: int) -> IntArray:
        """The cards of a mesh, some of them gone, the others with fewer triangles along them."""
        share = most / int(chosen.sum())
        if share >= 1:
            return np.asarray(self._triangles[chosen])
        order = apart(self._rig.points, self.triangles[chosen], self.cards[chosen])
        kept = order[: max(1, min(round(share**_WHOLE * len(order)), most // 2))]
        found = self._simplified(np.isin(self.cards, kept), most)
        return np.asarray(found[within(self._card_of(found), order, most)])

    def _card_of(self, level: IntArray) -> IntArray:
        """(t,) the card of triangles of a level, -1 for none."""
        card = np.full(self._starts[-1], -1)
        card[self._triangles] = self.cards[:, None]
        return np.asarray(card[level[:, 0]])

    def places(self, level: IntArray) -> FloatArray:
        """(n, 3) points of the rig at a level: those of cards farther apart, as these stand for those that are gone."""
        points, kept = self._rig.points, np.isin(self.cards, self._card_of(level)) & (self.cards >= 0)
        mesh = self._mesh(self._triangles)
        for number in np.unique(mesh[kept]):
            own, whole = (np.flatnonzero(one & (mesh == number)) for one in (kept, self.cards >= 0))
            share = len(np.unique(self.cards[own])) / len(np.unique(self.cards[whole]))
            points = widened(points, self.triangles[own], self.cards[own], share) if share < 1 else points
        return points

    def _others(self, chosen: BoolArray, most: int, above: IntArray) -> IntArray:
        """What is chosen, by errors; but each mesh has at least half of its share by triangles, eyes the whole."""
        mesh, single = self._mesh(self._triangles), list[IntArray]()
        sizes = np.bincount(mesh[chosen], minlength=len(self._wedges))
        least = np.ceil(self._least * most * sizes / max(sizes.sum(), 1)).astype(int).tolist()
        while True:
            simplified = self._simplified(chosen, most)
            short = np.flatnonzero(np.bincount(self._mesh(simplified), minlength=len(sizes)) < least)
            short = np.intersect1d(short, mesh[chosen])
            if not len(short):
                return np.concatenate([*single, simplified])
            for number in short:
                own = self._simplified(chosen & (mesh == number), least[number])
                single.append(own if len(own) else above[self._mesh(above) == number])
                most -= len(single[-1])
            chosen = chosen & ~np.isin(mesh, short)

    def _mesh(self, wedges: IntArray) -> IntArray:
        """(t,) number of the mesh of each triangle (t, 3) of wedges."""
        return np.searchsorted(self._starts, wedges[:, 0], side="right") - 1

    def _rims(self) -> IntArray:
        """Points where materials meet."""
        materials = _joined(wedge.materials for wedge in self._wedges)
        points, counts = np.unique(np.unique(np.stack([self._point, materials]), axis=1)[0], return_counts=True)
        return np.asarray(points[counts > 1])

    def skin_triangles(self, level: IntArray) -> int:
        """How many triangles of a level are of the skin."""
        return int(self._among(level, self.is_skin).sum())

    def _among(self, level: IntArray, chosen: BoolArray) -> BoolArray:
        """(t,) triangles of a level that are of the chosen pieces of the face."""
        return np.isin(level[:, 0], self._triangles[chosen])

    def points_of(self, level: IntArray) -> IntArray:
        """(t, 3) points of a level's wedges."""
        return np.asarray(self._point[level])

    def meshes(self, level: IntArray) -> tuple[Mesh, ...]:
        """Each mesh at a level; one without triangles as it is."""
        moved, result = self.places(level) - self._rig.points, []
        firsts = self._rig.mesh_offsets
        for number, wedges in enumerate(self._wedges):
            triangles = level[self._mesh(level) == number] - self._starts[number]
            mesh = mesh_of(wedges, triangles) if len(triangles) else wedges.mesh
            away = moved[firsts[number] : firsts[number + 1]]
            if len(triangles) and away.any():
                kept = np.unique(wedges.points[triangles])
                away = away[kept] @ np.linalg.inv(self._spaces[number])[:3, :3].T
                mesh = replace(mesh, points=mesh.points + away.astype(mesh.points.dtype))
            result.append(mesh)
        return tuple(result)

    def _simplified(self, chosen: BoolArray, most: int) -> IntArray:
        triangles = self._triangles[chosen]
        if most >= len(triangles):
            return np.asarray(triangles)
        return self._simplify(self._rig.points[self._point], self._motion, triangles, self._fixed, most)


def _joined(arrays: Iterable[IntArray]) -> IntArray:
    return np.concatenate(list(arrays))


def _marks_of(mesh: Mesh) -> IntArray:
    """Landmarks and anchor of a mesh."""
    anchor = [] if mesh.anchor is None else [mesh.anchor]
    return np.concatenate([*(one.indices for one in mesh.landmarks.values()), anchor]).astype(np.int64)


def _strongest(rig: Rig) -> IntArray:
    """The point that each sculpt moves most: no level lacks a shape."""
    moving = [target for target in rig.targets if len(target.offsets)]
    return np.array([one.point_indices[np.linalg.norm(one.offsets, axis=1).argmax()] for one in moving], np.int64)


def _even_points(points: FloatArray, triangles: IntArray, rims: IntArray) -> IntArray:
    """Some of the points on each line of `rims`, evenly: the rims of iris and pupil stay round.

    :param points: (n, 3)
    :param triangles: (t, 3)
    :param rims: (r,) ascending
    """
    pairs = edges(np.full(len(triangles), 3), triangles.ravel())[0]
    line = components(len(points), pairs[np.isin(pairs, rims).all(axis=1)])[rims]
    found = [rims[line == number][_apart(points[rims[line == number]])] for number in np.unique(line)]
    return np.concatenate([*found, np.zeros(0, np.int64)])


def _apart(points: FloatArray) -> list[int]:
    """Numbers of points (n, 3) that are some way apart, with none of all farther from every one of them."""
    chosen, away = list[int](), np.full(len(points), np.inf)
    while away.max() > _SPACING * np.ptp(points, axis=0).max():
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen


def _motion_of(rig: Rig, most: int) -> FloatArray:
    """(n, k) coordinates of each point, in the unit of the rig, k at most `most`.

    The principal components of the offsets of all sculpts and of the ways that joints move points, scaled so that
    squared differences are `_WEIGHT` squared times those of the offsets themselves, summed over all sculpts.
    """
    sculpts = [sparse.csr_array(rig.deltas[axis::3]) for axis in range(3)] if rig.targets else []
    columns = sparse.csr_array(sparse.hstack([*sculpts, _by_joints(rig)]))
    with one_thread():
        values, vectors = np.linalg.eigh((columns.T @ columns).toarray())
    _strongest = np.argsort(-values, kind="stable")[:most]
    return np.asarray(_WEIGHT * (columns @ vectors[:, _strongest]))


def _by_joints(rig: Rig) -> sparse.csr_array:
    """(n, j) how far a turn of each joint takes the points, on average over those that follow it, by their weights."""
    weights = sparse.csr_array(rig.influences[:, : len(rig.joints)])
    distances = np.zeros(len(rig.joints))
    for joint, inverse in enumerate(rig.inverse_bind):
        share = weights[:, [joint]].toarray().ravel()
        place = np.linalg.inv(inverse)[:3, 3]
        total = share.sum()
        if total > 0:
            distances[joint] = (share * np.linalg.norm(rig.points - place, axis=1)).sum() / total
    return sparse.csr_array(weights @ sparse.diags_array(_TURN * distances))
