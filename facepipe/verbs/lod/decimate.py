"""The surface of a face in fewer triangles: wedges, cards of hairs, meshoptimizer's simplifier, each part's share."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.threads import one_thread
from facepipe.core.webassembly import Program, Run
from facepipe.geometry.polygons import components, edges, merge_points, point_areas, triangulate, welded_points
from facepipe.parts import Blendshape, FaceParts, MaterialFaces, Mesh
from facepipe.rig import Rig, mesh_spaces

_NORMAL_STEPS = 64  # of -1 to 1: corners whose normals differ less are no crease
_FEWEST = 16  # cards of a mesh that are taken as such
_BORDER = 0.5  # share of a card's points that lie on its border, or more
_WIDEST = 3.0  # times as wide as it was
_STANDS_IN = 0.75  # power of the share of cards that stay by which they are wider: they lie several deep
MOST_ATTRIBUTES = 32  # that the module takes
_MODULE = Path(__file__).with_name("meshopt_simplifier.wasm")
_ALIGNMENT = 16
_ANY_ERROR = 1e30
_LEAST = 0.5  # of a mesh's share of the triangles that are not of the skin, where no materials meet on it
_HAIR = 1.5  # times that a triangle of a card counts among those that are not of the skin: hair is seen before teeth
# Power of the share of triangles that is the share of cards; those that stay lose the rest. At 0.9, and half as many
# triangles, a bob at 2,500 had nine cards, and bare scalp between them; pictures differed by 1.7 times as much.
_WHOLE = 0.6
_SAME = 1e-6  # border points nearer than this share of the face's size are one
_SPACING = 0.2  # of the size of a line, between points of it that stay: some 12 of a circle
_TURN = 0.2  # radians by which joints are taken to turn
_TOGETHER = 1024  # points whose offsets are dense at a time
_WEIGHT = 15.0  # of an error in motion against one in form: with more, low levels lose their form


@dataclass(frozen=True, kw_only=True)
class Wedges:
    """A mesh in wedges."""

    mesh: Mesh
    points: IntArray  # (w,) point of each
    corners: IntArray  # (w,) a corner of the mesh that is this wedge
    materials: IntArray  # (w,) place in `Mesh.material_faces`, -1 for none
    triangles: IntArray  # (t, 3) wedges


def wedges_of(mesh: Mesh) -> Wedges:
    """The wedges of a mesh, in the order of their points; polygons are fans of triangles."""
    material = np.full(len(mesh.face_vertex_counts), -1)
    for number, one in enumerate(mesh.material_faces):
        material[one.faces] = number
    materials = np.repeat(material, mesh.face_vertex_counts)
    columns = [np.asarray(mesh.face_vertex_indices, np.int64), materials]
    columns += [_same(uv.values[uv.indices]) for uv in mesh.uv_sets if uv.indices is not None]
    if _by_corner(mesh):
        columns.append(_same(np.round(np.asarray(mesh.normals) * _NORMAL_STEPS)))
    rows, corners, inverse = np.unique(np.stack(columns, axis=1), axis=0, return_index=True, return_inverse=True)
    triangles = inverse.ravel()[triangulate(mesh.face_vertex_counts).corners]
    return Wedges(mesh=mesh, points=rows[:, 0], corners=corners, materials=rows[:, 1], triangles=triangles)


def _same(values: FloatArray) -> IntArray:
    """(n,) a number for each row of (n, c) values, the same for the same values."""
    return np.asarray(np.unique(values, axis=0, return_inverse=True)[1]).ravel()


def _by_corner(mesh: Mesh) -> bool:
    return mesh.normals is not None and len(mesh.normals) != len(mesh.points)


def mesh_of(wedges: Wedges, triangles: IntArray) -> Mesh:
    """The mesh with `triangles` (t, 3) of its wedges alone, and the points that these or landmarks and anchor use.

    All that the points that stay have is as it was.
    """
    mesh = wedges.mesh
    marked = [one.indices for one in mesh.landmarks.values()] + ([[mesh.anchor]] if mesh.anchor is not None else [])
    kept = np.unique(np.concatenate([wedges.points[triangles].ravel(), *marked]).astype(np.int64))
    place = np.full(len(mesh.points), -1)
    place[kept] = np.arange(len(kept))
    # corners of a wedge share UVs, and normals but for less than a crease: one of them speaks for all
    corners = wedges.corners[triangles].ravel()
    uv_sets = []
    for uv in mesh.uv_sets:
        if uv.indices is None:
            uv_sets.append(replace(uv, values=uv.values[kept]))
        else:
            used, indices = np.unique(uv.indices[corners], return_inverse=True)
            uv_sets.append(replace(uv, values=uv.values[used], indices=indices.ravel().astype(np.int32)))
    subsets = {name: place[points] for name, points in mesh.point_subsets.items()}
    materials = wedges.materials[triangles[:, 0]]
    faces = [(one.material, np.flatnonzero(materials == number)) for number, one in enumerate(mesh.material_faces)]
    return replace(
        mesh,
        points=mesh.points[kept],
        face_vertex_counts=np.full(len(triangles), 3, np.int32),
        face_vertex_indices=place[wedges.points[triangles]].astype(np.int32).ravel(),
        normals=None if mesh.normals is None else mesh.normals[corners if _by_corner(mesh) else kept],
        uv_sets=tuple(uv_sets),
        colors=None if mesh.colors is None else mesh.colors[kept],
        skin=None
        if mesh.skin is None
        else replace(
            mesh.skin, joint_indices=mesh.skin.joint_indices[kept], joint_weights=mesh.skin.joint_weights[kept]
        ),
        blendshapes=tuple(_shape(blendshape, place) for blendshape in mesh.blendshapes),
        regions={name: mask[kept] for name, mask in mesh.regions.items()},
        point_subsets={name: points[points >= 0].astype(np.int32) for name, points in subsets.items()},
        landmarks={
            name: replace(one, indices=place[one.indices].astype(np.int32)) for name, one in mesh.landmarks.items()
        },
        anchor=None if mesh.anchor is None else int(place[mesh.anchor]),
        material_faces=tuple(
            MaterialFaces(material=name, faces=own.astype(np.int32)) for name, own in faces if len(own)
        ),
    )


def _shape(shape: Blendshape, place: IntArray) -> Blendshape:
    points = place[shape.point_indices]
    kept = points >= 0
    shape = shape.changed(lambda offsets: offsets[kept], lambda offsets: offsets[kept])
    return replace(shape, point_indices=points[kept].astype(np.int32))


def cards_of(points: FloatArray, triangles: IntArray, mesh: IntArray) -> IntArray:
    """(t,) which card a triangle belongs to, -1 for none: cards are open pieces with more border than inside.

    :param points: (n, 3)
    :param triangles: (t, 3) of them
    :param mesh: (t,) which mesh each is of
    """
    pairs, uses = edges(np.full(len(triangles), 3), triangles.ravel())
    piece = components(len(points), pairs)
    on_border = np.zeros(len(points), bool)
    on_border[pairs[uses == 1]] = True
    open_pieces = np.bincount(piece, on_border) >= _BORDER * np.bincount(piece)
    triangle_piece = piece[triangles[:, 0]]
    number, first = np.unique(triangle_piece, return_index=True)
    is_card = np.zeros(piece.max(initial=-1) + 1, bool)
    is_card[number] = open_pieces[number]
    enough = np.bincount(mesh[first], is_card[number], minlength=mesh.max(initial=-1) + 1) >= _FEWEST
    return np.where(is_card[triangle_piece] & enough[mesh], triangle_piece, -1)


def apart(points: FloatArray, triangles: IntArray, card: IntArray) -> IntArray:
    """(k,) the cards in an order in which the first are always spread over all of them, the first the largest one.

    :param card: (t,) which card each triangle (t, 3) is of
    """
    number, at = np.unique(card, return_inverse=True)
    corners = points[triangles].reshape(len(triangles), 9)
    low, high = np.full((len(number), 9), np.inf), np.full((len(number), 9), -np.inf)
    np.minimum.at(low, at, corners)
    np.maximum.at(high, at, corners)
    boxes = np.hstack([low.reshape(-1, 3, 3).min(axis=1), high.reshape(-1, 3, 3).max(axis=1)])
    chosen, away = [int((boxes[:, 3:] - boxes[:, :3]).sum(axis=1).argmax())], np.full(len(boxes), np.inf)
    while len(chosen) < len(boxes):
        away = np.minimum(away, np.linalg.norm(boxes - boxes[chosen[-1]], axis=1))
        away[chosen] = -1.0
        chosen.append(int(away.argmax()))
    return np.asarray(number[chosen])


def widened(points: FloatArray, triangles: IntArray, card: IntArray, share: float) -> FloatArray:
    """(n, 3) points whose cards are wider, to stand for all of them: 1 of `share` times, but `_WIDEST` at most.

    The long sides of a card go apart, each to its outside.

    :param triangles: (t, 3) of the cards that stay
    :param card: (t,) which card each is of
    :param share: of the cards that stay
    """
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    keys = np.sort(sides, axis=1)
    at, uses = np.unique(keys[:, 0] * len(points) + keys[:, 1], return_inverse=True, return_counts=True)[1:]
    border = np.flatnonzero(uses[at] == 1)
    ends, of_card = sides[border], card[np.repeat(np.arange(len(triangles)), 3)[border]]
    along = points[ends[:, 1]] - points[ends[:, 0]]
    length = np.maximum(np.linalg.norm(along, axis=1), np.finfo(float).tiny)
    outside = points[ends[:, 0]] - points[triangles[:, [2, 0, 1]].ravel()[border]]
    outside -= along * (np.einsum("ec,ec->e", outside, along) / length**2)[:, None]
    place = _lengthwise(len(points), triangles, card)
    weight = np.abs(place[ends[:, 1]] - place[ends[:, 0]]) / np.maximum(np.linalg.norm(outside, axis=1), 1e-12)
    push = np.zeros_like(points)
    for side in ends.T:
        np.add.at(push, side, outside * weight[:, None])
    push /= np.maximum(np.linalg.norm(push, axis=1, keepdims=True), 1e-12)
    around = np.bincount(of_card, length, int(card.max()) + 1)
    owner = np.zeros(len(points), np.int64)
    owner[triangles] = card[:, None]
    area = np.bincount(owner, point_areas(points, triangles), len(around))
    # 2 (l + w) = around and l w = area, so 4 w = around - sqrt(around^2 - 16 area); rounding may take the root below 0
    width = (around - np.sqrt(np.maximum(around**2 - 16 * area, 0))) / 4  # of a rectangle with that border and area
    factor = min(share**-_STANDS_IN, _WIDEST)
    return np.asarray(points + (0.5 * (factor - 1) * width)[owner][:, None] * push)


def _lengthwise(count: int, triangles: IntArray, card: IntArray) -> FloatArray:
    """(count,) how far along its card a point is: the slowest vibration of the card's edges (Fiedler 1973)."""
    along = np.zeros(count)
    order = np.argsort(card, kind="stable")
    with one_thread():  # many take ten times as long for matrices of 20 rows
        for rows in np.split(triangles[order], np.flatnonzero(np.diff(card[order])) + 1):
            points, corners = np.unique(rows, return_inverse=True)
            corners = corners.reshape(-1, 3)
            joined = np.zeros((len(points), len(points)))
            joined[corners, np.roll(corners, 1, axis=1)] = joined[np.roll(corners, 1, axis=1), corners] = 1.0
            along[points] = np.linalg.eigh(np.diag(joined.sum(axis=1)) - joined)[1][:, 1]
    return along


