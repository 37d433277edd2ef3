"""What the connected pieces of a head are: skin, eyeballs, teeth, tongue, lashes, brows, and what only lies around.

Names and weights of a jaw joint come first where they say something; where they don't, places do. Two ways fail: the
piece nearest to an eye (lashes pass for eyeballs, so that a ball must cover the middle of the aperture), and for each
tooth the template's nearest one (rows overlap, so that teeth are sorted by the gap between the head's own rows).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import FitError
from facepipe.geometry.balls import Ball, RadialSurface, fit_ball
from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.geodesics import graph_distances, surface_graph
from facepipe.geometry.polygons import components, distinct_edges, point_areas, triangle_normals
from facepipe.scanning.transfer.lids import EYES, Globe, eye_frame

KINDS = (
    "skin", "left eyeball", "right eyeball", "upper teeth", "lower teeth", "tongue", "inner mouth", "lashes", "brows",
    "tear line", "growth", "layer", "still", "helper",
)  # fmt: skip
(SKIN, EYE_LEFT, EYE_RIGHT, TEETH_UPPER, TEETH_LOWER, TONGUE, MOUTH, LASHES, BROWS, TEARS, GROWTH, LAYER, STILL,
 HELPER) = KINDS  # fmt: skip
_BALLS = {"Left": EYE_LEFT, "Right": EYE_RIGHT}
_WORDS = {  # parts of names, in the order in which they count: an eyelash is no eye, and helpers may be teeth
    LASHES: ("eyelash", "lashes", "^lash$", "wimper", "まつげ", "睫"),
    BROWS: ("eyebrow", "brows", "^brow$", "braue", "まゆ", "眉"),
    TEARS: ("tear", "lacrimal", "occlusion", "eyewet", "eyeao", "eyeblend", "wetness"),
    TONGUE: ("tongue", "zunge", "舌"),
    TEETH_UPPER: ("teeth", "tooth", "^dent$", "^dents$", "dentur", "gums", "^gum$", "gingiva", "歯"),  # of either row
    HELPER: ("helper",),
    STILL: ("glass", "spectacle", "goggle", "helmet", "^hat$", "^cap$", "hair", "髪", "cloth", "shirt", "earring"),
    GROWTH: ("beard", "moustache", "mustache", "stubble", "sideburn"),
}
_ROWS = {TEETH_UPPER: ("upper", "top", "^up$", "maxill"), TEETH_LOWER: ("lower", "bottom", "^low$", "mandib")}
SKIN_MARKS = [*range(17), *range(27, 36), *range(48, 60)]  # jaw, nose and mouth
LAYERED = 0.7  # share of these landmarks that another layer of the skin has, too
_ACROSS = 90.0  # mm between outer corners of eyes, of the face that lengths below are of
_ROUND, _BALL_RADII = 0.12, (0.25, 0.85)  # rms of the radius; radius of the eye's width
_AROUND, _BEFORE = 1.3, 0.25  # of an eye's width: what may be part of an eye, and how far it lies before the lids
_LAYER = 1.3  # radii: layers of an eye lie within
_LONG = 1.6  # times as wide as high: no cornea, but a shell between the lids
_MOUTH_BOX = np.array([[-46.0, -40.0, -90.0], [46.0, 30.0, 4.0]])  # mm from the mouth's middle
_TOOTH, _GAP, _BITE = 17.0, 2.5, 18.0  # mm: largest single tooth; between rows; how far the bite is from the template's
_FEW_TEETH = 4
_THIS_MM = 250.0  # from the mouth's middle: what is farther off belongs to no part of this face, whatever its name
_LEANS = np.linspace(-0.6, 0.6, 25)  # slopes of the head's bite against the template's
_NEAR_BITE = 3.0  # mm: of rows in one piece, whose points leave gaps at crowns and roots too
_SURE = 4.0  # mm from the bite, from which on points of such a piece surely are of their row
_TALL, _BAG, _SLACK = 24.0, 60.0, 4.0  # mm: gums of both rows in one; the mouth's sheet; how far teeth come out of them
_BOTH = 0.15  # share of a piece's points beyond the bite, from which on it holds both rows
_LASH_MM, _ON_SKIN_MM, _GROWTH_MM = 11.0, 8.0, 12.0  # from lids, from the skin
_NEAR_MM = 40.0  # from a point of the skin
_AGAINST, _SHELL = 0.5, 0.25  # cosine of what faces against a template; share of a skin from which on it is a shell
_ROUNDS = 30  # of neighbours' votes on which side of a shell they are
_SEWN_MM, _SEWN_SHARE = 0.5, 0.3  # of a piece's border that lies on the skin


@dataclass(frozen=True, kw_only=True)
class Hints:
    """What a file says of n points, where it says something."""

    names: Sequence[str] = ()  # of meshes, groups and materials
    name: IntArray | None = None  # (n,) into `names`, -1 where there is none
    jaw: FloatArray | None = None  # (n,) weight of the jaw's joint


@dataclass(frozen=True, kw_only=True)
class Inside:
    """Where the inside of the fitted template lies on the head, in whole points of it."""

    points: FloatArray  # (w, 3) mm
    balls: Mapping[str, IntArray]  # Left, Right
    upper: IntArray
    lower: IntArray
    tongue: IntArray
    gums: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # one piece with the tongue; none where apart

    def globe(self, side: str) -> Globe | None:
        """The template's eyeball there, as what lids slide over; None: it has none."""
        rows = self.balls.get(side, np.zeros(0, np.int64))
        if len(rows) < 4:
            return None
        ball = fit_ball(self.points[rows])
        return Globe(centre=ball.centre, radius=ball.radius)


