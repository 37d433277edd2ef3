"""Heads of others whose shapes are known: identities of ICT-FaceKit, remeshed, turned, scaled and far from the origin.

A head has the face, back, neck and inner mouth of ICT-FaceKit with holes for the eyes, and none of its eyeballs and
teeth. Its shapes are those of the head in the box, carried to the identity by deformation transfer on the mesh that
both share, at the points that decimation keeps: each point of the head is one of the identity's. Transfer is on the
identity whole, with the sockets that its lids run into; without them, blinks are others by 4 to 12 %.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scan_actors import ict

from facepipe.geometry.deformation_transfer import Transfer
from facepipe.geometry.similarity import Similarity
from facepipe.heads.assembly import average
from facepipe.verbs.whole_faces import whole_face, whole_points

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

MOVED_MM = 0.3
_SKIN, _WITH_SOCKETS = 13294, 14062  # points of face, back, neck and inner mouth; and with the sockets of the eyes
_CENTRES, _LENGTH = 40, 60.0  # of a warp: places that are moved, and mm that each takes along
_AWAY_MM = 2000.0


@dataclass(frozen=True, kw_only=True)
class TransferHead:
    """One head, in its own unit and place, and what is known of it."""

    points: FloatArray  # (m, 3)
    triangles: IntArray  # (t, 3)
    landmarks: FloatArray  # (68, 3)
    shapes: Mapping[str, FloatArray]  # name -> (m, 3) true deltas
    mm_per_unit: float
    kept: IntArray  # (m,) the identity's point that each is
    identity: FloatArray  # (n, 3) whole points, mm, before decimation, turn and scale


def shape_names() -> tuple[str, ...]:
    """ARKit's shapes that move skin."""
    return tuple(_deltas())


@functools.cache
def _deltas() -> dict[str, FloatArray]:
    """(h, 3) deltas in millimetres of the shapes of the head in the box that move its skin."""
    found = whole_face(average(), "head").deltas
    moving = {name: np.asarray(delta[:_WITH_SOCKETS], np.float64) for name, delta in list(found.items())[:52]}
    return {name: delta for name, delta in moving.items() if np.linalg.norm(delta[:_SKIN], axis=1).max() > MOVED_MM}


@functools.cache
def _neutral() -> FloatArray:
    return np.asarray(whole_points(average())[:_WITH_SOCKETS])


def identity_points(seed: int, warp_mm: float = 0.0) -> FloatArray:
    """(n, 3) whole points of a person of all 100 modes.

    :param warp_mm: RMS over the face of a smooth warp that none of them holds
    """
    rng = np.random.default_rng([seed, 43])
    model = ict()
    person = model.neutral + np.tensordot(rng.standard_normal(len(model.identity)), model.identity, axes=1)
    if not warp_mm:
        return np.asarray(person)
    # Gaussian kernels on the surface: what they move together is as wide as a cheek
    centres = person[rng.choice(_SKIN, _CENTRES, replace=False)]
    squares = ((person[:, None] - centres) ** 2).sum(axis=2)
    moves = np.exp(-squares / (2.0 * (_LENGTH / 2.0) ** 2)) @ rng.standard_normal((_CENTRES, 3))
    rms = np.sqrt((moves[: model.full_face] ** 2).sum(axis=1).mean())
    return np.asarray(person + warp_mm / rms * moves)


def identity_shapes(identity: FloatArray, names: Sequence[str] = (), *, sockets: bool = True) -> dict[str, FloatArray]:
    """Name -> (h, 3) delta of a person's skin, millimetres.

    :param names: shapes that are wanted; none: all
    :param sockets: whether lids are joined to the sockets of the eyes
    """
    model, count = ict(), _WITH_SOCKETS if sockets else _SKIN
    faces = model.triangles[(model.triangles < count).all(axis=1)]
    neutral, own = _neutral()[:count], identity[:count]
    transfer = Transfer(own, faces, np.zeros(count, bool))
    found = {}
    for name in names or shape_names():
        found[name] = transfer.solve(neutral[None], (neutral + _deltas()[name][:count])[None]) - own
    return found


def head(
    seed: int, triangles: int, *, warp_mm: float = 0.0, off_mm: float = 0.0, names: tuple[str, ...] = ()
) -> TransferHead:
    """The head of a seed; the same always.

    :param triangles: about how many
    :param off_mm: how far landmarks lie off, in any direction
    :param names: shapes that are wanted; none: all
    """
    import fast_simplification

    model = ict()
    rng = np.random.default_rng([seed, 44])
    identity = identity_points(seed, warp_mm)
    skin = identity[:_SKIN]
    faces = model.triangles[(model.triangles < _SKIN).all(axis=1)]
    _, _, collapses = fast_simplification.simplify(
        skin.astype(np.float32), faces.astype(np.int32), target_count=triangles, return_collapses=True
    )
    moved, left, into = fast_simplification.replay_simplification(
        skin.astype(np.float32), faces.astype(np.int32), collapses
    )
    kept = _kept(skin, np.asarray(moved, np.float64), np.asarray(into))
    used, left = np.unique(left, return_inverse=True)
    kept, left = kept[used], left.reshape(-1, 3)
    landmarks, moves = identity[model.landmarks], rng.standard_normal((len(model.landmarks), 3))
    landmarks = landmarks + off_mm * moves / np.linalg.norm(moves, axis=1, keepdims=True)
    pose = _pose(rng)
    deltas = identity_shapes(identity, names)
    shapes = {name: pose.scale * delta[kept] @ pose.rotation.T for name, delta in deltas.items()}
    return TransferHead(
        points=pose.apply(skin[kept]),
        triangles=left,
        landmarks=pose.apply(landmarks),
        shapes=shapes,
        mm_per_unit=1.0 / pose.scale,
        kept=kept,
        identity=identity,
    )


def _kept(points: FloatArray, moved: FloatArray, into: IntArray) -> IntArray:
    """(m,) of the points (n, 3) that became one, the nearest to where that lies."""
    off = np.linalg.norm(points - moved[into], axis=1)
    order = np.lexsort((off, into))
    first = np.concatenate([[True], np.diff(into[order]) > 0])
    kept = np.full(len(moved), -1)
    kept[into[order[first]]] = order[first]
    return kept


def _pose(rng: np.random.Generator) -> Similarity:
    """Any turn, a scale from 1/100 to 100 and a place metres away."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    q[:, 0] *= np.sign(np.linalg.det(q))
    scale = 10.0 ** rng.uniform(-2.0, 2.0)
    return Similarity(rotation=q, translation=scale * rng.normal(0.0, _AWAY_MM, 3), scale=scale)
