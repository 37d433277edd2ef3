"""Landmarks found in a photo: by MediaPipe's Face Landmarker, or by facepipe's own network."""

from __future__ import annotations

import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.reading import read_bytes
from facepipe.processors.photo_fit.landmarks68 import Landmarks68, landmarks_in, one_face
from facepipe.processors.photo_fit.photo_file import Photo

_MOST_BYTES = 1 << 28
_MOST_FACES = 16
_MEDIAPIPE_COUNTS = (468, 478)  # without irises and with


def mediapipe_landmarks(photo: Photo, task_file: Path, *, index: int | None = None) -> Landmarks68:
    """The landmarks that MediaPipe's Face Landmarker finds, in pixels of the photo.

    :param task_file: the model, ``face_landmarker.task``: the 1.x wheels of mediapipe bring none
    :param index: which of several faces, from 0, the largest first
    :raises InputError: mediapipe is not installed, no such model, no or several faces, or landmarks that
        `landmarks_in` refuses
    """
    model = _task_bundle(task_file)
    vision, image = _mediapipe(photo)
    from mediapipe.tasks.python import BaseOptions

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
    faces = [_pixels(face, photo, task_file) for face in found]
    return _chosen(photo, faces, index, f"MediaPipe {task_file.name}")


def own_landmarks(photo: Photo, *, index: int | None = None) -> Landmarks68:
    """The landmarks that facepipe's own network finds, in pixels of the photo.

    :param index: which of several faces, from 0, the largest first
    :raises InputError: no torch, no or several faces, or landmarks that `landmarks_in` refuses
    """
    from facepipe.learn.networks import find_landmarks

    faces: list[FloatArray] = [np.asarray(face.landmarks) for face in find_landmarks(photo.pixels)]
    return _chosen(photo, faces, index, "facepipe landmark network")


def _chosen(photo: Photo, faces: list[FloatArray], index: int | None, source: str) -> Landmarks68:
    faces = sorted(faces, key=lambda points: -float(np.prod(np.ptp(points, axis=0))))
    return landmarks_in(photo, one_face(faces, index, str(photo.path)), source, str(photo.path))


def _mediapipe(photo: Photo) -> tuple[Any, Any]:
    """MediaPipe's vision tasks, and the photo as its image."""
    try:
        import mediapipe
        from mediapipe.tasks.python import vision
    except ImportError as error:
        missing = error.name == "mediapipe"
        found = "mediapipe is not installed" if missing else f"mediapipe can't be loaded ({error})"
        raise InputError("MediaPipe", f"{found}, expected: pip install 'mediapipe>=1.2,<2'") from None
    except OSError as error:  # a library of the system that it needs
        raise InputError("MediaPipe", f"mediapipe can't be loaded: {error}") from None
    pixels = np.ascontiguousarray(np.round(photo.pixels * 255).clip(0, 255).astype(np.uint8))
    return vision, mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=pixels)


def _task_bundle(path: Path) -> bytes:
    data = read_bytes(path, _MOST_BYTES)
    if not zipfile.is_zipfile(BytesIO(data)):
        raise InputError(path, "is no MediaPipe task bundle, expected face_landmarker.task")
    return data


def _pixels(face: Any, photo: Photo, task_file: Path) -> FloatArray:
    """(468 | 478, 2) of MediaPipe's shares of width and height."""
    if len(face) not in _MEDIAPIPE_COUNTS:
        raise InputError(task_file, f"finds {len(face)} landmarks, expected a model of {_MEDIAPIPE_COUNTS[-1]}")
    height, width = photo.pixels.shape[:2]
    return np.array([(point.x, point.y) for point in face], dtype=np.float64) * (width, height)