@dataclass(frozen=True, kw_only=True)
class Pieces:
    """What n points of a head are."""

    kind: IntArray  # (n,) into KINDS
    piece: IntArray  # (n,) number of the connected piece
    globes: Mapping[str, Globe]  # Left, Right: the head's own eyeballs
    notes: tuple[str, ...] = ()  # one line each

    def of(self, *kinds: str) -> IntArray:
        """Points that are one of the kinds."""
        return np.flatnonzero(np.isin(self.kind, [KINDS.index(kind) for kind in kinds]))


@dataclass
class _Sorting:
    """A head on the way to its `Pieces`."""

    points: FloatArray
    triangles: IntArray
    landmarks: FloatArray
    piece: IntArray
    local: FloatArray  # (n, 3) mm of an adult: to the left, up, forwards from the mouth's middle
    scale: float
    kind: IntArray
    skin: IntArray = field(default_factory=lambda: np.zeros((0, 3), np.int64))

    def set(self, rows: IntArray | BoolArray, kind: str) -> None:
        self.kind[rows] = KINDS.index(kind)

    def free(self, near: BoolArray) -> list[IntArray]:
        """Points of each piece of which nothing is known yet, and some points are `near` (n,)."""
        open_points = self.kind < 0
        wanted = np.zeros(int(self.piece.max(initial=0)) + 1, bool)
        wanted[self.piece[open_points & near]] = True
        return list(by_number(self.piece, np.flatnonzero(open_points & wanted[self.piece])).values())


def by_number(numbers: IntArray, rows: IntArray) -> dict[int, IntArray]:
    """`rows` by their number: one sort, as heads may have hair of thousands of pieces."""
    order = rows[np.argsort(numbers[rows], kind="stable")]
    own, starts = np.unique(numbers[order], return_index=True)
    return dict(zip(own.tolist(), np.split(order, starts[1:]), strict=True)) if len(rows) else {}


