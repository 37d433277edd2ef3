"""Actors whose faces and expressions are known: ICT identities with more than a database of ICT identities can show.

An actor has all 100 identity modes and a smooth warp that no mode holds; expressions are transferred to the identity,
then vary with the person: smooth gains and turns over the face, part of them shared by all expressions of the actor.
Points are in millimetres, whole: those of all parts of ICT-FaceKit in one index space.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from import_data import shared
from smooth_fields import smooth_field

from facepipe.geometry.deformation_transfer import Transfer
from facepipe.geometry.polygons import point_triangles

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

DATABASE_MODES = 60
_CM = 10.0  # millimetres
_WARP, _WARP_LENGTH = 1.0, 110.0  # mm: RMS of the warp over the face, and its wavelength
_FIELD_LENGTH = 140.0  # mm: wavelength of gains and turns
_SHARED_GAIN, _OWN_GAIN = 0.15, 0.10  # RMS
_SHARED_TURN, _OWN_TURN = 0.10, 0.07  # radians, RMS


@dataclass(frozen=True, kw_only=True)
class Ict:
    """The model, in millimetres."""

    neutral: FloatArray  # (26719, 3)
    identity: FloatArray  # (100, 26719, 3)
    deltas: FloatArray  # (53, 26719, 3)
    names: tuple[str, ...]  # of the deltas
    triangles: IntArray  # (t, 3)
    triangle_faces: IntArray  # (t,)
    part_faces: IntArray  # (17, 2) half-open
    landmarks: IntArray  # (68,)
    full_face: int = 9409  # points 0 to here are the face area
    narrow_face: int = 6706


@functools.cache
def ict() -> Ict:
    """The model; skips the test where it is absent."""
    with np.load(shared("ict_facekit/ict_facekit.npz")) as data:
        counts, indices = data["face_vertex_counts"], data["face_vertex_indices"]
        faces = np.repeat(np.arange(len(counts)), counts - 2)
        return Ict(
            neutral=data["neutral"].astype(np.float64) * _CM,
            identity=data["identity_deltas"].astype(np.float64) * _CM,
            deltas=data["expression_deltas"].astype(np.float64) * _CM,
            names=tuple(data["expression_names"].tolist()),
            triangles=point_triangles(counts, indices),
            triangle_faces=faces,
            part_faces=data["part_face_range"],
            landmarks=data["landmarks_multipie68"],
        )


@functools.cache
def ict_face() -> Ict:
    """The face area alone, at a third of the cost; parts and landmarks are those of the whole."""
    model, end = ict(), ict().full_face
    inside = (model.triangles < end).all(axis=1)
    return replace(
        model,
        neutral=model.neutral[:end],
        identity=model.identity[:, :end],
        deltas=model.deltas[:, :end],
        triangles=model.triangles[inside],
        triangle_faces=model.triangle_faces[inside],
    )


def database_faces(count: int = 60, seed: int = 1) -> FloatArray:
    """(count, n, 3) neutrals of people of the first 60 modes."""
    weights = np.random.default_rng(seed).standard_normal((count, DATABASE_MODES))
    return np.asarray(ict().neutral + np.tensordot(weights, ict().identity[:DATABASE_MODES], axes=1))


class Actor:
    """One person; the same seed gives the same person.

    :param warp: RMS of the warp that no mode holds, in millimetres
    :param model: all of ICT-FaceKit or a part of it; None: all
    """

    def __init__(self, seed: int, *, modes: int = 100, warp: float = _WARP, model: Ict | None = None) -> None:
        self._model, self._seed = model or ict(), seed
        model = self._model
        rng = np.random.default_rng([seed, 0])
        weights = rng.standard_normal(modes)
        person = model.neutral + np.tensordot(weights, model.identity[:modes], axes=1)
        self.neutral = person + warp / np.sqrt(3.0) * smooth_field(model.neutral, _WARP_LENGTH, 3, rng)
        self._gain, self._turn = _personality(model.neutral, rng, _SHARED_GAIN, _SHARED_TURN)

    @functools.cached_property
    def _transfer(self) -> Transfer:
        return Transfer(self.neutral, self._model.triangles, np.zeros(len(self.neutral), bool))

    def transferred(self, name: str) -> FloatArray:
        """(n, 3) delta of an expression as deformation transfer makes it, without the actor's own way."""
        model = self._model
        delta = model.deltas[model.names.index(name)]
        return self._transfer.solve(model.neutral[None], (model.neutral + delta)[None]) - self.neutral

    def shape(self, name: str) -> FloatArray:
        """(n, 3) delta of the actor's own expression."""
        model = self._model
        rng = np.random.default_rng([self._seed, 1, model.names.index(name)])
        gain, turn = _personality(model.neutral, rng, _OWN_GAIN, _OWN_TURN)
        delta = self.transferred(name)
        turned = delta + np.cross(self._turn + turn, delta)
        return np.asarray((1.0 + self._gain + gain)[:, None] * turned)

    def composite(self, weights: dict[str, float]) -> FloatArray:
        """(n, 3) points of a face that shows the expressions with these weights."""
        return self.neutral + np.sum([weight * self.shape(name) for name, weight in weights.items()], axis=0)


