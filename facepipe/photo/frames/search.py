"""The face in a clip: looked at in frames spread over it, chosen by sharpness and side, and written as photos."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_laplace

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.face_crops import face_crop
from facepipe.geometry.landmarks import face_size, turned_view
from facepipe.heads.asset import asset
from facepipe.networks import FoundFace, find_landmarks, follow_face
from facepipe.networks.files import sample_crop
from facepipe.photo.fit import check_face, own_landmarks, read_photo
from facepipe.photo.frames.clip import Clip, Frame
from facepipe.photo.frames.report import ChosenFrame, ChosenFramesReport
from facepipe.pictures import save_png
from facepipe.rig.torch import torch

_SIZE = 192  # pixels a side of the crop that sharpness is measured in, of which brows to chin are 0.6
_FACE = slice(round(0.18 * _SIZE), round(0.82 * _SIZE))
_GRAIN = 1.2  # crop pixels: finer detail is mostly noise
_LUMA = np.array((0.2126, 0.7152, 0.0722))
_CONTOUR = 17  # of the landmarks; that of a turned head is elsewhere on it
_LIDS = (((37, 41), (38, 40)), ((43, 47), (44, 46)))  # upper, lower
_LIPS = ((61, 67), (62, 66), (63, 65))
_LEAST_CONFIDENCE = 0.01
_ALIKE = 6  # looks from nearly the same side, or a quarter of all, that each one is measured by
# Degrees of another side that outweigh a fault: a face without any detail, shut eyes, a mouth open by a tenth of the
# face's size more than others, landmarks one unit of error less sure than others; and less sure than a side view's.
_BLURRED, _SHUT, _OPEN, _DOUBTED, _UNSURE = 80.0, 40.0, 30.0, 2.0, 4.0
_OPEN_BY, _SIDE_ERROR = 0.1, 6.0
_SHARP, _AWAKE = 0.95, 0.8  # shares of the others' sharpness and of their lids' height that are no fault
_UP = 1.5  # what a degree up or down counts: heads nod less than they turn
_ANOTHER = 4.0  # degrees: a look from nearer by shows nothing new
MOST_LOOKS = 48
_MOST_PIXELS = 1080  # of the shorter side of a frame as it is looked at
_AROUND, _REACH = 7, 0.12  # frames that the sharpest of is looked at, and how far from the middle one, seconds
_ONE_SIDE = 15.0  # degrees between the two farthest frames


@dataclass(frozen=True, kw_only=True)
class Look:
    """A face in a frame."""

    number: int  # of the frame
    time: float  # seconds
    yaw: float  # radians, to the person's left
    pitch: float  # radians, up
    sharpness: float  # of detail in the face, over its brightness
    lids: float  # how far they are open, over the face's size: the mean of both eyes
    lips: float  # how far they are apart, likewise
    error: float  # to expect of a landmark, over that of one that is sure


def look_at(picture: FloatArray, face: FoundFace, number: int, time: float) -> Look | None:
    """The face of a picture (h, w, 3) of sRGB 0..1; None where its landmarks are no face's, or it is cut off."""
    marks, (height, width) = face.landmarks, picture.shape[:2]
    try:
        check_face(marks, "")
        sharp = sharpness(picture, marks)
    except InputError:
        return None
    if (marks < 0).any() or (marks > (width, height)).any():
        return None
    head = asset()
    view = turned_view(head.points[head.landmarks][_CONTOUR:], marks[_CONTOUR:])
    right, down = view / np.linalg.norm(view, axis=1, keepdims=True)
    # a face that looks at the camera looks along its own z; the camera, from the head, is where `ahead` points
    ahead = np.cross(right, -down)
    size = face_size(marks)
    return Look(
        number=number,
        time=time,
        yaw=float(-np.arctan2(ahead[0], ahead[2])),
        pitch=float(-np.arcsin(np.clip(ahead[1], -1, 1))),
        sharpness=sharp,
        lids=float(np.mean([_gap(marks, pairs) for pairs in _LIDS])) / size,
        lips=_gap(marks, _LIPS) / size,
        error=float(np.sqrt(1 / np.maximum(face.confidence, _LEAST_CONFIDENCE)).mean()),
    )


def sharpness(picture: FloatArray, landmarks: FloatArray) -> float:
    """How much detail a face has in a picture (h, w, 3), as large as all others: the Laplacian's spread over the mean.

    :raises InputError: landmarks that are no face's
    """
    crop = sample_crop(torch.as_tensor(picture), face_crop(landmarks, _SIZE), _SIZE)[0]
    luma = crop.numpy().transpose(1, 2, 0) @ _LUMA
    detail = gaussian_laplace(luma, _GRAIN)[_FACE, _FACE]
    return float(detail.std() / max(float(luma[_FACE, _FACE].mean()), 0.02))


def _gap(marks: FloatArray, pairs: tuple[tuple[int, int], ...]) -> float:
    return float(np.mean([np.linalg.norm(marks[upper] - marks[lower]) for upper, lower in pairs]))