def pieces_of(
    points: FloatArray,
    triangles: IntArray,
    landmarks: FloatArray,
    hints: Hints | None = None,
    inside: Inside | None = None,
    skin: IntArray | None = None,
) -> Pieces:
    """What the pieces of a head are.

    :param points: (n, 3) mm, cuts sewn
    :param triangles: (t, 3)
    :param landmarks: (68, 3) mm
    :param hints: what the file says
    :param inside: of the fitted template; None: bites are looked for about the mouth's middle
    :param skin: points of the piece that is skin, as `outer_skin` has it; None: that which landmarks are nearest to
    """
    hints = hints or Hints()
    pairs = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    piece = components(len(points), pairs)
    middle, axes = landmarks[48:68].mean(axis=0), _face_axes(landmarks)
    scale = max(float(np.linalg.norm(landmarks[45] - landmarks[36])), 1e-6) / _ACROSS
    local = (points - middle) @ axes.T / scale
    kind = np.full(len(points), KINDS.index(STILL))
    kind[triangles.ravel()] = -1  # no surface, no piece
    sorting = _Sorting(points, triangles, landmarks, piece, local, scale, kind)
    said = _said(hints, len(points))
    # of a second head, teeth are no teeth of this one
    said[(np.linalg.norm(local, axis=1) > _THIS_MM) & ~np.isin(said, [KINDS.index(STILL), KINDS.index(HELPER)])] = -1
    for name in (HELPER, LASHES, BROWS, TEARS, GROWTH, STILL):
        sorting.set(said == KINDS.index(name), name)
    free = triangles[kind[triangles[:, 0]] < 0]
    if skin is None:
        place = closest_places(landmarks[SKIN_MARKS], points, free)
        skin = np.flatnonzero(piece == np.bincount(piece[free[place.triangles, 0]]).argmax())
    unnamed = skin[kind[skin] < 0]
    sorting.set(unnamed if len(unnamed) else skin, SKIN)  # one mesh of all may be named after its hair
    sorting.set((kind < 0) & np.isin(piece, piece[skin]), LAYER)
    sorting.skin = triangles[(kind[triangles] == 0).all(axis=1)]
    globes = {side: globe for side in EYES if (globe := _eyeball(sorting, side)) is not None}
    notes = _mouth(sorting, said, hints.jaw, inside)
    _around(sorting)
    sorting.set(kind < 0, STILL)
    layers = len(np.unique(piece[kind == KINDS.index(LAYER)]))
    if layers:
        notes = (*notes, f"other layers of the skin, which go along with it: {layers}")
    return Pieces(kind=kind, piece=piece, globes=globes, notes=notes)


def _face_axes(landmarks: FloatArray) -> FloatArray:
    """(3, 3) rows: to the face's left, up, forwards."""
    right = landmarks[[42, 45]].mean(axis=0) - landmarks[[36, 39]].mean(axis=0)
    right /= max(np.linalg.norm(right), 1e-9)
    up = landmarks[36:48].mean(axis=0) - landmarks[48:68].mean(axis=0)
    up = up - (up @ right) * right
    up /= max(np.linalg.norm(up), 1e-9)
    return np.stack([right, up, np.cross(right, up)])


def _said(hints: Hints, count: int) -> IntArray:
    """(n,) the kind that names give, -1 where they give none; TEETH_UPPER for teeth of a row that no name gives."""
    said = np.full(count, -1)
    if hints.name is None or not len(hints.names):
        return said
    of_names = np.append([named_kind(name)[0] for name in hints.names], -1)
    return np.asarray(of_names[hints.name])


def named_kind(name: str) -> tuple[int, bool]:
    """The kind that a name of a mesh, group or material gives, -1 for none, and whether it gives the row of teeth."""
    words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|[^\W\d_a-zA-Z]+", name)]
    joined = "".join(words)

    def has(part: str) -> bool:
        if part.startswith("^"):
            return any(word == part.strip("^$") for word in words)
        return part in joined

    if words[:1] == ["joint"]:  # cubes that mark joints
        return KINDS.index(HELPER), True
    if all(any(map(has, _WORDS[kind])) for kind in (TONGUE, TEETH_UPPER)):  # several in one
        return -1, False
    for kind, parts in _WORDS.items():
        if any(map(has, parts)) and not (kind == HELPER and "eye" in joined):
            if kind != TEETH_UPPER:
                return KINDS.index(kind), True
            rows = [row for row, own in _ROWS.items() if any(map(has, own))]
            return KINDS.index(rows[0] if len(rows) == 1 else TEETH_UPPER), len(rows) == 1
    return -1, False


