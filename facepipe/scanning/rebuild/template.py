"""The template of a rebuild: a face stage's surface, what of it a scan can show, and how far its points may follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.names import suggestion
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.geometry.polygons import components, point_normals
from facepipe.geometry.registration import Shown
from facepipe.geometry.similarity import fit_similarities
from facepipe.geometry.vectors import group_sums
from facepipe.kinds import found_of
from facepipe.parts import FaceParts, Recipe, all_regions
from facepipe.scanning.database import FaceDatabase
from facepipe.verbs.skin.surface import Surface, slits_of, surface_of
from facepipe.verbs.whole_faces import Topology, whole_face, whole_points

_DIRECTIONS = 60
_CELLS_ACROSS = 100  # across the surface: wider than the gaps between samples
_DEPTH_SLACK = 0.012  # of the surface's size, in depth
_FACING_COSINE = 0.1  # cosine between a point's normal and the direction that it is seen from
_LIP = 0.35  # of a slit's width: so far from its rims, points count as of the upper or lower lip or lid
_LIPS_MM, _DEEP_MM = 1.5, 6.0  # off the skin: up to there of lips and lids, and from there inside the head
_AROUND = 48  # points of the skin that what is inside moves with
_NO_REGIONS = ", expected a face with regions (facepipe regions)"
_SIDES = ("_L", "_R")
_SIDES_WRITTEN = (("_L", "Left"), ("Left", "_L"), ("_R", "Right"), ("Right", "_R"))


def seen_from_outside(points: FloatArray, triangles: IntArray) -> BoolArray:
    """(n,) points that some of 60 directions all around sees from the front, with every triangle opaque.

    Depth maps of triangles' corners and middles, so that gaps much thinner than the surface (lips, lids) are closed.

    :param points: (n, 3)
    :param triangles: (t, 3), oriented outward
    """
    normals = point_normals(points, triangles)
    used = np.zeros(len(points), bool)
    used[triangles.ravel()] = True
    samples = np.concatenate([points[used], points[triangles].mean(axis=1)])
    size = float(np.ptp(samples, axis=0).max()) or 1.0
    seen = np.zeros(len(points), bool)
    # (count, 3) directions spread evenly (a Fibonacci spiral)
    step = np.arange(_DIRECTIONS) + 0.5
    height = 1.0 - 2.0 * step / _DIRECTIONS
    turn = np.pi * (1.0 + np.sqrt(5.0)) * step
    width = np.sqrt(1.0 - height**2)
    for towards in np.stack([width * np.cos(turn), height, width * np.sin(turn)], axis=1):
        facing = np.flatnonzero((normals @ towards > _FACING_COSINE) & ~seen)
        across = np.eye(3)[np.abs(towards).argmin()]
        right = np.cross(across, towards)
        axes = np.stack([right, np.cross(towards, right)], axis=1) / np.linalg.norm(right)
        flat = samples @ axes
        low, cell = flat.min(axis=0), size / _CELLS_ACROSS
        shape = np.floor((flat.max(axis=0) - low) / cell).astype(np.int64) + 1
        # the depth map's cells of the samples, and of the points
        of_samples, of_points = (
            np.clip(np.floor((values - low) / cell).astype(np.int64), 0, shape - 1) @ [shape[1], 1]
            for values in (flat, points[facing] @ axes)
        )
        nearest = np.full(int(shape.prod()), -np.inf)
        np.maximum.at(nearest, of_samples, samples @ towards)
        seen[facing] = points[facing] @ towards >= nearest[of_points] - _DEPTH_SLACK * size
    return seen & used


@dataclass(frozen=True, kw_only=True)
class Template:
    """n whole points of a face, and m rows of its skin: the part that the landmarks lie on, cuts sewn."""

    where: str
    parts: FaceParts
    topology: Topology
    points: FloatArray  # (n, 3) whole points, millimetres
    rows: IntArray  # (m,) a whole point of each row
    row_of: IntArray  # (n,) row of each whole point, -1 on loose parts
    triangles: IntArray  # (t, 3) of rows
    landmarks: IntArray  # (68,) rows
    surface: Surface  # that the rows are of

    @classmethod
    def of(cls, parts: FaceParts, where: str) -> Template:
        """A face stage as a template.

        :raises InputError: no ``multipie68`` landmarks, or no surface at them
        """
        surface = surface_of(parts, where)
        if surface.landmarks is None:
            raise InputError(where, "has no multipie68 landmarks, expected 68 (facepipe landmarks)")
        row_of_sewn = np.full(len(surface.points), -1)
        row_of_sewn[surface.inside] = np.arange(len(surface.inside))
        # One row for all points of a cut: with a row each, a fit could open it.
        first = np.unique(surface.group, return_index=True)[1]
        return cls(
            where=where,
            parts=parts,
            topology=Topology.of(parts),
            points=whole_points(parts),
            rows=first[surface.inside],
            row_of=row_of_sewn[surface.group],
            triangles=surface.part_triangles(surface.inside),
            landmarks=row_of_sewn[surface.landmarks],
            surface=surface,
        )

    @cached_property
    def labels(self) -> IntArray:
        """(m,) +a and -a are the upper and lower side of a slit, 0 neither."""
        labels = np.zeros(len(self.surface.points), np.int64)  # of the sewn points
        for number, slit in enumerate(slits_of(self.surface), start=1):
            near = (slit.distance <= _LIP * slit.width) & (np.abs(slit.side) > 0.02)
            labels[near] = number * np.sign(slit.side[near]).astype(np.int64)
        return labels[self.surface.inside]

    def body(self, topology: Topology) -> Template:
        """The template without the meshes that faces of `topology` lack: hair and lashes, which go with the skin.

        :raises TopologyError: other meshes or faces
        """
        if self.topology.digest == topology.digest:
            return self
        known = tuple(mesh for mesh in self.parts.meshes if mesh.name in topology.names)
        if Topology.of(replace(self.parts, meshes=known)).digest != topology.digest:
            raise TopologyError(self.where, "other meshes or faces than the database has, expected the same")
        return Template.of(replace(self.parts, meshes=known), self.where)

    def dressed(self, body: Template, points: FloatArray) -> FloatArray:
        """(n, 3) whole points where those of the `body` are at `points`: other meshes go with the skin around them."""
        if body is self:
            return points
        known, result = self._known(body), np.array(self.points)
        result[known] = points
        carried = self.whole(self.points, result[self.rows])
        return np.where(known[:, None], result, carried)

    def dressed_shapes(self, body: Template, shapes: Mapping[str, FloatArray]) -> Mapping[str, FloatArray]:
        """(n, 3) whole deltas where those of the `body` are `shapes`; other meshes keep the template's own."""
        if body is self:
            return shapes
        own, known = whole_face(self.parts, self.where).deltas, self._known(body)
        result = {}
        for name, delta in shapes.items():
            result[name] = np.array(own[name]) if name in own else np.zeros_like(self.points)
            result[name][known] = delta
        return result

    def _known(self, body: Template) -> BoolArray:
        """(n,) points that the body has too."""
        counts = [len(mesh.points) for mesh in self.parts.meshes]
        return np.repeat([mesh.name in body.topology.names for mesh in self.parts.meshes], counts)

    @cached_property
    def seen(self) -> IntArray:
        """Rows that a scan from outside can show, ascending.

        Depth maps are coarse: the third corner of a triangle with two seen ones is taken as seen too.
        """
        seen = seen_from_outside(self.points, self.topology.triangles)[self.rows]
        beside = self.triangles[seen[self.triangles].sum(axis=1) >= 2]
        seen[beside.ravel()] = True
        return np.flatnonzero(seen)

    def with_inside(self, base: FloatArray, moves: FloatArray) -> FloatArray:
        """(m, 3) moves of rows from `base` (m, 3), where those of the inside, that no scan shows, are as around them.

        A registration moves the mouth's inside with the lips alone: a chin that moves otherwise would uncover it.
        """
        from scipy.spatial import cKDTree

        inside = np.setdiff1d(np.arange(len(base)), self.seen)
        if not len(inside) or not len(self.seen):
            return moves
        count = min(_AROUND, len(self.seen))
        distances, near = cKDTree(base[self.seen]).query(base[inside], k=np.arange(1, count + 1))
        weights = 1.0 / (distances**2 + _LIPS_MM**2)
        around = (weights[..., None] * moves[self.seen[near]]).sum(axis=1) / weights.sum(axis=1, keepdims=True)
        deep = np.clip((distances[:, :1] - _LIPS_MM) / (_DEEP_MM - _LIPS_MM), 0.0, 1.0)
        result = np.array(moves)
        result[inside] += deep * (around - moves[inside])
        return result

    @cached_property
    def face(self) -> BoolArray:
        """(m,) rows of the face area: seen ones in front, from below the chin to above the brows, as landmarks say."""
        marks = self.points[self.rows[self.landmarks]]
        places = self.points[self.rows]
        width = float(np.ptp(marks[:17, 0]))
        height = float(marks[17:27, 1].max() - marks[:17, 1].min())
        middle = marks.mean(axis=0)
        within = np.abs(places[:, 0] - middle[0]) <= 0.55 * width
        within &= (places[:, 1] <= marks[17:27, 1].max() + 0.3 * height) & (places[:, 1] >= marks[:17, 1].min())
        within &= places[:, 2] >= marks[[0, 16], 2].mean()
        face = np.zeros(len(self.rows), bool)
        face[self.seen] = within[self.seen]
        return face

    @cached_property
    def loose(self) -> IntArray:
        """Whole points of loose parts: eyeballs, teeth, lashes."""
        return np.flatnonzero(self.row_of < 0)

    @property
    def stiff(self) -> IntArray:
        """(n,) number of the loose part that each whole point belongs to, -1 on the skin."""
        pieces = np.full(len(self.points), -1)
        pieces[self.loose] = self._pieces
        return pieces

    def whole(self, base: FloatArray, points: FloatArray) -> FloatArray:
        """(n, 3) whole points where the skin has moved to `points` (m, 3) from what it is on `base` (n, 3).

        Loose parts keep their shape: each goes with the skin nearest to it, by the similarity that fits best.
        """
        moved = points - base[self.rows]
        result = np.array(base, np.float64)
        skin = self.row_of >= 0
        result[skin] = points[self.row_of[skin]]
        if len(self.loose):
            from scipy.spatial import cKDTree

            _, near = cKDTree(base[self.rows]).query(base[self.loose])
            here, moves, pieces = base[self.loose], moved[near], self._pieces
            there = here + moves
            if len(here) >= 3:
                counts = np.bincount(pieces)
                mean = group_sums(pieces, moves, len(counts)) / counts[:, None]
                fitted = fit_similarities(here, there, pieces, scale=False).apply(here, pieces)
                there = np.where((counts > 2)[pieces, None], fitted, here + mean[pieces])
            result[self.loose] = there
        return result

    @cached_property
    def _pieces(self) -> IntArray:
        """(l,) number of the connected part that each loose point belongs to."""
        triangles = self.topology.triangles
        pairs = np.concatenate([triangles[:, :2], triangles[:, 1:]])
        part = components(len(self.points), pairs)[self.loose]
        return np.unique(part, return_inverse=True)[1].ravel()


