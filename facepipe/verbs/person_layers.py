"""A person in layers: modes that fit best, where whole and parts lie, identity joints, then points as asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.similarity import Similarity, fit_similarity
from facepipe.payload.person import LARGEST_WEIGHT, PersonContent, encode_person
from facepipe.rig.trs import quaternions
from facepipe.verbs.person_basis import Basis, placed, unplaced

_RIDGE = 1e-9  # of each mode's square
_STEPS = 5  # in which modes and placement settle
_WORTH = 0.8  # of what modes leave, below which the placement of the whole is worth its bytes
_LARGEST_OF_STEP = 0.92  # of a step: how far off a point is at most, 0.53 on each axis
_TURNED = 2e-3  # of a quaternion: a part of 12 mm is off by 0.05 mm without its turn
_FINEST, _COARSEST = 0.01, 100.0  # millimetres of a step
_FIRST, _TRIES, _FULL = 1.0, 10, 0.985  # millimetres; of each coarse level; of the bytes that are there, which will do
_UNSEEN = 0.3  # how much it matters where points are that modes are not fitted to, the mouth's inside: half the bytes
_LARGEST = (
    0.06  # of the farthest point counts beside the mean: at 0.02 points are 0.6 mm off at 10,000 bytes, here 0.26
)
_POINTS_A_BYTE = 1.5  # of the finest level that is sent, about
# millimetres of a step of the joints, and the share of the bytes that are left which they may take: where points
# follow, 0.7 is as good as any, 0.25 leaves 0.02 mm more at 1,300 bytes and 1.0 the same
_JOINT_STEPS = ((0.125, 0.4), (0.35, 0.4), (0.7, 0.98), (1.0, 0.98))


@dataclass(frozen=True, kw_only=True)
class PersonLayer:
    """The payload up to a layer."""

    name: str
    bytes: int
    points: FloatArray  # (n, 3) that it gives


def encode_points(
    basis: Basis,
    points: FloatArray,
    *,
    within: float | None = None,
    most: int | None = None,
    weights: FloatArray | None = None,
) -> tuple[bytes, tuple[PersonLayer, ...]]:
    """The payload of whole points (n, 3) in millimetres, and what each of its layers gives.

    :param within: how far off a point may be; None: as near as `most` bytes allow; neither: modes and parts alone
    :param weights: of the first modes, without a placement of the whole; None: those that come nearest, with one if
        that is worth its bytes
    """
    content = PersonContent(basis=basis.digest, modes=np.zeros(0, np.float16))
    layers: list[PersonLayer] = []

    def add(name: str, changed: PersonContent) -> PersonContent:
        data = encode_person(changed)
        layers.append(PersonLayer(name=name, bytes=len(data), points=basis.rebuilt(changed, name)))
        return changed

    given = weights is not None
    weights, placement = (weights, None) if weights is not None else modes_and_placement(basis, points)
    if placement is not None:
        content = add("placement", replace(content, placement=placement))
    if len(weights):
        content = add("modes", replace(content, modes=weights))
    if basis.rigid:
        content = add("parts", replace(content, parts=_parts(basis, content, points)))
    if not layers:
        content = add("basis", content)
    joined = None
    if not given and (most is not None or (within is not None and _points_within(basis, content, points, within))):
        joined = _with_joints(basis, content, points, most)
    if joined is not None and within is not None:  # joints may take more than they spare
        ways = [replace(way, points=_points_within(basis, way, points, within)) for way in (content, joined)]
        joined = joined if len(encode_person(ways[1])) < len(encode_person(ways[0])) else None
    if joined is not None:
        content = add("joints", joined)
    if within is not None:
        data = _points_within(basis, content, points, within)
    elif most is not None:
        data = _within_bytes(basis, points - layers[-1].points, most - layers[-1].bytes - 3)
    else:
        data = b""
    if data:
        content = add("points", replace(content, points=data))
    return encode_person(content), tuple(layers)


def _points_within(basis: Basis, content: PersonContent, points: FloatArray, within: float) -> bytes:
    """The points that bring all to a distance; b"" where they are there without."""
    off = points - basis.rebuilt(content, "points")
    if np.linalg.norm(off[basis.levels.rows], axis=1).max() <= within:
        return b""
    return basis.levels.encode(off, within / _LARGEST_OF_STEP)[0]


def nearest_modes(basis: Basis, points: FloatArray) -> FloatArray:
    """(k,) float16 weights of the modes that come nearest to points (n, 3) where these lie."""
    rows, count = basis.fitted, len(basis.modes)
    modes = basis.modes[:, rows].reshape(count, 3 * len(rows)).astype(np.float64)
    found = _solved(modes, (points - basis.mean)[rows].ravel())
    return np.clip(found, -LARGEST_WEIGHT, LARGEST_WEIGHT).astype(np.float16)


def _solved(ways: FloatArray, to: FloatArray) -> FloatArray:
    squares = ways @ ways.T
    squares[np.diag_indices(len(ways))] += _RIDGE * squares.diagonal()
    return np.asarray(np.linalg.solve(squares, ways @ to))


def modes_and_placement(basis: Basis, points: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """(k,) float16 weights of the modes that come nearest to points (n, 3), and (7,) float32 where the whole lies if
    that is worth its bytes: blends and scans may stand anywhere.

    Modes move, turn and scale faces too: each step solves for them with the seven ways that a whole can go (Gauss and
    Newton), where modes and placement in turns are 0.1 mm off after 20.
    """
    rows, count = basis.fitted, len(basis.modes)
    modes = basis.modes[:, rows].reshape(count, 3 * len(rows)).astype(np.float64)

    def nearest(to: FloatArray, ways: FloatArray) -> FloatArray:
        return _solved(np.vstack([modes, ways]), (to - basis.mean)[rows].ravel())[:count]

    def left(shown: FloatArray) -> float:
        return float(np.sqrt(((shown - points)[rows] ** 2).mean()))

    plain = nearest(points, np.zeros((0, 3 * len(rows))))
    weights: FloatArray = np.zeros(count)
    for _ in range(_STEPS if count else 1):
        shown = basis.shaped(weights)[rows]
        found = fit_similarity(shown, points[rows])
        weights = nearest(found.undo(points), _ways(shown))
    found = fit_similarity(basis.shaped(weights)[rows], points[rows])
    worth = left(found.apply(basis.shaped(weights))) < _WORTH * left(basis.shaped(plain))
    if not worth and np.abs(plain).max(initial=0.0) <= LARGEST_WEIGHT:
        return plain.astype(np.float16), None
    return weights.astype(np.float16), _placement(found, np.zeros(3)).astype(np.float32)


def _ways(points: FloatArray) -> FloatArray:
    """(7, 3 m) how points (m, 3) go where a whole moves, turns and grows."""
    moves = np.repeat(np.eye(3)[:, None], len(points), axis=1)
    off = points - points.mean(axis=0)
    turns = [np.cross(axis, off) for axis in np.eye(3)]
    return np.array([*moves, *turns, off]).reshape(7, -1)


def _with_joints(basis: Basis, content: PersonContent, points: FloatArray, most: int | None) -> PersonContent | None:
    """The content with identity joints, and with the modes that go with them; None where they are not worth it.

    :param most: bytes of the whole payload; None: as many as there are
    """
    joints = basis.joint_fit
    if joints is None:
        return None
    own = points if content.placement is None else unplaced(content.placement, points)
    room = np.inf if most is None else most - len(encode_person(content))
    best = None
    for step, share in _JOINT_STEPS:
        weights, steps = joints(own, step)
        if not steps.any() or np.abs(weights).max(initial=0.0) > LARGEST_WEIGHT:
            return None
        steps = steps[: np.flatnonzero(steps.any(axis=1))[-1] + 1]
        tried = replace(content, modes=weights.astype(np.float16), joints=steps, step=step)
        if len(encode_person(tried)) - len(encode_person(content)) <= share * room:
            best = tried
            break
    if best is None:
        return None
    if basis.rigid:
        best = replace(best, parts=_parts(basis, replace(best, parts=content.parts[:0]), points))

    def left(shown: PersonContent) -> float:
        return float(np.linalg.norm(basis.rebuilt(shown, "joints") - points, axis=1)[basis.fitted].mean())

    return best if left(best) < _WORTH * left(content) else None


def _parts(basis: Basis, content: PersonContent, points: FloatArray) -> FloatArray:
    """(p, 7) float16 placements of the parts."""
    shown, mean = basis.rebuilt(content, "parts"), basis.mean
    if content.placement is not None:
        mean = placed(content.placement, mean, np.zeros(3))
    found = []
    for part in basis.rigid:
        own = (shown if part.with_modes else mean)[part.rows]
        found.append(_placement(fit_similarity(own, points[part.rows]), own.mean(axis=0)))
    parts = np.array(found, np.float16)
    if np.abs(parts[:, 3:6]).max() < _TURNED:
        parts[:, 3:6] = 0.0  # which takes no bytes
    return parts


def _placement(similarity: Similarity, about: FloatArray) -> FloatArray:
    """(7,) numbers of `PersonContent` for a similarity."""
    turn = quaternions(similarity.rotation)
    turn = turn * (1.0 if turn[3] >= 0 else -1.0)
    return np.concatenate([similarity.apply(about) - about, turn[:3], [np.log(similarity.scale)]])


def _within_bytes(basis: Basis, off: FloatArray, most: int) -> bytes:
    """Points (n, 3) as near as so many bytes bring them on average; b"" where there is no room for any."""
    if most <= 0:
        return b""
    care = np.where(np.isin(np.arange(len(off)), basis.fitted), 1.0, _UNSEEN)
    sizes, weights = basis.levels.sizes, care / care.sum()
    middle = int(np.searchsorted(np.cumsum(sizes), _POINTS_A_BYTE * most))

    def score(left: FloatArray) -> float:
        apart = np.linalg.norm(left, axis=1)
        return float(apart @ weights + _LARGEST * apart[care == 1.0].max(initial=0.0))

    best, nearest, step = b"", score(off), _FIRST
    for coarse in range(min(middle + 1, len(sizes) - 1), -1, -1):
        low, high, before = _FINEST, _COARSEST, nearest
        for _ in range(_TRIES):
            data, got = basis.levels.encode(off, step, coarse, care)
            if len(data) > most:
                low = step
            else:
                high, near = step, score(got - off)
                if near < nearest:
                    best, nearest = data, near
                if len(data) > _FULL * most:
                    break
            # bytes go about as steps go back, to where they will do (aimed at `most` itself it ends a byte above, and
            # the finest points are left out); the middle of what is left where that leads out of it
            step *= len(data) / (0.5 * (_FULL + 1.0) * most)
            step = step if low < step < high else float(np.sqrt(low * high))
        if coarse < middle and nearest == before:
            break  # fewer points in finer steps come nearer for a while, where modes leave little
    return best