def _eyeball(sorting: _Sorting, side: str) -> Globe | None:
    """Marks the pieces of an eyeball, and shells between its lids; None where no ball covers the aperture's middle."""
    middle, axes, width = eye_frame(sorting.landmarks, side)
    local = (sorting.points - middle) @ axes.T / max(width, 1e-9)
    reach = np.abs(local).max(axis=1)
    candidates = [
        rows for rows in sorting.free(reach < _AROUND) if len(rows) >= 4 and reach[rows].max() < 2.0 * _AROUND
    ]
    faces = by_number(sorting.piece[sorting.triangles[:, 0]], np.arange(len(sorting.triangles)))
    areas = point_areas(sorting.points, sorting.triangles)
    best: tuple[float, Ball, IntArray] | None = None
    for rows in candidates:
        if not _covers(local, sorting.triangles[faces[int(sorting.piece[rows[0]])]]):
            continue
        try:
            ball = fit_ball(sorting.points[rows], areas[rows] if areas[rows].any() else None)
        except FitError:
            continue
        spread = np.ptp(local[rows, :2], axis=0).min() * width
        fits = _BALL_RADII[0] * width <= ball.radius <= _BALL_RADII[1] * width and ball.rms <= _ROUND * ball.radius
        behind = (ball.centre - middle) @ axes[2] < 0.25 * ball.radius
        if fits and behind and spread > ball.radius and (best is None or spread > best[0]):
            best = (float(spread), ball, rows)
    if best is None:
        return None
    _, ball, rows = best
    shell = [rows]
    sorting.set(rows, _BALLS[side])
    for other in candidates:
        away = np.linalg.norm(sorting.points[other] - ball.centre, axis=1)
        if other is rows or away.max() > _LAYER * ball.radius:
            continue
        wide, high = np.ptp(local[other, :2], axis=0) * width
        if away.min() > 0.9 * ball.radius and wide > _LONG * high and wide > 0.5 * width:
            sorting.set(other, TEARS)
        elif wide > 0.15 * width and high > 0.15 * width:
            sorting.set(other, _BALLS[side])
            shell.append(other)
    every = np.concatenate(shell)
    away = np.linalg.norm(sorting.points[every] - ball.centre, axis=1)
    outer = sorting.points[every[away > 0.93 * ball.radius]]
    return Globe(centre=ball.centre, radius=ball.radius, surface=RadialSurface(outer, ball.centre))


def _covers(local: FloatArray, triangles: IntArray) -> bool:
    """Whether one of the triangles lies across the aperture's middle, as seen from before the eye, and not before it.

    :param local: (n, 3) widths of the eye along it, up and forwards from the aperture's middle
    """
    corners = local[triangles]
    flat = corners[:, :, :2]
    turns = np.stack(
        [flat[:, i, 0] * flat[:, (i + 1) % 3, 1] - flat[:, i, 1] * flat[:, (i + 1) % 3, 0] for i in range(3)], axis=1
    )
    across = (turns >= 0).all(axis=1) | (turns <= 0).all(axis=1)
    return bool((across & (corners[:, :, 2].max(axis=1) < _BEFORE) & (np.abs(turns).sum(axis=1) > 0)).any())


