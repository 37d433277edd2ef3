"""Landmarks of photos: from files, from MediaPipe, or found by facepipe's own network; and what can't be a face's.

Files hold 68 or 478 places:

    {"multipie68": [[180.8, 92.5], ...]}
    {"mediapipe478": [[223.6, 140.5, -9.3], ...]}
    {"landmarks": [[0.35, 0.18], ...], "units": "normalized", "image": "portrait.jpg"}
    [[180.8, 92.5], ...]

`landmarks`, or the list alone, holds 68 points (Multi-PIE), or 468 or 478 (MediaPipe). A point is x and y, further
numbers of depth are not used. `units`: a text that begins with ``pixels`` (default), of the file's picture seen upright
from its top left corner; or with ``normalized``, shares of its width and height. Each list may be one of several faces
instead. Where both schemes are given multipie68 counts. `confidence`: 68 numbers of 0 to 1, one for each of the 68.
`image`, `detector` and `mediapipe_index_of_multipie68` are for people.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import TypeVar

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.atomic import write_bytes
from facepipe.core.errors import InputError
from facepipe.core.reading import read_bytes, read_json
from facepipe.geometry.landmarks import downward, turned_view
from facepipe.heads.asset import asset
from facepipe.photo.fit.photo_file import Photo

_SMALLEST_FACE = 16.0  # pixels of the longer side of the landmarks' box
_LARGEST_NUMBER = 1e6
# Random heads seen from all sides up to full profile, close by too: at most 0.39 of the spread is within the parts,
# of shuffled landmarks 0.83 at least; the spread across the longest direction is at least 0.41 of that along it.
_WITHIN_PARTS = 0.55
_ACROSS = 0.15
_MIRRORED = -0.1  # 1 from the front, 0 in profile, -1 for a mirrored face
_PARTS = ((0, 5), (5, 12), (12, 17), (17, 22), (22, 27), (27, 31), (31, 36), (36, 42), (42, 48), (48, 68))
_RIGHT = [*range(8), *range(17, 22), *range(36, 42)]  # of the person
_LEFT = [*range(9, 17), *range(22, 27), *range(42, 48)]
_INNER = {
    "right brow": slice(17, 22),
    "left brow": slice(22, 27),
    "nose": slice(27, 36),
    "right eye": slice(36, 42),
    "left eye": slice(42, 48),
    "mouth": slice(48, 68),
}
# Of the spread of all landmarks. Heads beyond the usual ones with several strong expressions, from all sides up to 80
# degrees: parts are at most 0.49 away (open mouths), all together 0.32.
_AWAY = 0.55
_SCATTER = 0.45
_OUTLIER = 0.15  # beyond which a landmark counts little for where the others are
_ROUNDS = 5
# Vertices of MediaPipe's face mesh (numbered as in canonical_face_model.obj of google-ai-edge/mediapipe) that lie where
# the Multi-PIE mark-up has its points. The contour is that of the mesh, a little inside the jaw line. The 10 points of
# the irises, 468 to 477, are not among them.
MULTIPIE68_OF_MEDIAPIPE = (
    *(162, 234, 93, 58, 172, 136, 149, 148, 152, 377, 378, 365, 397, 288, 323, 454, 389),  # jaw line
    *(71, 63, 105, 66, 107, 336, 296, 334, 293, 301),  # brows, the person's right first
    *(168, 197, 5, 4, 75, 97, 2, 326, 305),  # bridge and base of the nose
    *(33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380),  # eyes, the person's right first
    *(61, 39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181),  # outer lips
    *(78, 82, 13, 312, 308, 317, 14, 87),  # inner lips
)


Found = TypeVar("Found")

_OUTSIDE = 0.05  # of the photo's longer side: how far beyond its border detectors guess what a tight crop cuts off
_MOST_MODEL_BYTES = 1 << 28
_MOST_FACES = 16
_MEDIAPIPE_COUNTS = (468, 478)  # without irises and with
_MOST_BYTES = 1 << 24
_LARGEST = 1e9
_COUNTS = {"multipie68": (68,), "mediapipe478": (478,), "landmarks": (68, 468, 478)}  # the first that is there counts
_KEYS = (*_COUNTS, "confidence", "units", "image", "detector", "mediapipe_index_of_multipie68")


def check_face(points: FloatArray, where: str) -> None:
    """Check landmarks (68, 2) in pixels, however the face is turned.

    :param where: the trail, for messages
    :raises InputError: nothing like the 68 of Multi-PIE
    """
    if not (np.abs(points) <= _LARGEST_NUMBER).all():  # NaN too
        raise InputError(where, f"NaN, infinity or beyond {_LARGEST_NUMBER:g} pixels, expected places in a photo")
    extent = float(np.ptp(points, axis=0).max())
    if extent < _SMALLEST_FACE:
        what = f"the landmarks span {extent:.3g} pixels, expected at least {_SMALLEST_FACE:g}"
        raise InputError(where, f'{what} (places in 0..1 need "units": "normalized")')
    centred = points - points.mean(axis=0)
    along, across = np.linalg.svd(centred, compute_uv=False)
    if across < _ACROSS * along:
        raise InputError(where, "the landmarks lie on one line, expected those of a face")
    within = sum(((points[a:b] - points[a:b].mean(axis=0)) ** 2).sum() for a, b in _PARTS)
    if within > _WITHIN_PARTS**2 * (centred**2).sum():
        raise InputError(
            where, "jaw, brows, nose, eyes and lips are mixed, expected the 68 of Multi-PIE in their order"
        )
    # 1 for a face from the front however it is turned in the picture, 0 in profile, -1 when mirrored
    right = points[_LEFT].mean(axis=0) - points[_RIGHT].mean(axis=0)
    down = downward(points)
    if float((right[0] * down[1] - right[1] * down[0]) / max(down @ down, 1e-300)) < _MIRRORED:
        what = "the landmarks are mirrored, expected the person's right side first, x right and y down"
        raise InputError(where, f"{what} from the top left corner")
    # against the average head, turned and scaled robustly
    spread = float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
    trust = np.ones(len(points))
    scattered = float(np.sqrt((_off_average(points, trust) ** 2).sum(axis=1).mean())) / spread
    for _ in range(_ROUNDS):
        off = _off_average(points, trust) / spread
        trust = 1 / (1 + (off**2).sum(axis=1) / _OUTLIER**2)
    for name, part in _INNER.items():
        away = float(np.linalg.norm(off[part].mean(axis=0)))
        if away > _AWAY:
            what = f"the landmarks of the {name} are {away:.2g} of the face's spread away from where a face has them"
            raise InputError(where, f"{what}, expected at most {_AWAY:g}")
    if scattered > _SCATTER:
        what = f"the landmarks are {scattered:.2g} of the face's spread away from any turned head's"
        raise InputError(where, f"{what}, expected at most {_SCATTER:g}")


def _off_average(points: FloatArray, weights: FloatArray) -> FloatArray:
    """(68, 2) how far landmarks are from those of the average head, turned, scaled and moved next to them."""
    places = asset().points[asset().landmarks]
    middle, seen = (np.average(one, axis=0, weights=weights) for one in (places, points))
    return np.asarray(points - seen - (places - middle) @ turned_view(places, points, weights).T)


@dataclass(frozen=True, kw_only=True)
class Landmarks68:
    """Where the landmarks of Multi-PIE are in a photo."""

    points: FloatArray  # (68, 2) float64, pixels of the photo as read: x right and y down from its top left corner
    source: str  # what found them: a file's name, or a detector
    confidence: FloatArray = field(default_factory=lambda: np.ones(68))  # (68,) 0..1: what a squared error counts
    dense: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))  # (d, 2) more, of the scheme ``dense``
    dense_confidence: FloatArray = field(default_factory=lambda: np.zeros(0))  # (d,)
    pupils: FloatArray | None = None  # (2, 3) x, y, and the error to expect: pixels, the person's left first
    warnings: tuple[str, ...] = ()


def landmarks_in(photo: Photo, points: FloatArray, source: str, where: str) -> Landmarks68:
    """`points` (68 | 468 | 478, 2) in pixels of the photo as read as its landmarks; more than 68 are MediaPipe's.

    :param where: the trail, for messages
    :raises InputError: outside the photo by more than 5 % of its longer side, or nothing like the 68 of Multi-PIE: all
        about one place, on one line, in another order, mirrored, or with a part of the face where none can be
    """
    points = np.asarray(points, dtype=np.float64)
    if len(points) != 68:
        points = points[list(MULTIPIE68_OF_MEDIAPIPE)]
    check_face(points, where)
    height, width = photo.pixels.shape[:2]
    beyond = np.maximum(-points, points - (width, height)).max(axis=1)
    count, worst, warnings = int((beyond > 0).sum()), int(beyond.argmax()), list[str]()
    if count:
        share = beyond[worst] / max(width, height)
        x, y = points[worst] / photo.scale
        what = f"{count} of 68 landmarks outside {photo.name} ({photo.size[0]} x {photo.size[1]} pixels)"
        if share > _OUTSIDE:
            trail = f"{what}, number {worst} at {x:.1f}, {y:.1f}"
            raise InputError(where, f"{trail}: expected inside, or out by at most {_OUTSIDE:.0%} of its longer side")
        warnings.append(f"{what}, by up to {share:.1%} of its longer side: guessed by what found them")
    return Landmarks68(points=points, source=source, warnings=tuple(warnings))


def one_face(faces: Sequence[Found], index: int | None, where: str) -> Found:
    """The only one of `faces`, or the one that `index` names, from 0.

    :raises InputError: none, several and no index, or an index out of range
    """
    if not faces:
        raise InputError(where, "no face found, expected one")
    if index is None and len(faces) > 1:
        raise InputError(where, f"{len(faces)} faces found, expected one, or an index from 0 to {len(faces) - 1}")
    if index is not None and not 0 <= index < len(faces):
        raise InputError(where, f"face {index} of {len(faces)}, expected an index from 0 to {len(faces) - 1}")
    return faces[index or 0]


def mediapipe_landmarks(photo: Photo, task_file: Path, *, index: int | None = None) -> Landmarks68:
    """The landmarks that MediaPipe's Face Landmarker finds, in pixels of the photo.

    :param task_file: the model, ``face_landmarker.task``: the 1.x wheels of mediapipe bring none
    :param index: which of several faces, from 0, the largest first
    :raises InputError: mediapipe is not installed, no such model, no or several faces, or landmarks that
        `landmarks_in` refuses
    """
    model = read_bytes(task_file, _MOST_MODEL_BYTES)
    if not zipfile.is_zipfile(BytesIO(model)):
        raise InputError(task_file, "is no MediaPipe task bundle, expected face_landmarker.task")
    try:
        import mediapipe
        from mediapipe.tasks.python import BaseOptions, vision
    except ImportError as error:
        missing = error.name == "mediapipe"
        fault = "mediapipe is not installed" if missing else f"mediapipe can't be loaded ({error})"
        raise InputError("MediaPipe", f"{fault}, expected: pip install 'mediapipe>=1.2,<2'") from None
    except OSError as error:  # a library of the system that it needs
        raise InputError("MediaPipe", f"mediapipe can't be loaded: {error}") from None
    pixels = np.ascontiguousarray(np.round(photo.pixels * 255).clip(0, 255).astype(np.uint8))
    image = mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=pixels)
    try:
        options = vision.FaceLandmarkerOptions(
            base_options=BaseOptions(model_asset_buffer=model), num_faces=_MOST_FACES
        )
        landmarker = vision.FaceLandmarker.create_from_options(options)
    except (ValueError, RuntimeError, OSError) as error:
        raise InputError(task_file, f"{str(error)[:120]}, expected MediaPipe's face_landmarker.task") from None
    with landmarker:
        try:
            found = landmarker.detect(image).face_landmarks
        except (ValueError, RuntimeError) as error:
            raise InputError(f"{photo.path} -> {task_file}", f"MediaPipe failed: {str(error)[:120]}") from None
    height, width = photo.pixels.shape[:2]
    faces = []
    for face in found:
        if len(face) not in _MEDIAPIPE_COUNTS:
            raise InputError(task_file, f"finds {len(face)} landmarks, expected a model of {_MEDIAPIPE_COUNTS[-1]}")
        # MediaPipe gives shares of width and height
        faces.append(np.array([(point.x, point.y) for point in face], dtype=np.float64) * (width, height))
    chosen = one_face(sorted(faces, key=lambda points: -_extent(points)), index, str(photo.path))
    return landmarks_in(photo, chosen, f"MediaPipe {task_file.name}", str(photo.path))


def own_landmarks(photo: Photo, *, index: int | None = None) -> Landmarks68:
    """The landmarks that facepipe's own network finds, in pixels of the photo.

    :param index: which of several faces, from 0, the largest first
    :raises InputError: no torch, no or several faces, or landmarks that `landmarks_in` refuses
    """
    from facepipe.networks import find_landmarks

    faces = sorted(find_landmarks(photo.pixels), key=lambda face: -_extent(face.landmarks))
    face = one_face(faces, index, str(photo.path))
    found = landmarks_in(photo, face.landmarks, "facepipe landmark network", str(photo.path))
    return replace(
        found, confidence=face.confidence, dense=face.dense, dense_confidence=face.dense_confidence, pupils=face.pupils
    )


def _extent(points: FloatArray) -> float:
    """Pixels of the box around landmarks."""
    return float(np.prod(np.ptp(points, axis=0)))


def read_landmarks(path: Path, photo: Photo, *, index: int | None = None) -> Landmarks68:
    """The landmarks of `photo` in a JSON file, in pixels of the photo as read.

    :param index: which of several faces, from 0 in the file's order
    :raises InputError: not such JSON, other counts, NaN or infinity, unknown keys, no or several faces, or landmarks
        that `landmarks_in` refuses
    """
    content = read_json(path, _MOST_BYTES)
    if isinstance(content, list):
        content = {"landmarks": content}
    if not isinstance(content, dict):
        raise InputError(path, f"{_shown(content)}, expected a list of 68 or 478 points, or an object that holds one")
    for key in content:
        if key not in _KEYS:
            raise InputError(f"{path} -> {key[:60]}", f"unknown key, expected some of {', '.join(_KEYS)}")
    scheme = next((key for key in _COUNTS if key in content), None)
    if scheme is None:
        raise InputError(path, f"no landmarks, expected one of {', '.join(_COUNTS)}")
    where = f"{path} -> {scheme}"
    faces = content[scheme]
    if not isinstance(faces, list):
        raise InputError(where, f"{_shown(faces)}, expected a list of points [x, y]")
    # of several faces each element is a list of points
    if faces and not all(isinstance(one, list) and (not one or isinstance(one[0], list)) for one in faces):
        faces = [faces]
    face, counts = one_face(faces, index, where), _COUNTS[scheme]
    if not isinstance(face, list) or len(face) not in counts:
        given = f"{len(face)} points" if isinstance(face, list) else _shown(face)
        raise InputError(where, f"{given}, expected {' or '.join(map(str, counts))}")
    for number, point in enumerate(face):
        good = isinstance(point, list) and len(point) in (2, 3)
        # NaN fails the comparison
        if not good or not all(type(one) in (int, float) and abs(one) <= _LARGEST for one in point):
            raise InputError(f"{where} -> {number}", f"{_shown(point)}, expected finite numbers [x, y] or [x, y, z]")
    points = np.array([point[:2] for point in face], dtype=np.float64)
    units = content.get("units", "pixels")
    if isinstance(units, str) and units.startswith(("normalized", "normalised")):
        points = points * np.array(photo.size, dtype=np.float64)
    elif not isinstance(units, str) or not units.startswith("pixels"):
        raise InputError(f"{path} -> units", f"{_shown(units)}, expected pixels or normalized")
    found = landmarks_in(photo, points * photo.scale, path.name, where)
    if "confidence" not in content:
        return found
    trust = content["confidence"]
    numbers = trust if isinstance(trust, list) else []
    # NaN fails the comparison
    if len(numbers) != 68 or not all(type(one) in (int, float) and 0 <= one <= 1 for one in numbers):
        raise InputError(f"{path} -> confidence", f"{_shown(trust)}, expected 68 numbers of 0 to 1")
    return replace(found, confidence=np.array(numbers, dtype=np.float64))


def write_landmarks(path: Path, landmarks: Landmarks68, photo: Photo) -> None:
    """Write `landmarks` in pixels of the photo's file, as `read_landmarks` reads them, to a thousandth of a pixel.

    :raises InputError: the file can't be written
    """
    points = np.round(landmarks.points / photo.scale, 3) + 0.0  # no -0.0
    rows = ",\n  ".join(json.dumps(point) for point in points.tolist())
    head: dict[str, object] = {"detector": landmarks.source, "image": photo.name, "units": "pixels"}
    if (landmarks.confidence < 1).any():
        head["confidence"] = np.round(landmarks.confidence, 3).tolist()
    fields = ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in head.items())
    write_bytes(path, f'{{{fields},\n"multipie68": [\n  {rows}\n]}}\n'.encode())


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list) and any(isinstance(one, list | dict) for one in value):
        return f"a list of {len(value)}"
    return json.dumps(value)[:40]