def choose(looks: Sequence[Look], count: int) -> list[int]:
    """Indices of at most `count` looks, in their order: the best one near the front, then always the one that is
    farthest from those before, less its faults.

    Fewer where no further look is from another side.
    """
    # (n,) degrees of another side that would outweigh each look's faults
    lids, lips, errors = (np.array([getattr(look, name) for look in looks]) for name in ("lids", "lips", "error"))
    blurred = np.maximum(1 - relative_sharpness(looks) / _SHARP, 0)
    shut = np.maximum(1 - lids / (_AWAKE * usual(looks, lids, 0.6)), 0)
    opened = np.maximum(lips - usual(looks, lips, 0.25), 0) / _OPEN_BY
    doubted = np.maximum(errors - usual(looks, errors, 0.25), 0)
    unsure = np.maximum(errors - _SIDE_ERROR, 0)
    faults, apart = (
        np.asarray(
            _BLURRED * blurred + _SHUT * shut + _OPEN * opened + _DOUBTED * doubted + _UNSURE * unsure, dtype=np.float64
        ),
        angles(looks),
    )
    kept = [int(np.argmin(np.linalg.norm(_sides(looks), axis=1) + faults))]
    while len(kept) < min(count, len(looks)):
        away = apart[:, kept].min(axis=1)
        gain = np.where(away < _ANOTHER, -np.inf, away - faults)
        best = int(np.argmax(gain))
        if gain[best] == -np.inf:
            break
        kept.append(best)
    return sorted(kept)


def relative_sharpness(looks: Sequence[Look]) -> FloatArray:
    """(n,) sharpness over that of sharp looks from nearly the same side: a cheek has less detail than eyes."""
    sharp = np.array([look.sharpness for look in looks])
    return np.asarray(np.minimum(sharp / usual(looks, sharp, 0.75), 1.0))


def usual(looks: Sequence[Look], values: FloatArray, share: float) -> FloatArray:
    """(n,) the value that a share of the looks from nearly the same side is below."""
    near = np.argsort(angles(looks), axis=1, kind="stable")[:, : max(_ALIKE, len(looks) // 4)]
    return np.maximum(np.quantile(values[near], share, axis=1), 1e-9)


def angles(looks: Sequence[Look]) -> FloatArray:
    """(n, n) degrees between the sides that looks are from."""
    sides = _sides(looks)
    return np.asarray(np.linalg.norm(sides[:, None] - sides, axis=2))


def _sides(looks: Sequence[Look]) -> FloatArray:
    """(n, 2) degrees."""
    return np.degrees([(look.yaw, _UP * look.pitch) for look in looks])


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
    # the face that was seen before, else the largest
    face = None if before is None else follow_face(picture, before.landmarks, closer=False)
    if face is None:
        faces = find_landmarks(picture)
        face = max(faces, key=lambda one: float(np.prod(np.ptp(one.landmarks, axis=0))), default=None)
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


def _sharpness(picture: FloatArray, face: FoundFace) -> float:
    try:
        return sharpness(picture, face.landmarks)
    except InputError:
        return 0.0


def write_frames(
    clip: Clip, seen: Looks, kept: Sequence[int], folder: Path, done: Callable[[], object]
) -> ChosenFramesReport:
    """Write the frames of looks `kept`, indices in order, into a folder as PNG.

    :raises InputError: the clip can't be read
    """
    sharp, chosen, warnings = relative_sharpness(seen.looks), list[ChosenFrame](), list[str]()
    wanted = {seen.looks[index].number: index for index in kept}
    last = max(wanted)
    for frame in clip.frames():
        if frame.number in wanted:
            index = wanted[frame.number]
            look, name = seen.looks[index], f"frame_{frame.number:05d}_{frame.time:.2f}s.png"
            save_png(Image.fromarray(frame.picture()), folder / name)
            one = ChosenFrame(
                file=name,
                number=look.number,
                time=round(look.time, 3),
                sharpness=round(float(sharp[index]), 3),
                yaw=round(look.yaw, 4),
                pitch=round(look.pitch, 4),
            )
            chosen.append(one)
            try:  # whether `facepipe fit-photo` would take it as it is
                own_landmarks(read_photo(folder / name))
            except InputError as error:
                warnings.append(f"{name}: for fit-photo {error.what}")
            done()
        if frame.number >= last:
            break
    if len(chosen) != len(wanted):
        raise InputError(clip.path, "was changed while it was read")
    widest = float(angles([seen.looks[index] for index in kept]).max())
    if widest < _ONE_SIDE:
        what = f"the head turns by {widest:.0f} degrees only"
        warnings.insert(0, f"{what}: frames from several sides give a better person")
    return ChosenFramesReport(
        chosen=tuple(chosen),
        clip_frames=seen.frames,
        clip_seconds=round(seen.seconds, 3),
        looked_at=seen.tried,
        with_face=len(seen.looks),
        warnings=tuple(warnings),
    )