def _mouth(sorting: _Sorting, said: IntArray, jaw: FloatArray | None, inside: Inside | None) -> tuple[str, ...]:
    """Marks teeth, tongue and what else is in the mouth; what is to be said of it."""
    local = sorting.local
    teeth, tongues = [], []
    inner = ((local > _MOUTH_BOX[0]) & (local < _MOUTH_BOX[1])).all(axis=1)
    inner |= np.isin(said, [KINDS.index(kind) for kind in (TONGUE, TEETH_UPPER, TEETH_LOWER)])
    for rows in sorting.free(inner):
        own, low, high = said[rows[0]], local[rows].min(axis=0), local[rows].max(axis=0)
        middle = local[rows].mean(axis=0)
        named = own in map(KINDS.index, (TONGUE, TEETH_UPPER, TEETH_LOWER))
        if not named and not ((middle > _MOUTH_BOX[0]) & (middle < _MOUTH_BOX[1]) & (high - low < 130.0)).all():
            continue
        if not named and (middle[2] > -1.0 or high[2] > 12.0):  # before the lips: a beard
            continue
        if own == KINDS.index(TONGUE) or (own < 0 and _is_tongue(local[rows])):
            tongues.append(rows)
        else:
            teeth.append(rows)
    boxes = np.array([[pick(local[rows], axis=0) for pick in (np.min, np.max)] for rows in teeth])
    sheets: list[IntArray] = []
    rest: list[IntArray] = []
    for rows, (low, high) in zip(teeth, boxes, strict=True):  # what holds others is gums, or the sheet of the mouth
        tall, sheet = high[1] - low[1], False
        if said[rows[0]] < 0 and tall > _TALL:
            holds = ((boxes[:, 0] > low - _SLACK) & (boxes[:, 1] < high + _SLACK)).all(axis=1)
            sheet = tall > _BAG or holds.sum() > 2
        (sheets if sheet else rest).append(rows)
    teeth = rest
    for rows in tongues:
        sorting.set(rows, TONGUE)
    for rows in sheets:
        sorting.set(rows, MOUTH)
    if not teeth:
        return ("no teeth",)
    _rows(sorting, teeth, said, jaw, inside)
    return ()


def _is_tongue(local: FloatArray) -> bool:
    """Whether a piece is long, in the middle, and filled there, as no row of teeth is."""
    wide, high, deep = np.ptp(local, axis=0)
    middle = local.mean(axis=0)
    if not (abs(middle[0]) < 5.0 and 14.0 < wide < 60.0 and deep > 18.0 and deep > 0.8 * high):
        return False
    back = local[:, 2] < local[:, 2].max() - 0.5 * deep
    core = np.abs(local[:, 0] - middle[0]) < 0.2 * wide
    return bool((back & core).mean() > 0.08)


def _rows(
    sorting: _Sorting, teeth: Sequence[IntArray], said: IntArray, jaw: FloatArray | None, inside: Inside | None
) -> None:
    """Sorts teeth into rows: by the jaw's weights, by names, else each piece by the gap between the head's own rows."""
    lower = KINDS.index(TEETH_LOWER)
    named = any(said[rows[0]] == lower for rows in teeth)
    weighted = jaw is not None and max(jaw[rows].mean() for rows in teeth) > 0.5
    bite, slope = _bite(sorting, inside)
    deep = sorting.local[:, 2] - np.mean([sorting.local[rows, 2].mean() for rows in teeth])
    height = sorting.local[:, 1] - slope * sorting.local[:, 2] - bite
    whole = np.array([bool(np.ptp(sorting.local[rows, 0]) >= _TOOTH) for rows in teeth], bool)
    if (~whole).sum() >= _FEW_TEETH:
        # single teeth: the plane, of those about as steep as the template's, that leaves the largest gap between rows
        means = np.array(
            [[height[rows].mean(), deep[rows].mean()] for rows, row in zip(teeth, whole, strict=True) if not row]
        )
        leans = [(lean, *_largest_gap(means[:, 0] - lean * means[:, 1])) for lean in _LEANS]
        lean, threshold, _ = max(leans, key=lambda one: one[2])
        height = height - lean * deep - threshold
    arches = np.array([height[rows].mean() for rows, row in zip(teeth, whole, strict=True) if row])
    between = 0.0  # rows of one piece each lie apart, wherever the template's bite is
    if len(arches) > 1 and np.ptp(arches) > 2.0 * _GAP:
        between = float((arches.min() + arches.max()) / 2)
    elif len(teeth) == 1 and len(arches):
        # both rows in one: at the template's bite, or halfway, unless they part near there
        both = height[teeth[0]]
        between = 0.0 if inside is not None else float(both.min() + both.max()) / 2.0
        between += _largest_gap(both - between, _NEAR_BITE)[0]
    for rows, row in zip(teeth, whole, strict=True):
        if weighted and jaw is not None:
            own = jaw[rows] > 0.5
            goes = own if 0.1 < own.mean() < 0.9 else np.full(len(rows), own.mean() > 0.5)
        elif named and said[rows[0]] >= 0:
            goes = np.full(len(rows), said[rows[0]] == lower)
        elif row and len(arches) == 1 and _BOTH < (height[rows] < between).mean() < 1.0 - _BOTH:
            goes = _parted(sorting, rows, height[rows] - between)
        else:
            goes = np.full(len(rows), height[rows].mean() < (between if row else 0.0))
        sorting.set(rows[~goes], TEETH_UPPER)
        sorting.set(rows[goes], TEETH_LOWER)


