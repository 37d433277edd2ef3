"""Carried shapes made shapes of the whole head: its own blinks, what goes with the skin, and what can't be, said."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.contacts import Grid
from facepipe.geometry.geodesics import graph_distances, surface_graph
from facepipe.geometry.polygons import flipped_triangles
from facepipe.scanning.transfer.companions import Companions, Motion
from facepipe.scanning.transfer.lids import (
    EYES,
    NO_SOCKET,
    PAINT,
    SHUT,
    Aperture,
    LidFigures,
    aperture_of,
    closed,
    lid_figures,
    slid,
)
from facepipe.scanning.transfer.lips import LipFigures, Lips, as_shut, half_met, lips_of, met
from facepipe.scanning.transfer.lips import figures as lip_figures
from facepipe.scanning.transfer.pieces import MOUTH, SKIN, TONGUE, Pieces

MADE, AS_CARRIED, NO_TONGUE, SEALED = "made", "made as carried", "no tongue", "lips are sealed"
_LIDS = ("eyeBlink", "eyeWide", "eyeSquint", "eyeLookUp", "eyeLookDown", "eyeLookIn", "eyeLookOut")
_BY_LIDS = ("eyeBlink", "eyeWide", "eyeLookUp", "eyeLookDown", "eyeLookIn", "eyeLookOut")  # nothing without lids
_OPENS = ("jawOpen", "mouthClose")
_SEALED = 1.6  # times as far along the surface as straight, from above the mouth to below it
_MOUTH_MM = 80.0  # from the mouth's middle: surface on which that way is looked for
_TURNS = (0.0, 0.66, -0.66)  # radians about Y: from where a face is seen
_FACE_MM = 150.0  # from the middle of the landmarks: a body is not looked at


def is_by_lids(name: str) -> bool:
    """Whether a shape is nothing without lids: blinks, looks and wide eyes, of either side."""
    return any(name == f"{stem}{side}" for stem in _BY_LIDS for side in EYES)


@dataclass(frozen=True, kw_only=True)
class ShapeVerdict:
    """What became of a shape."""

    name: str
    verdict: str  # "made", "made as carried: why", "not made: why"
    flips: int = 0  # triangles of the skin, seen in the neutral, that turn over; of mouthClose with jawOpen
    lids: LidFigures | None = None  # of blinks that were made
    lips: LipFigures | None = None  # of mouthClose, with jawOpen

    @property
    def made(self) -> bool:
        """Whether the head has the shape."""
        return not self.verdict.startswith("not made")


@dataclass(frozen=True, kw_only=True)
class Finished:
    """Shapes of n points of a head."""

    deltas: Mapping[str, FloatArray]  # name -> (n, 3) mm; shapes that are not made are left out
    inbetweens: Mapping[str, Mapping[float, FloatArray]]  # name -> weight -> (n, 3) mm: blinks go around eyeballs
    verdicts: tuple[ShapeVerdict, ...]
    notes: tuple[str, ...]  # of the head, one line each


def finished(
    points: FloatArray,
    triangles: IntArray,
    landmarks: FloatArray,
    pieces: Pieces,
    motion: Motion,
    carried: Mapping[str, FloatArray],
    jaw: FloatArray | None = None,
) -> Finished:
    """The shapes of a whole head.

    :param points: (n, 3) mm, cuts sewn, in the template's place
    :param triangles: (t, 3) facing outward
    :param landmarks: (68, 3) mm, none unknown: those of the fitted template stand in
    :param carried: name -> (n, 3) mm as the skin moves by the template; ARKit's names
    :param jaw: (n, 3) mm of jawOpen, where that is not carried
    """
    is_skin = np.zeros(len(points), bool)
    is_skin[pieces.of(SKIN)] = True
    skin = triangles[is_skin[triangles].all(axis=1)]
    found = {side: _aperture(points, skin, landmarks, pieces, motion, side) for side in EYES}
    eyes = {side: eye for side, eye in found.items() if isinstance(eye, Aperture)}
    companions = Companions(points, triangles, pieces, motion, eyes)
    sealed = mouth_is_sealed(points, skin, landmarks)
    lips = None if sealed else lips_of(points, skin, landmarks)
    jaw = carried.get("jawOpen", jaw)
    seen = seen_triangles(points, skin, landmarks)
    deltas: dict[str, FloatArray] = {}
    inbetweens: dict[str, Mapping[float, FloatArray]] = {}
    verdicts = []
    for name, delta in carried.items():
        verdict, moved = _of_eye(points, skin, found, name, delta)
        if name == "tongueOut" and not len(pieces.of(TONGUE, MOUTH)):
            verdict = f"not made: {NO_TONGUE}"
        elif name in _OPENS and sealed:
            verdict = f"{AS_CARRIED}: {SEALED}"
        elif lips is not None:
            moved = _of_lips(points, lips, motion, name, moved, jaw)
        made = ShapeVerdict(name=name, verdict=verdict)
        if made.made:
            whole = companions.delta(name, moved.delta)
            deltas[name] = whole
            # mouthClose is for a jaw that is open: alone it presses a closed mouth together
            ended = points + whole + (jaw if name == "mouthClose" and jaw is not None else 0.0)
            made = replace(made, flips=int(flipped_triangles(points, ended, seen).sum()))
            if moved.ways:
                inbetweens[name] = {way: companions.delta(name, own, way) for way, own in moved.ways.items()}
            if moved.lids:
                side = next(one for one in EYES if name.endswith(one))
                made = replace(made, lids=lid_figures(points, whole, skin, eyes[side]))
            elif name == "mouthClose" and lips is not None and jaw is not None:
                made = replace(made, lips=lip_figures(points, lips, jaw, whole, moved.ways.get(0.5)))
        verdicts.append(made)
    notes = [*pieces.notes, *([SEALED] if sealed else [])]
    notes += [f"{side.lower()} eye: {eye}" for side, eye in found.items() if eye in (SHUT, PAINT, NO_SOCKET)]
    return Finished(deltas=deltas, inbetweens=inbetweens, verdicts=tuple(verdicts), notes=tuple(notes))


class _Moved(NamedTuple):
    """A motion of n points of skin."""

    delta: FloatArray  # (n, 3) mm
    ways: Mapping[float, FloatArray] = {}  # weight -> (n, 3) mm
    lids: bool = False  # a blink of the head's own lids


def _of_eye(
    points: FloatArray, skin: IntArray, found: Mapping[str, Aperture | str], name: str, delta: FloatArray
) -> tuple[str, _Moved]:
    """The verdict on a shape, and its motion with that of the head's own lids."""
    side = next((one for one in EYES if name.endswith(one)), "")
    stem = name.removesuffix(side)
    if stem not in _LIDS or not side:
        return MADE, _Moved(delta)
    eye = found[side]
    if isinstance(eye, Aperture) and stem == "eyeBlink":
        blink = closed(points, skin, eye, delta)
        return MADE, _Moved(blink.delta, blink.inbetweens, lids=True)
    if isinstance(eye, Aperture):
        return MADE, _Moved(slid(points, skin, eye, delta))
    # lids that a template only stretches over an eye close nothing
    return f"{'not made' if stem in _BY_LIDS else AS_CARRIED}: {eye}", _Moved(delta)