def region_weights(parts: FaceParts, names: Sequence[str], where: str) -> FloatArray:
    """(n,) 0 to 1 for whole points: the sum of the soft masks of the regions `names`, 1 all over where none is named.

    :raises InputError: a region that the face lacks, with the names of those that it has
    """
    if not names:
        return np.ones(parts.point_count)
    regions = all_regions(parts.meshes)
    for name in names:
        if name not in regions:
            raise InputError(
                f"{where} -> region {name[:60]}",
                f"no such region{suggestion(name, regions) if regions else _NO_REGIONS}",
            )
    masks = np.stack([regions[name] for name in dict.fromkeys(names)]).astype(np.float64)
    if not (np.isfinite(masks).all() and masks.max(initial=0.0) > 0.0):
        raise InputError(f"{where} -> region {', '.join(names)}", "no point is in it, expected some")
    return np.asarray(np.clip(masks.sum(axis=0), 0.0, 1.0))


def _both(**weights: float) -> dict[str, float]:
    return {f"{name}{side}": weight for name, weight in weights.items() for side in _SIDES}


DEFAULT_COMPOSITES: dict[str, dict[str, float]] = {
    "jaw_open": {"jawOpen": 0.8},
    "jaw_open_lips_closed": {"jawOpen": 0.6, "mouthClose": 0.6},
    "jaw_forward": {"jawForward": 0.8},
    "smile": _both(mouthSmile=1.0, cheekSquint=0.6),
    "laugh": {"jawOpen": 0.5, **_both(mouthSmile=0.8, cheekSquint=0.8, eyeSquint=0.6)},
    "brows_up": _both(browInnerUp=1.0, browOuterUp=0.9, eyeWide=0.8),
    "anger": _both(browDown=1.0, noseSneer=0.7, mouthPress=0.5),
    "closed_eyes": _both(eyeBlink=1.0),
    "squint": _both(eyeSquint=1.0, cheekSquint=0.9),
    "pucker": {"mouthPucker": 1.0},
    "funnel": {"mouthFunnel": 1.0, "jawOpen": 0.3},
    "sad": {"mouthShrugLower": 0.6, **_both(mouthFrown=1.0, browInnerUp=0.7)},
    "left": {"mouthLeft": 0.9, "jawLeft": 0.8, "eyeBlink_L": 0.7},
    "right": {"mouthRight": 0.9, "jawRight": 0.8, "eyeBlink_R": 0.7},
    "teeth": _both(mouthUpperUp=0.9, mouthLowerDown=0.9),
    "stretch": {"jawOpen": 0.4, **_both(mouthStretch=1.0, mouthDimple=0.5)},
    "rolled": {"mouthRollUpper": 0.9, "mouthRollLower": 0.9, "jawForward": 0.6, "mouthShrugUpper": 0.4},
    "cheeks_puffed": _both(cheekPuff=1.0),
    "look_up": _both(eyeLookUp=1.0),
    "look_down": _both(eyeLookDown=1.0),
}
"""Scanned expression -> shapes and their weights, where a project does not say."""


