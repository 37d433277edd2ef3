"""Landmarks of photos in files of 68 or 478 places.

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
from dataclasses import replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.atomic import write_bytes
from facepipe.core.errors import InputError
from facepipe.core.reading import read_json
from facepipe.photo.fit.photo_file import Photo
from facepipe.photo.fit.photo_landmarks import Landmarks68, landmarks_in, one_face

_MOST_BYTES = 1 << 24
_LARGEST = 1e9
_COUNTS = {"multipie68": (68,), "mediapipe478": (478,), "landmarks": (68, 468, 478)}  # the first that is there counts
_KEYS = (*_COUNTS, "confidence", "units", "image", "detector", "mediapipe_index_of_multipie68")


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
    points = _points(where, one_face(faces, index, where), _COUNTS[scheme])
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


def _points(where: str, value: object, counts: tuple[int, ...]) -> FloatArray:
    """(n, 2) of a list of points."""
    if not isinstance(value, list) or len(value) not in counts:
        found = f"{len(value)} points" if isinstance(value, list) else _shown(value)
        raise InputError(where, f"{found}, expected {' or '.join(map(str, counts))}")
    for number, point in enumerate(value):
        good = isinstance(point, list) and len(point) in (2, 3)
        # NaN fails the comparison
        if not good or not all(type(one) in (int, float) and abs(one) <= _LARGEST for one in point):
            raise InputError(f"{where} -> {number}", f"{_shown(point)}, expected finite numbers [x, y] or [x, y, z]")
    return np.array([point[:2] for point in value], dtype=np.float64)


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list) and any(isinstance(one, list | dict) for one in value):
        return f"a list of {len(value)}"
    return json.dumps(value)[:40]