class Simplifier:
    """The module, compiled."""

    def __init__(self) -> None:
        """:raises InputError: wasmtime is not there"""
        self._program = Program(_MODULE, "lod", bounded=False)

    def __call__(
        self, points: FloatArray, attributes: FloatArray, triangles: IntArray, fixed: BoolArray, count: int
    ) -> IntArray:
        """(t, 3) at most `count` triangles of the vertices, or what can be reached.

        :param points: (v, 3) of all vertices, also of those that no triangle uses
        :param attributes: (v, k) in the unit of the points; their error counts like that of points
        :param fixed: (v,) vertices that stay
        """
        calls = _Calls(self._program)
        extent = float(np.ptp(points, axis=0).max()) or 1.0  # the module scales points, and not attributes, by it
        result, error = calls.room(triangles.size, np.uint32), calls.room(1, np.float32)
        length = calls.simplify(
            *(result, calls.put(triangles, np.uint32), triangles.size),
            *(calls.put(points, np.float32), len(points), 3 * 4),
            *(calls.put(attributes, np.float32), 4 * attributes.shape[1]),
            *(calls.put(np.full(attributes.shape[1], 1.0 / extent), np.float32), attributes.shape[1]),
            *(calls.put(fixed, np.uint8), 3 * count, _ANY_ERROR, 0, error),
        )
        return calls.indices(result, length).reshape(-1, 3)