def resolved(composite: Mapping[str, float], shapes: Sequence[str], where: str) -> dict[str, float]:
    """The weights of a composite by the names that a face's `shapes` have, in their order.

    :raises InputError: no weight, one out of 0 to 2, or a shape that the face lacks
    """
    if not composite:
        raise InputError(where, "names no shape, expected a weight for each shape that it shows")
    known = set(shapes)
    weights: dict[str, float] = {}
    for name, weight in composite.items():
        if not 0.0 < weight <= 2.0:
            raise InputError(f"{where} -> {name}", f"weight {weight}, expected one above 0, up to 2")
        spellings = [name]  # as it is, with the other way to write its side, and without
        for end, other in _SIDES_WRITTEN:
            stem = name.removesuffix(end)
            if stem and stem != name:
                spellings += [stem + other, stem]
                break
        shape = next((each for each in spellings if each in known), None)
        if shape is None:
            raise InputError(f"{where} -> {name}", f"no such shape{suggestion(name, shapes)}")
        weights[shape] = max(weight, weights.get(shape, 0.0))
    return {name: weights[name] for name in shapes if name in weights}


def carried_over(
    template: Template, database: FaceDatabase, weights: Mapping[str, float], where: str
) -> tuple[dict[str, FloatArray], dict[str, float]]:
    """The template's own shapes that a scan shows, carried over to the database's mean person: of a scan's own person,
    nothing is known yet, and the residual takes up how that person differs.

    :param weights: by names as `resolved` finds them
    :return: name -> (n, 3) whole delta, millimetres; and the weights of the same names
    :raises InputError: a shape that the template lacks, or a weight out of 0 to 2
    """
    if not weights:
        return {}, {}
    template_deltas = whole_face(template.parts, template.where).deltas
    if not template_deltas:
        raise InputError(where, f"{template.where} has no blendshapes, expected those that the scan shows")
    named, mean = resolved(weights, tuple(template_deltas), where), database.identity.mean
    transfer = Transfer(mean, template.topology.triangles, np.zeros(len(mean), bool))
    rest = template.points
    return {name: transfer.solve(rest[None], (rest + template_deltas[name])[None]) - mean for name in named}, named


def expression_of(deltas: Mapping[str, FloatArray], weights: Mapping[str, float], count: int) -> FloatArray:
    """(n, 3) whole delta of `count` points: shapes by their weights."""
    return np.asarray(sum((weight * deltas[name] for name, weight in weights.items()), np.zeros((count, 3))))


def shown_prior(
    template: Template, deltas: Mapping[str, FloatArray], weights: Mapping[str, float], sigma: float
) -> Shown | None:
    """Shapes that a scan shows besides, for a registration of the template's rows; None where nothing is shown.

    :param sigma: how far a weight may be from the given one
    """
    if not weights:
        return None
    return Shown(
        modes=np.stack([deltas[name][template.rows] for name in weights]),
        expected=np.array(list(weights.values()), np.float64),
        precision=np.full(len(weights), 1.0 / sigma**2),
    )


def shown_before(recipe: Recipe | None) -> dict[str, float]:
    """Weights of the shapes that the scan of a neutral shows besides, as its recipe says that they were found."""
    weights = found_of(recipe).get("weights")
    if not isinstance(weights, Mapping) or not all(isinstance(one, int | float) for one in weights.values()):
        return {}
    return {str(name): float(weight) for name, weight in weights.items() if 0.0 < weight <= 2.0}