def _of_lips(
    points: FloatArray, lips: Lips, motion: Motion, name: str, moved: _Moved, jaw: FloatArray | None
) -> _Moved:
    """The motion with lips that meet as those of the template do."""
    if name == "mouthClose" and jaw is not None:
        close = met(points, lips, jaw, moved.delta)
        half = half_met(points, lips, jaw, close)
        return _Moved(close, {} if half is None else {0.5: half})
    if name in _OPENS or name not in motion.lips or moved.lids:
        return moved
    return _Moved(as_shut(points, lips, moved.delta, motion.lips[""], motion.lips[name]), moved.ways)


def _aperture(
    points: FloatArray, skin: IntArray, landmarks: FloatArray, pieces: Pieces, motion: Motion, side: str
) -> Aperture | str:
    globe = pieces.globes.get(side) or motion.inside.globe(side)
    return PAINT if globe is None else aperture_of(points, skin, landmarks, side, globe)


def mouth_is_sealed(points: FloatArray, skin: IntArray, landmarks: FloatArray) -> bool:
    """Whether the skin goes on from lip to lip: the way from above the mouth to below it is about straight.

    Outer landmarks of the lips: inner ones may be one point of a coarse mesh.

    :param points: (n, 3) mm
    :param skin: (t, 3)
    """
    used = np.unique(skin)
    used = used[np.linalg.norm(points[used] - landmarks[48:68].mean(axis=0), axis=1) < _MOUTH_MM]
    ends = landmarks[[50, 51, 52]], landmarks[[58, 57, 56]]
    if not len(used):
        return False
    place = np.full(len(points), -1)
    place[used] = np.arange(len(used))
    near = place[skin]
    near = near[(near >= 0).all(axis=1)]
    graph = surface_graph(points[used], np.pad(near, ((0, 0), (0, 1)), constant_values=-1))
    above, below = (
        np.array([np.linalg.norm(points[used] - mark, axis=1).argmin() for mark in marks]) for marks in ends
    )
    along = graph_distances(graph, [above[[i]] for i in range(3)])[np.arange(3), below]
    straight = np.linalg.norm(points[used][above] - points[used][below], axis=1)
    return bool((along / np.maximum(straight, 1e-9)).max() < _SEALED)


def seen_triangles(points: FloatArray, triangles: IntArray, landmarks: FloatArray) -> IntArray:
    """(k, 3) of `triangles` (t, 3) those of the face that are seen from the front or from between front and side.

    :param points: (n, 3) mm, looking along +Z, Y up
    :param landmarks: (68, 3) mm
    """
    near = np.linalg.norm(points - landmarks.mean(axis=0), axis=1) < _FACE_MM
    triangles = triangles[near[triangles].all(axis=1)]
    seen = np.zeros(len(triangles), bool)
    for turn in _TURNS if len(triangles) else ():
        sine, cosine = np.sin(turn), np.cos(turn)
        view = points @ np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]]).T
        number = Grid.of(view, triangles).first(triangles)[1]
        seen[number[number >= 0]] = True
    return triangles[seen]