def _bite(sorting: _Sorting, inside: Inside | None) -> tuple[float, float]:
    """Height above the mouth's middle, and slope from front to back, of the template's bite on the head."""
    if inside is None or not len(inside.upper) or not len(inside.lower):
        return 0.0, 0.0
    middle, axes = sorting.landmarks[48:68].mean(axis=0), _face_axes(sorting.landmarks)
    both = [(inside.points[rows] - middle) @ axes.T / sorting.scale for rows in (inside.upper, inside.lower)]
    slope = float(np.mean([np.polyfit(one[:, 2], one[:, 1], 1)[0] for one in both]))
    return float(np.mean([(one[:, 1] - slope * one[:, 2]).mean() for one in both])), slope


def _parted(sorting: _Sorting, rows: IntArray, height: FloatArray) -> BoolArray:
    """(k,) which points of a piece that holds both rows belong to the lower one.

    By the way along the piece to what surely is of either: tips of upper teeth hang before lower ones.
    """
    own = np.full(len(sorting.points), -1)
    own[rows] = np.arange(len(rows))
    mine = own[sorting.triangles]
    mine = mine[(mine >= 0).all(axis=1)]
    seeds = [np.flatnonzero(height > _SURE), np.flatnonzero(height < -_SURE)]
    graph = surface_graph(sorting.points[rows], np.pad(mine, ((0, 0), (0, 1)), constant_values=-1))
    up, down = graph_distances(graph, seeds)
    return np.asarray(np.where(np.isfinite(up) & np.isfinite(down), down < up, height < 0))


def _largest_gap(heights: FloatArray, within: float = _BITE) -> tuple[float, float]:
    """The middle of the largest gap between heights that lies near 0, 0 where there is none, and how large it is."""
    ordered = np.sort(heights)
    gaps, middles = np.diff(ordered), (ordered[1:] + ordered[:-1]) / 2
    gaps = np.where(np.abs(middles) < within, gaps, 0.0)
    if not len(gaps) or gaps.max() <= _GAP:
        return 0.0, 0.0
    return float(middles[gaps.argmax()]), float(gaps.max())


def _around(sorting: _Sorting) -> None:
    """Marks what goes with the skin: lashes, brows, shells at the lids, beards, other layers of the skin, and skin that
    is a piece of its own."""
    from scipy.spatial import cKDTree

    marks, scale = sorting.landmarks, sorting.scale
    if not (sorting.kind < 0).any() or not len(sorting.skin):
        return
    rows = np.flatnonzero(sorting.kind < 0)
    near = rows[np.linalg.norm(sorting.points[rows] - marks.mean(axis=0), axis=1) < 2.0 * _ACROSS * scale]
    away = np.full(len(sorting.points), 1e9)
    # what no point of the skin is near, its triangles aren't either: hair may be most of a head
    bound = _NEAR_MM * scale
    tree = cKDTree(sorting.points[np.unique(sorting.skin)])
    near = near[np.isfinite(tree.query(sorting.points[near], distance_upper_bound=bound)[0])]
    if len(near):
        away[near] = closest_places(sorting.points[near], sorting.points, sorting.skin).distances / scale
    border = _border(sorting.triangles, len(sorting.points))
    lids = np.concatenate([marks[part] for part in EYES.values()])
    to_lids, to_brows = np.full((2, len(sorting.points)), 1e9)
    for distances, at in ((to_lids, lids), (to_brows, marks[17:27])):
        distances[near] = cKDTree(at).query(sorting.points[near])[0] / scale
    eyes_apart = float(np.linalg.norm(lids[:6].mean(axis=0) - lids[6:].mean(axis=0))) / scale
    for own in sorting.free(away < _GROWTH_MM):
        edge = own[border[own]]
        sewn = len(edge) > 0 and (away[edge] < _SEWN_MM).mean() > _SEWN_SHARE
        wide = np.ptp(sorting.local[own, 0])
        if (
            np.percentile(to_lids[own], 90) < 1.6 * _LASH_MM
            and np.median(to_lids[own]) < _LASH_MM
            and away[own].min() < 2.0
        ):
            sorting.set(own, LASHES)
        elif (
            np.median(to_brows[own]) < _LASH_MM
            and np.percentile(away[own], 90) < _ON_SKIN_MM
            and wide < 2.2 * eyes_apart
        ):
            sorting.set(own, BROWS)
        elif _is_layer(sorting, own, away):
            sorting.set(own, LAYER)
        elif sewn or (np.percentile(away[own], 90) < _GROWTH_MM and sorting.local[own, 1].mean() < 15.0):
            sorting.set(own, GROWTH)