class _Calls(Run):
    """A fresh instance of the module and its memory."""

    def __init__(self, program: Program) -> None:
        super().__init__(program, "memory")
        self.call("__wasm_call_ctors")

    def room(self, count: int, kind: Any) -> int:
        """The address of memory for `count` values."""
        size = count * np.dtype(kind).itemsize
        return self.call("sbrk", -(-size // _ALIGNMENT) * _ALIGNMENT)

    def put(self, values: Any, kind: Any) -> int:
        """The address of values that were put there."""
        data = np.ascontiguousarray(values, kind)
        address = self.room(data.size, kind)
        self.write(address, data.tobytes())
        return address

    def indices(self, address: int, count: int) -> IntArray:
        """(count,) indices at an address."""
        return np.frombuffer(self.read(address, 4 * count), np.uint32).astype(np.int64)

    def simplify(self, *arguments: Any) -> int:
        """How many indices the simplifier wrote."""
        return self.call("meshopt_simplifyWithAttributes", *arguments)


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
        marks = [np.zeros(0, np.int64)]  # landmarks and anchors
        for mesh, first in zip(meshes, firsts, strict=False):
            anchor = [] if mesh.anchor is None else [np.array([mesh.anchor])]
            marks += [indices + first for indices in (*(one.indices for one in mesh.landmarks.values()), *anchor)]
        self._marks = np.concatenate(marks).astype(np.int64)
        self._rig = rig
        self._simplify = Simplifier()
        self._motion = _motion_of(rig, MOST_ATTRIBUTES)[self._point]
        # points where materials meet
        materials = _joined(wedge.materials for wedge in self._wedges)
        points, counts = np.unique(np.unique(np.stack([self._point, materials]), axis=1)[0], return_counts=True)
        rims = np.setdiff1d(np.asarray(points[counts > 1]), self.triangles[self.is_skin])
        with_rims = np.isin(np.arange(len(meshes)), np.searchsorted(firsts, rims, side="right") - 1)
        self._least = np.where(with_rims, 1.0, _LEAST)  # by mesh
        hairs = self.triangles[self.cards >= 0]
        # the point that each sculpt moves most: no level lacks a shape
        moving = [target for target in rig.targets if len(target.offsets)]
        strongest = [one.point_indices[np.linalg.norm(one.offsets, axis=1).argmax()] for one in moving]
        kept = np.append(np.array(strongest, np.int64), _even_points(rig.points, self.triangles, rims))
        stay = np.append(np.setdiff1d(kept, hairs), self._marks)
        self._fixed = np.isin(self._point, stay)
        places = rig.points[self._point].astype(np.float32)
        self._place = merge_points(places)[1]
        self._outermost = np.concatenate([places.argmin(axis=0), places.argmax(axis=0)])

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
        counted = others + (_HAIR - 1) * is_card.sum()
        for number in np.unique(mesh[is_card]):
            own = is_card & (mesh == number)
            pieces.append(self._fewer_cards(own, int(_HAIR * left * own.sum() / counted)))
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
        # the first cards of the order, so many that they have at most `most` triangles, but one card
        card = self._card_of(found)
        counts = np.bincount(card, minlength=int(order.max()) + 1)[order]
        first = order[: max(1, int(np.searchsorted(np.cumsum(counts), most, side="right")))]
        return np.asarray(found[np.isin(card, first)])

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

    def skin_triangles(self, level: IntArray) -> int:
        """How many triangles of a level are of the skin."""
        return int(self._among(level, self.is_skin).sum())

    def _among(self, level: IntArray, chosen: BoolArray) -> BoolArray:
        """(t,) triangles of a level that are of the chosen pieces of the face."""
        return np.isin(level[:, 0], self._triangles[chosen])

    def points_of(self, level: IntArray) -> IntArray:
        """(t, 3) points of a level's wedges."""
        return np.asarray(self._point[level])

    def meshes(self, level: IntArray, places: FloatArray) -> tuple[Mesh, ...]:
        """Each mesh at a level, whose `places` these are; one without triangles as it is."""
        moved, result = places - self._rig.points, []
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
        # Of the vertices in use alone, and those at the same places, where the surface stays closed: the module copies
        # and hashes all that it is given, which took half of its time. Its box stays that of all vertices: with
        # another scale a third of the triangles were others.
        near = np.zeros(len(self._place), bool)
        near[self._place[triangles]] = True
        wanted = near[self._place]
        wanted[self._outermost] = True
        used = np.flatnonzero(wanted)
        number = np.zeros(len(self._point), np.int64)
        number[used] = np.arange(len(used))
        places, motion, fixed = self._rig.points[self._point[used]], self._motion[used], self._fixed[used]
        return np.asarray(used[self._simplify(places, motion, number[triangles], fixed, most)])


def _joined(arrays: Iterable[IntArray]) -> IntArray:
    return np.concatenate(list(arrays))


def _even_points(points: FloatArray, triangles: IntArray, rims: IntArray) -> IntArray:
    """Some of the points on each line of `rims`, evenly: the rims of iris and pupil stay round.

    :param points: (n, 3)
    :param triangles: (t, 3)
    :param rims: (r,) ascending
    """
    pairs = edges(np.full(len(triangles), 3), triangles.ravel())[0]
    line = components(len(points), pairs[np.isin(pairs, rims).all(axis=1)])[rims]
    found = [np.zeros(0, np.int64)]
    for number in np.unique(line):
        own = rims[line == number]
        # some way apart, with none of all farther from every one of them
        chosen, away = list[int](), np.full(len(own), np.inf)
        while away.max() > _SPACING * np.ptp(points[own], axis=0).max():
            chosen.append(int(away.argmax()))
            away = np.minimum(away, np.linalg.norm(points[own] - points[own[chosen[-1]]], axis=1))
        found.append(own[chosen])
    return np.concatenate(found)


def _motion_of(rig: Rig, most: int) -> FloatArray:
    """(n, k) coordinates of each point, in the unit of the rig, k at most `most`.

    The principal components of the offsets of all sculpts and of the ways that joints move points, scaled so that
    squared differences are `_WEIGHT` squared times those of the offsets themselves, summed over all sculpts.
    """
    weights = sparse.csr_array(rig.influences[:, : len(rig.joints)])
    distances = np.zeros(len(rig.joints))
    for joint, inverse in enumerate(rig.inverse_bind):
        # a turn moves points by its angle times their distance from the joint: here the mean, by their weights
        share = weights[:, [joint]].toarray().ravel()
        place = np.linalg.inv(inverse)[:3, 3]
        total = share.sum()
        if total > 0:
            distances[joint] = (share * np.linalg.norm(rig.points - place, axis=1)).sum() / total
    joints, count = sparse.csr_array(weights @ sparse.diags_array(_TURN * distances)), 3 * len(rig.targets)
    gram = np.zeros((count + len(rig.joints),) * 2)
    with one_thread():
        # dense, some points and the targets that move them at a time: sparse products of rows of a hundred numbers each
        # took five times as long
        for start in range(0, len(rig.points), _TOGETHER):
            end = min(start + _TOGETHER, len(rig.points))
            moved = rig.deltas[3 * start : 3 * end]
            moving = np.flatnonzero(np.bincount(moved.indices, minlength=len(rig.targets)))
            offsets = moved[:, moving].toarray().reshape(end - start, 3 * len(moving))
            rows = np.hstack([offsets, joints[start:end].toarray()])
            columns = [*(axis * len(rig.targets) + moving for axis in range(3)), np.arange(count, len(gram))]
            own = np.concatenate(columns)
            gram[np.ix_(own, own)] += rows.T @ rows
        values, vectors = np.linalg.eigh(gram)
    vectors = vectors[:, np.argsort(-values, kind="stable")[:most]]
    moved = joints @ vectors[count:]
    for axis in range(3):
        moved += rig.deltas[axis::3] @ vectors[axis * len(rig.targets) : (axis + 1) * len(rig.targets)]
    return np.asarray(_WEIGHT * moved)