def _personality(
    points: FloatArray, rng: np.random.Generator, gain: float, turn: float
) -> tuple[FloatArray, FloatArray]:
    """(n,) gains around 0 and (n, 3) turns."""
    gains = gain * smooth_field(points, _FIELD_LENGTH, 1, rng)[:, 0]
    turns = turn / np.sqrt(3.0) * smooth_field(points, _FIELD_LENGTH, 3, rng)
    return np.clip(gains, -0.5, 0.5), turns


COMPOSITES: dict[str, dict[str, float]] = {
    "jaw_open": {"jawOpen": 0.8},
    "smile": {"mouthSmile_L": 1.0, "mouthSmile_R": 1.0, "cheekSquint_L": 0.6, "cheekSquint_R": 0.6},
    "laugh": {
        "jawOpen": 0.5,
        "mouthSmile_L": 0.8,
        "mouthSmile_R": 0.8,
        "cheekSquint_L": 0.8,
        "cheekSquint_R": 0.8,
        "eyeSquint_L": 0.6,
        "eyeSquint_R": 0.6,
    },
    "brows_up": {
        "browInnerUp_L": 1.0,
        "browInnerUp_R": 1.0,
        "browOuterUp_L": 0.9,
        "browOuterUp_R": 0.9,
        "eyeWide_L": 0.8,
        "eyeWide_R": 0.8,
    },
    "anger": {
        "browDown_L": 1.0,
        "browDown_R": 1.0,
        "noseSneer_L": 0.7,
        "noseSneer_R": 0.7,
        "mouthPress_L": 0.5,
        "mouthPress_R": 0.5,
    },
    "closed_eyes": {"eyeBlink_L": 1.0, "eyeBlink_R": 1.0},
    "squint": {"eyeSquint_L": 1.0, "eyeSquint_R": 1.0, "cheekSquint_L": 0.9, "cheekSquint_R": 0.9},
    "pucker": {"mouthPucker": 1.0},
    "funnel": {"mouthFunnel": 1.0, "jawOpen": 0.3},
    "sad": {
        "mouthFrown_L": 1.0,
        "mouthFrown_R": 1.0,
        "browInnerUp_L": 0.7,
        "browInnerUp_R": 0.7,
        "mouthShrugLower": 0.6,
    },
    "left": {"mouthLeft": 0.9, "jawLeft": 0.8, "eyeBlink_L": 0.7},
    "right": {"mouthRight": 0.9, "jawRight": 0.8, "eyeBlink_R": 0.7},
    "teeth": {"mouthUpperUp_L": 0.9, "mouthUpperUp_R": 0.9, "mouthLowerDown_L": 0.9, "mouthLowerDown_R": 0.9},
    "stretch": {
        "mouthStretch_L": 1.0,
        "mouthStretch_R": 1.0,
        "jawOpen": 0.4,
        "mouthDimple_L": 0.5,
        "mouthDimple_R": 0.5,
    },
    "rolled": {
        "mouthRollUpper": 0.9,
        "mouthRollLower": 0.9,
        "jawForward": 0.6,
        "cheekPuff_L": 0.6,
        "cheekPuff_R": 0.6,
        "mouthShrugUpper": 0.4,
    },
}


def composites(names: Sequence[str] = tuple(COMPOSITES)) -> dict[str, dict[str, float]]:
    """Expressions to scan, as weights of shapes."""
    return {name: COMPOSITES[name] for name in names}
