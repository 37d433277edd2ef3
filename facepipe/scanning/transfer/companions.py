"""What goes with the skin of a head when its shapes move: teeth, tongue, eyeballs, lashes, brows and tear lines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.closest_points import SurfaceSearch, place_shares
from facepipe.geometry.geodesics import nearest_sources, surface_graph
from facepipe.geometry.polygons import point_normals, triangle_normals
from facepipe.geometry.similarity import fit_similarity
from facepipe.scanning.transfer.lids import EYES, Aperture, Globe
from facepipe.scanning.transfer.lips import lips_of
from facepipe.scanning.transfer.pieces import (
    BROWS,
    EYE_LEFT,
    EYE_RIGHT,
    GROWTH,
    LASHES,
    LAYER,
    MOUTH,
    SKIN,
    TEARS,
    TEETH_LOWER,
    TEETH_UPPER,
    TONGUE,
    Inside,
    Pieces,
    by_number,
    pieces_of,
)
from facepipe.scanning.transfer.places import facing_places
from facepipe.verbs.skin.surface import smoothstep

_MOVES_MM = 0.05  # teeth that move less stand still
_TURNS_MM = 0.5  # eyeballs whose points move more are turned by a template's shapes
_TURN = 0.5  # radians that an eye turns at 1 where the template turns it by a joint, as the built-in head does
_LOOKS = {  # shape -> radians about the face's left, up and forwards axes
    **{f"eyeLookDown{side}": (_TURN, 0.0, 0.0) for side in EYES},
    **{f"eyeLookUp{side}": (-_TURN, 0.0, 0.0) for side in EYES},
    **{f"eyeLook{way}{side}": (0.0, turn, 0.0) for way, side, turn in (
        ("Out", "Left", _TURN), ("In", "Left", -_TURN), ("Out", "Right", -_TURN), ("In", "Right", _TURN)
    )},
}  # fmt: skip
_ROOT_MM = 1.2  # points of a lash so much farther from the lid than its nearest one are its root
_MARGIN_MM = 5.0  # from the margin: skin that lashes and tear lines hold on to
_NEAREST = 4  # points of the template's tongue that a point of the head's follows
_TONGUE_SHARE = 0.2  # of the farthest point's way beside the jaw: from there on points of gums are tongue
_FAR_MM = 15.0  # that a tongue goes, from where it goes as the template's
_TONGUE_MM = 8.0  # from the template's tongue: what of gums with a tongue is tongue


@dataclass(frozen=True, kw_only=True)
class Motion:
    """How the template moves what is inside it: w whole points."""

    neutral: FloatArray  # (w, 3) mm of the template itself
    deltas: Mapping[str, FloatArray]  # name -> (w, 3) mm
    inside: Inside  # on the head
    lips: Mapping[str, FloatArray] = field(default_factory=dict)  # name -> (s,) mm between its lips; "": at rest

    @cached_property
    def size(self) -> float:
        """How much larger the head is than the template, by its rows of teeth, else by all of it."""
        rows = np.concatenate([self.inside.upper, self.inside.lower])
        rows = rows if len(rows) >= 4 else np.arange(len(self.neutral))
        return fit_similarity(self.neutral[rows], self.inside.points[rows]).scale

    def jaw(self, name: str, points: FloatArray) -> FloatArray | None:
        """(m, 3) how the jaw moves points of the head: rigidly, as the template's lower teeth; None: it doesn't."""
        rows, delta = self.inside.lower, self.deltas.get(name)
        if delta is None or len(rows) < 4 or np.abs(delta[rows]).max() < _MOVES_MM:
            return None
        start = self.neutral[rows]
        rotation = fit_similarity(start, start + delta[rows], scale=False).rotation
        about = self.inside.points[rows].mean(axis=0)
        offsets = points - about
        return np.asarray(offsets @ rotation.T - offsets + self.size * delta[rows].mean(axis=0))

    def tongue(self, name: str, rows: IntArray) -> FloatArray | None:
        """(t, 3) mm that points of the template's tongue move besides its jaw; None: they don't."""
        delta = self.deltas.get(name)
        if delta is None or not len(rows):
            return None
        own = self.size * delta[rows]
        with_jaw = self.jaw(name, self.inside.points[rows])
        moves = np.linalg.norm(own, axis=1, keepdims=True) > _MOVES_MM  # upper gums do not go with the jaw
        own = own if with_jaw is None else np.where(moves, own - with_jaw, 0.0)
        return own if np.abs(own).max() > _MOVES_MM else None

    def turn(self, name: str, side: str) -> FloatArray | None:
        """(3, 3) how a shape turns an eyeball: as the template's points do, else as its joints; None: it doesn't."""
        rows, delta = self.inside.balls.get(side, np.zeros(0, np.int64)), self.deltas.get(name)
        if delta is not None and len(rows) >= 4 and np.abs(delta[rows]).max() > _TURNS_MM:
            start = self.neutral[rows]
            return fit_similarity(start, start + delta[rows], scale=False).rotation
        if name in _LOOKS and name.endswith(side):
            from scipy.spatial.transform import Rotation

            return np.asarray(Rotation.from_rotvec(_LOOKS[name]).as_matrix())
        return None


@dataclass(frozen=True, kw_only=True)
class Binding:
    """Points of companions that hold on to places of the skin."""

    rows: IntArray  # (k,) points of the head
    corners: IntArray  # (k, 3) points of the skin
    shares: FloatArray  # (k, 3)
    about: FloatArray | None = (
        None  # (3,) the middle of the eye whose lids they turn with; None: with the skin's normal
    )

    def moves(self, points: FloatArray, delta: FloatArray, normals: tuple[FloatArray, FloatArray]) -> FloatArray:
        """(k, 3) where they go, offsets turned as the skin turns.

        :param normals: (n, 3) of the skin before, and once it moved
        """
        before, shift = (np.einsum("kc,kci->ki", self.shares, values[self.corners]) for values in (points, delta))
        if self.about is None:
            start, end = (np.einsum("kc,kci->ki", self.shares, values[self.corners]) for values in normals)
        else:
            start, end = before - self.about, before + shift - self.about
        offsets = points[self.rows] - before
        return np.asarray(shift + _turned(offsets, start, end) - offsets)


def _turned(vectors: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """(k, 3) vectors, each by the smallest rotation from the direction `start` to `end` (Rodrigues' formula)."""
    start, end = (one / np.maximum(np.linalg.norm(one, axis=1, keepdims=True), 1e-12) for one in (start, end))
    axis, cosine = np.cross(start, end), (start * end).sum(axis=1, keepdims=True)
    across = np.cross(axis, vectors)
    return np.asarray(vectors + across + np.cross(axis, across) / np.maximum(1.0 + cosine, 1e-6))


class Companions:
    """The pieces of a head beside its skin, bound once to the neutral.

    :param points: (n, 3) mm, cuts sewn, in the template's place
    :param triangles: (t, 3)
    :param apertures: of the eyes that have one, Left and Right
    """

    def __init__(
        self, points: FloatArray, triangles: IntArray, pieces: Pieces, motion: Motion, apertures: Mapping[str, Aperture]
    ) -> None:
        self.points, self.pieces, self.motion = points, pieces, motion
        skin = np.zeros(len(points), bool)
        skin[pieces.of(SKIN)] = True
        self._skin = triangles[skin[triangles].all(axis=1)]
        self._normals = point_normals(points, self._skin)
        self._bindings = [self._bound(pieces.of(BROWS, GROWTH), self._skin), *self._layers(triangles)]
        self._bindings += self._lashes(triangles, apertures)
        self._tears = self._between_lids(apertures)
        self._jaw_share = self._shares()
        # gums that are one piece with a tongue follow those of the template that are, else its tongue
        self._laid, inside = float(len(pieces.of(TONGUE)) > 0), motion.inside
        self._model = inside.gums if len(inside.gums) and not self._laid else inside.tongue
        self._tongue, self._tongue_near, self._tongue_weights = self._tongues()

    def delta(self, name: str, skin: FloatArray, share: float = 1.0) -> FloatArray:
        """(n, 3) mm of the whole head for a shape.

        :param skin: (n, 3) mm, as the skin moves; other points of it are not looked at
        :param share: how much of the shape the skin shows: below 1 for inbetweens
        """
        whole = np.zeros_like(self.points)
        rows = self.pieces.of(SKIN)
        whole[rows] = skin[rows]
        normals = self._normals, point_normals(self.points + whole, self._skin)
        for binding in self._bindings:
            whole[binding.rows] = binding.moves(self.points, whole, normals)
        for (upper, lower), weight, globe in self._tears:
            moved = [one.moves(self.points, whole, normals) for one in (upper, lower)]
            mixed = weight[:, None] * moved[0] + (1.0 - weight[:, None]) * moved[1]
            whole[upper.rows] = _outside(self.points[upper.rows], mixed, globe)
        with_jaw = self.motion.jaw(name, self.points)
        if with_jaw is not None:
            whole += share * self._jaw_share[:, None] * with_jaw
        beside = self.motion.tongue(name, self._model)
        if beside is not None and len(self._tongue):
            model = self.motion.inside.points[self._model]
            on, by = (np.einsum("kn,kni->ki", self._tongue_weights, one[self._tongue_near]) for one in (model, beside))
            # what goes far goes from where the template's does: a tongue that lay lower would come through the lip
            far = smoothstep(np.linalg.norm(by, axis=1) / _FAR_MM)[:, None] * self._laid
            whole[self._tongue] += share * (by + far * (on - self.points[self._tongue]))
        for side, kind in (("Left", EYE_LEFT), ("Right", EYE_RIGHT)):
            turn, ball = self.motion.turn(name, side), self.pieces.globes.get(side)
            if turn is not None and ball is not None:
                own = self.pieces.of(kind)
                offsets = self.points[own] - ball.centre
                whole[own] = share * (offsets @ turn.T - offsets)
        return whole

    def _bound(self, rows: IntArray, triangles: IntArray, about: FloatArray | None = None) -> Binding:
        if not len(rows) or not len(triangles):
            return Binding(rows=rows[:0], corners=np.zeros((0, 3), np.int64), shares=np.zeros((0, 3)), about=about)
        places = SurfaceSearch(self.points, triangles).closest(self.points[rows])
        shares = place_shares(places, self.points, triangles)
        return Binding(rows=rows, corners=triangles[places.triangles], shares=shares, about=about)

    def _layers(self, triangles: IntArray) -> list[Binding]:
        """Other layers of the skin by the nearest skin that faces as they do, if any does: the nearest of all may be
        the other lip of a closed mouth."""
        rows = self.pieces.of(LAYER)
        if not len(rows) or not len(self._skin):
            return []
        facing, normals = triangle_normals(self.points, self._skin), point_normals(self.points, triangles)[rows]
        nearest = SurfaceSearch(self.points, self._skin).closest(self.points[rows]).triangles
        if (facing[nearest] * normals).sum() < 0:  # the inner side of a shell
            normals = -normals
        places = facing_places(self.points, self._skin, facing, self.points[rows], normals)
        found, shares = np.isfinite(places.distances), place_shares(places, self.points, self._skin)
        facing_it = Binding(rows=rows[found], corners=self._skin[places.triangles[found]], shares=shares[found])
        return [facing_it, self._bound(rows[~found], self._skin)]

    def _lid(self, eye: Aperture, side: int) -> IntArray:
        """Triangles of the skin at the margin of the upper (1) or lower (-1) lid."""
        at = np.zeros(len(self.points), bool)
        at[eye.near[(eye.side == side) & (eye.distance < _MARGIN_MM * eye.width / 30.0)]] = True
        return self._skin[at[self._skin].all(axis=1)]

    def _lashes(self, triangles: IntArray, apertures: Mapping[str, Aperture]) -> list[Binding]:
        """Lashes by their roots, on the lid that these are nearest to: tips lie nearer to other skin."""
        every, bindings = self.pieces.of(LASHES), []
        lids = [
            (eye.globe.centre, lid)
            for eye in apertures.values()
            for side in (1, -1)
            if len(lid := self._lid(eye, side))
        ]
        if not len(every) or not lids:
            return [self._bound(every, self._skin)]
        found = [SurfaceSearch(self.points, lid).closest(self.points[every]) for _, lid in lids]
        shares = [place_shares(places, self.points, lid) for places, (_, lid) in zip(found, lids, strict=True)]
        faces = by_number(self.pieces.piece[triangles[:, 0]], np.arange(len(triangles)))
        own = np.full(len(self.points), -1)
        for number, at in by_number(self.pieces.piece[every], np.arange(len(every))).items():
            away = [np.sort(one.distances[at])[: max(len(at) // 4, 1)].mean() for one in found]
            best = int(np.argmin(away))
            distances = found[best].distances[at]
            roots = np.flatnonzero(distances <= distances.min() + _ROOT_MM)
            own[every[at]] = np.arange(len(at))
            mine = own[triangles[faces[number]]]
            mine = mine[(mine >= 0).all(axis=1)]
            graph = surface_graph(self.points[every[at]], np.pad(mine, ((0, 0), (0, 1)), constant_values=-1))
            root = nearest_sources(graph, roots)
            root = at[np.where(root < 0, roots[0], root)]
            about, lid = lids[best]
            corners = lid[found[best].triangles[root]]
            bindings.append(Binding(rows=every[at], corners=corners, shares=shares[best][root], about=about))
        return bindings

    def _between_lids(
        self, apertures: Mapping[str, Aperture]
    ) -> list[tuple[tuple[Binding, Binding], FloatArray, Globe]]:
        """Tear lines and shells before an eye: they go with the lid that they are at, and between both."""
        found, every = [], self.pieces.of(TEARS)
        if not len(every) or not apertures:
            return []
        eyes = list(apertures.values())
        near = np.stack([np.linalg.norm(self.points[every] - eye.globe.centre, axis=1) for eye in eyes]).argmin(axis=0)
        for i, eye in enumerate(eyes):
            rows, lids = every[near == i], [self._lid(eye, side) for side in (1, -1)]
            if not len(rows) or not all(map(len, lids)):
                continue
            both = self._bound(rows, lids[0], eye.globe.centre), self._bound(rows, lids[1], eye.globe.centre)
            places = [np.einsum("kc,kci->ki", one.shares, self.points[one.corners]) for one in both]
            up, down = (np.linalg.norm(self.points[rows] - place, axis=1) for place in places)
            found.append((both, smoothstep(down / np.maximum(up + down, 1e-9)), eye.globe))
        return found

    def _shares(self) -> FloatArray:
        """(n,) how much of the jaw's motion points take: lower teeth and tongue all, gums as near as those are."""
        from scipy.spatial import cKDTree

        share = np.zeros(len(self.points))
        share[self.pieces.of(TEETH_LOWER, TONGUE)] = 1.0
        mouth = self.pieces.of(MOUTH)
        if not len(mouth):
            return share
        inside = self.motion.inside
        rows = [self.points[self.pieces.of(kind)] for kind in (TEETH_UPPER, TEETH_LOWER)]
        rows = [
            own if len(own) else inside.points[one] for own, one in zip(rows, (inside.upper, inside.lower), strict=True)
        ]
        if all(map(len, rows)):
            up, down = (cKDTree(row).query(self.points[mouth])[0] for row in rows)
            share[mouth] = smoothstep(1.5 * up / np.maximum(up + down, 1e-9) - 0.25)
        return share

    def _tongues(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Points that are tongue, the template's (k, m) points that each follows, and how much (k, m)."""
        from scipy.spatial import cKDTree

        rows, model = self.pieces.of(TONGUE), self.motion.inside.points[self._model]
        if not len(model):
            return rows[:0], np.zeros((0, 1), np.int64), np.zeros((0, 1))
        count = min(_NEAREST, len(model))
        own = self.points[rows]
        fade: FloatArray = np.ones(len(rows))
        if len(rows):
            # the head's tongue laid into the box of the template's: they may lie elsewhere, and be of another length
            (low, high), (first, last) = ((one.min(axis=0), one.max(axis=0)) for one in (own, model))
            own = first + (own - low) / np.maximum(high - low, 1e-9) * (last - first)
        else:
            rows = self.pieces.of(MOUTH)
            own = self.points[rows]
            if not len(rows):
                return rows, np.zeros((0, 1), np.int64), np.zeros((0, 1))
            fade = 1.0 - smoothstep(cKDTree(model).query(own)[0] / _TONGUE_MM)
        away, near = cKDTree(model).query(own, k=np.arange(1, count + 1))
        weights = 1.0 / (away + 0.5) ** 2
        return rows, near, fade[:, None] * weights / weights.sum(axis=1, keepdims=True)


def _outside(points: FloatArray, moves: FloatArray, globe: Globe) -> FloatArray:
    """Moves (k, 3) of points that stay as far over an eyeball as they were, at least."""
    if globe.surface is None:
        return moves
    ended = points + moves
    short = np.maximum(np.minimum(globe.heights(points), 0.3) - globe.heights(ended), 0.0)
    offsets = ended - globe.centre
    return np.asarray(moves + (short / np.maximum(np.linalg.norm(offsets, axis=1), 1e-9))[:, None] * offsets)


def motion_of(
    neutral: FloatArray,
    triangles: IntArray,
    landmarks: FloatArray,
    deltas: Mapping[str, FloatArray],
    fitted: FloatArray,
) -> Motion:
    """How a template moves what is inside it, found as a head's own pieces are, and by its own shapes.

    :param neutral: (w, 3) mm, whole points of the template, cuts sewn or not
    :param triangles: (t, 3)
    :param landmarks: (68, 3) mm
    :param deltas: name -> (w, 3) mm
    :param fitted: (w, 3) mm, the template on the head
    """
    own = pieces_of(neutral, triangles, landmarks)
    inside = Inside(
        points=neutral,
        balls={"Left": own.of(EYE_LEFT), "Right": own.of(EYE_RIGHT)},
        upper=own.of(TEETH_UPPER),
        lower=own.of(TEETH_LOWER),
        tongue=own.of(TONGUE),
    )
    gums = own.of(MOUTH)
    if not len(inside.tongue) and "tongueOut" in deltas and len(gums):
        # one piece with gums: of it what goes farther than with the jaw
        jaw = Motion(neutral=neutral, deltas=deltas, inside=inside).jaw("tongueOut", neutral[gums])
        beside = np.linalg.norm(deltas["tongueOut"][gums] - (0.0 if jaw is None else jaw), axis=1)
        still = np.linalg.norm(deltas["tongueOut"][gums], axis=1) < _MOVES_MM
        inside = replace(
            inside, gums=gums, tongue=gums[~still & (beside > _TONGUE_SHARE * beside[~still].max(initial=0.0))]
        )
    is_skin = np.zeros(len(neutral), bool)
    is_skin[own.of(SKIN)] = True
    lips = lips_of(neutral, triangles[is_skin[triangles].all(axis=1)], landmarks)
    poses = {} if lips is None else {"": neutral, **{name: neutral + delta for name, delta in deltas.items()}}
    gaps = {name: lips.gaps(pose) for name, pose in poses.items() if lips is not None}
    return Motion(neutral=neutral, deltas=deltas, inside=replace(inside, points=fitted), lips=gaps)