def _is_layer(sorting: _Sorting, own: IntArray, away: FloatArray) -> bool:
    """Whether a piece is skin once more, on the skin all over the face: its inner side, or a coarser level of detail.

    :param away: (n,) mm from the skin
    """
    marks = sorting.landmarks
    face = own[np.linalg.norm(sorting.points[own] - marks.mean(axis=0), axis=1) < _ACROSS * sorting.scale]
    if not len(face) or np.percentile(away[face], 90) >= _GROWTH_MM:
        return False
    is_own = np.zeros(len(sorting.points), bool)
    is_own[own] = True
    mine = sorting.triangles[is_own[sorting.triangles[:, 0]]]
    distances = closest_places(marks[SKIN_MARKS], sorting.points, mine).distances
    return bool((distances < _GROWTH_MM * sorting.scale).mean() > LAYERED)


def outer_skin(
    points: FloatArray, triangles: IntArray, skin: IntArray, fitted: FloatArray, faces: IntArray
) -> IntArray:
    """Points of a skin (m,) without those of its inner side, where it is a shell that is joined at its borders.

    There about half of it faces against the template that was fitted to it; of plain skins next to nothing does.

    :param points: (n, 3) mm
    :param triangles: (t, 3), outward
    :param fitted: (r, 3) mm, the template on the head
    :param faces: (f, 3) its triangles
    """
    is_skin = np.zeros(len(points), bool)
    is_skin[skin] = True
    mine = triangles[is_skin[triangles].all(axis=1)]
    nearest = closest_places(points[mine].mean(axis=1), fitted, faces)
    near = nearest.distances < _GROWTH_MM
    facing = (triangle_normals(points, mine) * triangle_normals(fitted, faces)[nearest.triangles]).sum(axis=1)
    against = near & (facing < -_AGAINST)
    if against.sum() < _SHELL * near.sum():
        return skin
    votes = np.zeros(len(points))
    np.add.at(votes, mine[near & (facing > _AGAINST)], 1.0)
    np.add.at(votes, mine[against], -1.0)
    # sheets of lips lie so near to one another that some take the wrong one: what is around them decides
    first, second = np.concatenate([mine[:, :2], mine[:, 1:], mine[:, [2, 0]]]).T
    for _ in range(_ROUNDS):
        around = np.bincount(first, votes[second], len(points)) + np.bincount(second, votes[first], len(points))
        votes = around / max(float(np.abs(around).max()), 1.0)
    return skin[votes[skin] >= 0]


def _border(triangles: IntArray, count: int) -> BoolArray:
    """(n,) points on edges of one triangle."""
    edges, _, uses = distinct_edges(np.concatenate([triangles[:, :2], triangles[:, 1:], triangles[:, [2, 0]]]))
    border = np.zeros(count, bool)
    border[edges[uses == 1].ravel()] = True
    return border
