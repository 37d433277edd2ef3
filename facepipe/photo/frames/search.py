"""The face in a clip: looked at in frames that are spread over it, each the sharpest of those around it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.networks import FoundFace, find_landmarks, follow_face
from facepipe.photo.frames.clip import Clip, Frame
from facepipe.photo.frames.look import Look, look_at, sharpness

MOST_LOOKS = 48
_MOST_PIXELS = 1080  # of the shorter side of a frame as it is looked at
_AROUND, _REACH = 7, 0.12  # frames that the sharpest of is looked at, and how far from the middle one, seconds


@dataclass(frozen=True, kw_only=True)
class Looks:
    """What was seen in a clip."""

    looks: tuple[Look, ...]
    tried: int  # moments of the clip
    frames: int  # that it has
    seconds: float


def looks_in(clip: Clip, done: Callable[[], object]) -> Looks:
    """The face of a clip at `MOST_LOOKS` moments at most; that of several which is largest where it is first seen.

    :param done: called after each moment, `moments(clip)` times or a few less
    :raises InputError: no face, or a clip that can't be read
    """
    looks, before, last, tried = list[Look](), None, None, 0
    for group, latest in _groups(clip):
        last = latest
        face, look = _look(group, before)
        before = face or before
        looks += [] if look is None else [look]
        tried += 1
        done()
    if last is None:
        raise InputError(clip.path, "no frame that can be decoded, expected a video")
    if not looks:
        raise InputError(clip.path, f"no face in any of {tried} frames, expected a person's, whole and large enough")
    return Looks(looks=tuple(looks), tried=tried, frames=last.number + 1, seconds=last.time)


def moments(clip: Clip) -> int:
    """Moments that a clip is looked at."""
    return min(clip.count, MOST_LOOKS)


def _groups(clip: Clip) -> Iterator[tuple[list[Frame], Frame]]:
    """For each moment the frames around its middle, thinned, and the last frame so far."""
    length, group, last, slot = clip.count / moments(clip), list[Frame](), None, 0
    for last in clip.frames():
        if int(last.number / length) != slot:
            if group:
                yield _thinned(group), last
            group, slot = [], int(last.number / length)
        if abs(last.number + 0.5 - (slot + 0.5) * length) <= _AROUND * 4:  # of 240 frames a second too
            group.append(last)
    if group and last is not None:
        yield _thinned(group), last


def _thinned(group: list[Frame]) -> list[Frame]:
    """At most so many of them, evenly, the middle one first."""
    middle = group[len(group) // 2]
    near = [frame for frame in group if abs(frame.time - middle.time) <= _REACH and frame is not middle]
    picked = np.unique(np.linspace(0, len(near) - 1, min(_AROUND - 1, len(near))).round().astype(int)) if near else ()
    return [middle, *(near[int(index)] for index in picked)]


def _look(group: list[Frame], before: FoundFace | None) -> tuple[FoundFace | None, Look | None]:
    """The face in the middle frame, and the look at it in the sharpest."""
    middle = group[0]
    picture = _pixels(middle)
    face = _found(picture, before)
    if face is None:
        return None, None
    best, sharpest = (middle, picture), _sharpness(picture, face)
    for frame in group[1:]:
        other = _pixels(frame)
        sharp = _sharpness(other, face)
        if sharp > sharpest:
            best, sharpest = (frame, other), sharp
    frame, picture = best
    nearer = follow_face(picture, face.landmarks)
    return face, None if nearer is None else look_at(picture, nearer, frame.number, frame.time)


def _pixels(frame: Frame) -> FloatArray:
    return frame.picture(_MOST_PIXELS).astype(np.float32) / np.float32(255)


def _found(picture: FloatArray, before: FoundFace | None) -> FoundFace | None:
    """The face that was seen before, else the largest."""
    followed = None if before is None else follow_face(picture, before.landmarks, closer=False)
    if followed is not None:
        return followed
    return max(find_landmarks(picture), key=lambda face: float(np.prod(np.ptp(face.landmarks, axis=0))), default=None)


def _sharpness(picture: FloatArray, face: FoundFace) -> float:
    try:
        return sharpness(picture, face.landmarks)
    except InputError:
        return 0.0
