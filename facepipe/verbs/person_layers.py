"""A person in layers: modes that fit best, where whole and parts lie, identity joints, then points as asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.similarity import fit_similarity
from facepipe.payload.person import LARGEST_WEIGHT, PersonContent, encode_person
from facepipe.verbs.person_basis import Basis, placed, unplaced
from facepipe.verbs.person_modes import WORTH, placement_of

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
# follow, 0.7 is as good as any, 0.25 leaves 0.02 mm more at 1,300 bytes and 1.0 the same; as float16 holds them
_JOINT_STEPS = ((0.125, 0.4), (45 / 128, 0.4), (45 / 64, 0.98), (1.0, 0.98))


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

    def add(name: str, changed: PersonContent, shown: FloatArray | None = None) -> PersonContent:
        shown = basis.rebuilt(changed, name, shaped if len(changed.modes) else None) if shown is None else shown
        layers.append(PersonLayer(name=name, bytes=len(encode_person(changed)), points=shown))
        return changed

    given = weights is not None
    weights, placement = (weights, None) if weights is not None else basis.mode_fit.placed(points)
    shaped = basis.shaped(weights)
    if placement is not None:
        content = add("placement", replace(content, placement=placement))
    if len(weights):
        content = add("modes", replace(content, modes=weights))
    if basis.rigid:
        shown = layers[-1].points if layers else basis.mean
        content = add("parts", replace(content, parts=_parts(basis, content, shown, points)))
    if not layers:
        content = add("basis", content)
    finer: tuple[bytes, FloatArray | None] = b"", None
    if within is not None:
        finer = _points_within(basis, layers[-1].points, points, within)
    joined = None
    if not given and (most is not None or finer[0]):
        joined = _with_joints(basis, content, points, most, layers[-1].points)
    if joined is not None and within is not None:  # joints may take more than they spare
        other = _points_within(basis, joined[1], points, within)
        ways = ((content, finer[0]), (joined[0], other[0]))
        plain, with_joints = (len(encode_person(replace(way, points=data))) for way, data in ways)
        joined, finer = (joined, other) if with_joints < plain else (None, finer)
    if joined is not None:
        content = add("joints", *joined)
    if most is not None:
        finer = _within_bytes(basis, points - layers[-1].points, most - layers[-1].bytes - 3)
    data, offsets = finer
    if data and offsets is not None:
        content = add("points", replace(content, points=data), layers[-1].points + offsets)
    return encode_person(content), tuple(layers)


def _points_within(
    basis: Basis, shown: FloatArray, points: FloatArray, within: float
) -> tuple[bytes, FloatArray | None]:
    """The offsets that bring shown points (n, 3) within a distance, as bytes and as a reader gets them; b"" where they
    are there without.
    """
    off = points - shown
    if np.linalg.norm(off[basis.levels.rows], axis=1).max() <= within:
        return b"", None
    return basis.levels.encode(off, within / _LARGEST_OF_STEP)


def _with_joints(
    basis: Basis, content: PersonContent, points: FloatArray, most: int | None, shown: FloatArray
) -> tuple[PersonContent, FloatArray] | None:
    """The content with identity joints, and with the modes that go with them, and (n, 3) points that it gives; None
    where they are not worth it.

    :param most: bytes of the whole payload; None: as many as there are
    :param shown: (n, 3) points that the content gives without
    """
    joints = basis.joint_fit
    if joints is None:
        return None
    own = points if content.placement is None else unplaced(content.placement, points)
    room = np.inf if most is None else most - len(encode_person(content))
    best, found = None, joints.nearest(own)
    for step, share in _JOINT_STEPS:
        weights, steps = joints.rounded(own, found, step)
        if not steps.any() or np.abs(weights).max(initial=0.0) > LARGEST_WEIGHT:
            return None
        steps = steps[: np.flatnonzero(steps.any(axis=1))[-1] + 1]
        tried = replace(content, modes=weights.astype(np.float16), joints=steps, step=step, parts=content.parts[:0])
        if len(encode_person(replace(tried, parts=content.parts))) - len(encode_person(content)) <= share * room:
            best = tried
            break
    if best is None:
        return None
    shaped = basis.shaped(best.modes)
    near = basis.rebuilt(best, "joints", shaped)
    if basis.rigid:
        best = replace(best, parts=_parts(basis, best, near, points))
        near = basis.rebuilt(best, "joints", shaped)

    def left(found: FloatArray) -> float:
        return float(np.linalg.norm(found - points, axis=1)[basis.fitted].mean())

    return (best, near) if left(near) < WORTH * left(shown) else None


def _parts(basis: Basis, content: PersonContent, shown: FloatArray, points: FloatArray) -> FloatArray:
    """(p, 7) float16 placements of the parts of points (n, 3), where the content shows them without."""
    mean = basis.mean
    if content.placement is not None:
        mean = placed(content.placement, mean, np.zeros(3))
    found = []
    for part in basis.rigid:
        own = (shown if part.with_modes else mean)[part.rows]
        found.append(placement_of(fit_similarity(own, points[part.rows]), own.mean(axis=0)))
    parts = np.array(found, np.float16)
    if np.abs(parts[:, 3:6]).max() < _TURNED:
        parts[:, 3:6] = 0.0  # which takes no bytes
    return parts


def _within_bytes(basis: Basis, off: FloatArray, most: int) -> tuple[bytes, FloatArray | None]:
    """Offsets (n, 3) as near as so many bytes bring them on average, as bytes and as a reader gets them; b"" where
    there is no room for any.
    """
    if most <= 0:
        return b"", None
    best: tuple[bytes, FloatArray | None]
    care = np.where(np.isin(np.arange(len(off)), basis.fitted), 1.0, _UNSEEN)
    sizes, weights = basis.levels.sizes, care / care.sum()
    middle = int(np.searchsorted(np.cumsum(sizes), _POINTS_A_BYTE * most))

    def score(left: FloatArray) -> float:
        apart = np.linalg.norm(left, axis=1)
        return float(apart @ weights + _LARGEST * apart[care == 1.0].max(initial=0.0))

    best, nearest, step = (b"", None), score(off), _FIRST
    last = len(sizes) - 1
    # all points in large steps first: of somebody's lips alone, which modes leave 4.5 mm off, 130 bytes bring it to 0.4
    for coarse in sorted({last, *range(min(middle + 2, last + 1))}, reverse=True):
        low, high, before = _FINEST, _COARSEST, nearest
        for _ in range(_TRIES):
            data, got = basis.levels.encode(off, step, coarse, care)
            if len(data) > most:
                low = step
            else:
                high, near = step, score(got - off)
                if near < nearest:
                    best, nearest = (data, got), near
                if len(data) > _FULL * most:
                    break
            # bytes go about as steps go back, to where they will do (aimed at `most` itself it ends a byte above, and
            # the finest points are left out); the middle of what is left where that leads out of it
            step *= len(data) / (0.5 * (_FULL + 1.0) * most)
            step = step if low < step < high else float(np.sqrt(low * high))
        if coarse < middle and nearest == before:
            break  # fewer points in finer steps come nearer for a while, where modes leave little
    return best
