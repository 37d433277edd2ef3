"""Faces and their 68 landmarks in a whole photo, by a network that sees one square crop at a time."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import maximum_filter

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.face_crops import TEMPLATE, face_crop, from_crop, turned_crop
from facepipe.geometry.landmarks import face_size, quarter_turned, quarters_to_upright
from facepipe.networks.files import (
    COUNT,
    PUPILS,
    LandmarkSession,
    crops_of,
    dense_landmarks,
    landmarks_by_looks,
    own_dense_session,
    own_landmark_session,
)
from facepipe.rig.torch import torch
from facepipe.rig.torch.one_thread import one_thread

_LARGEST, _SMALLEST, _RATIO = 1.3, 1 / 7, 1.4  # crops' sides over the shorter side of the photo, and between two sizes
_MOST_PIXELS = 700  # of the shorter side of the photo as it is searched
_FEWEST_PIXELS = 40  # a side of the smallest crop
_MOST = 64  # crops that are refined
_ROUNDS = 4
_PEAK = 0.1  # presence in a map that is worth a crop
_MAYBE, _SURE = 0.4, 0.9  # presence of crops that are refined, and of those that are faces
_UNSTEADY = 0.018  # of a crop's side: how far landmarks may differ by how a face is cropped, RMS
_UNLIKE = 0.1  # of a crop's side: RMS distance from the template
_SAME = 0.4  # of a crop's side: faces nearer than this are one
# Crops that a face's landmarks are the mean of, each as it is and mirrored: turn in radians, scale.
_LOOKS = [(turn, scale) for scale in (1.0, 1.12, 0.9) for turn in (0.0, 0.12, -0.12)]
# Of a crop's side: RMS distance of a landmark from its mean over these at which it counts half; or this many times the
# median, where all differ by more: landmarks as a whole then don't count less beside all else that a photo shows.
_DOUBT, _USUAL = 0.008, 2.5
_CONTOUR = slice(0, 17)
_EXACT = 0.006  # of the face's size: the error to expect of a landmark that counts fully
_LEAST = 0.1  # confidence: the farther looks differ, the less that means


@dataclass(frozen=True, kw_only=True)
class FoundFace:
    """A face in a photo."""

    landmarks: FloatArray  # (68, 2) pixels, Multi-PIE order
    presence: float  # 0..1
    confidence: FloatArray  # (68,) 0..1, what a landmark's squared error should count
    dense: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))  # (d, 2) of the built-in head's scheme dense
    dense_confidence: FloatArray = field(default_factory=lambda: np.zeros(0))  # (d,)
    pupils: FloatArray | None = None  # (2, 3) x, y, and the error to expect: pixels, the person's left first


def find_landmarks(image: FloatArray, model: Path | None = None) -> list[FoundFace]:
    """The faces of a photo (h, w, 3) of sRGB 0..1, the surest first; none where there are none.

    Crops of all sizes and places whose presence is high are moved to where their own landmarks ask for, a few times
    over; those that settle, keep their presence and look like a face when cropped differently are faces. The network
    knows synthetic heads alone, upright within about 30 degrees, and larger than a seventh of the photo. Where it sees
    none, the photo is searched by quarter turns. Landmarks on which crops agree, turned, scaled and mirrored, are sure.
    A second network looks at faces in larger crops.

    :param model: an ONNX network of the kind ``landmarks``, and no second look; default those that come with facepipe
    :raises InputError: another shape, NaN or infinity; a file that is no such network
    """
    pixels = _checked(image)
    network = LandmarkSession(model) if model else own_landmark_session()
    for quarters in range(4):
        faces = _faces(network, pixels, quarters, closer=model is None)
        if faces:
            return faces
    return []


def follow_face(image: FloatArray, landmarks: FloatArray, *, closer: bool = True) -> FoundFace | None:
    """The face that had `landmarks` (68, 2) in a picture a moment before; None where it is not near there any more.

    As `find_landmarks`, but the picture (h, w, 3) is not searched.

    :param closer: have the second look, which takes most of the time
    """
    quarters = quarters_to_upright(landmarks)
    found = _faces(own_landmark_session(), _checked(image), quarters, closer=closer, near=landmarks)
    return found[0] if found else None


def _checked(image: FloatArray) -> FloatArray:
    pixels = np.asarray(image, dtype=np.float32)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or min(pixels.shape[:2]) < 2:
        raise InputError("photo", f"an array of shape {pixels.shape}, expected (h, w, 3)")
    if not np.isfinite(pixels).all():
        raise InputError("photo", "NaN or infinity, expected sRGB values 0..1")
    return pixels


@one_thread()  # of pictures so small, other threads wait for work, which keeps their cores busy
def _faces(
    network: LandmarkSession, pixels: FloatArray, quarters: int, *, closer: bool, near: FloatArray | None = None
) -> list[FoundFace]:
    """Faces that are upright once the picture is turned by quarters, in pixels of the picture as it is.

    :param closer: look at them by the second network
    :param near: (68, 2) where the only one that is looked for was
    """
    turned = np.ascontiguousarray(np.rot90(pixels, quarters))
    if near is not None:
        near = quarter_turned(near, quarters, (pixels.shape[1], pixels.shape[0]))
    photo, scale = _shrunk(torch.as_tensor(turned))
    if near is None:
        # landmarks of the crops that may show a face, the surest first
        shortest = min(photo.shape[:2])
        side = _LARGEST * shortest
        peaks = [_peaks(network, photo, side)]
        while (side := side / _RATIO) >= max(_SMALLEST * shortest, _FEWEST_PIXELS):
            peaks.append(_peaks(network, photo, side))
        crops, to_photo, logits = (np.concatenate(column) for column in zip(*peaks, strict=True))
        surest = np.argsort(-logits, kind="stable")[:_MOST]
        places, _ = network(crops[surest])
        start = np.asarray(places * to_photo[surest, None, 1] + to_photo[surest, None, 0])
    else:
        start = near[None] / scale
    settled = _settled(network, photo, start)
    judged = [face for landmarks in settled if (face := _judged(network, photo, landmarks)) is not None]
    faces: list[FoundFace] = []  # the surest of those that overlap
    for face in sorted(judged, key=lambda one: -one.presence):
        centre, side = face.landmarks.mean(axis=0), np.ptp(face.landmarks, axis=0).max() / 0.6
        if all(np.linalg.norm(centre - other.landmarks.mean(axis=0)) > _SAME * side for other in faces):
            faces.append(face)
    found, size = [], (turned.shape[1], turned.shape[0])
    for face in faces:
        face = replace(face, landmarks=face.landmarks * scale)
        nearer = dense_landmarks(own_dense_session(), turned, face.landmarks) if closer else None
        if nearer is not None:
            points, errors = nearer
            trust = np.minimum(1, (_EXACT * face_size(points[:COUNT]) / errors) ** 2)
            face = FoundFace(
                landmarks=points[:COUNT],
                presence=face.presence,
                confidence=trust[:COUNT],
                dense=points[COUNT:-PUPILS],
                dense_confidence=trust[COUNT:-PUPILS],
                pupils=np.column_stack([points, errors])[-PUPILS:],
            )
        landmarks, dense = (quarter_turned(places, -quarters, size) for places in (face.landmarks, face.dense))
        pupils = face.pupils
        if pupils is not None:
            pupils = np.column_stack([quarter_turned(pupils[:, :2], -quarters, size), pupils[:, 2]])
        found.append(replace(face, landmarks=landmarks, dense=dense, pupils=pupils))
    return found


def _shrunk(photo: torch.Tensor) -> tuple[torch.Tensor, FloatArray]:
    """The photo at the resolution that the smallest crops need, and what its pixels times (x, y) are in the photo's."""
    height, width = photo.shape[:2]
    factor = _MOST_PIXELS / min(height, width)
    if factor >= 1:
        return photo, np.ones(2)
    size = max(round(height * factor), 1), max(round(width * factor), 1)
    return _resized(photo, size)[0].permute(1, 2, 0).contiguous(), np.array([width / size[1], height / size[0]])


def _resized(photo: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """(1, 3, h, w) of a photo (h, w, 3), averaged where it shrinks."""
    pixels = photo.permute(2, 0, 1)[None]
    return torch.nn.functional.interpolate(pixels, size=size, mode="bilinear", antialias=True, align_corners=False)


def _peaks(network: LandmarkSession, photo: torch.Tensor, side: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Crops of one size (k, 3, S, S), in the photo and a little beyond, that are likelier faces than those beside them.

    :return: also the photo's x, y (k, 2, 2) of their corners and of a pixel's sides; (k,) presence before its sigmoid
    """
    size, cell = network.size, network.cell
    height, width = (max(round(length * size / side), 1) for length in photo.shape[:2])
    margin = size // 3
    below, right = (-(-max(length + 2 * margin, size) // cell) * cell - length - margin for length in (height, width))
    level = torch.nn.functional.pad(_resized(photo, (height, width)), [margin, right, margin, below], mode="replicate")
    pixels = level[0].numpy()
    found = network.presence_map(pixels)
    peak = (found > np.log(_PEAK / (1 - _PEAK))) & (found == maximum_filter(found, 3))
    corners = np.argwhere(peak) * cell
    crops = [pixels[:, row : row + size, column : column + size] for row, column in corners]
    scale = np.array([photo.shape[1] / width, photo.shape[0] / height])
    to_photo = np.stack([(corners[:, ::-1] - margin) * scale, np.broadcast_to(scale, corners.shape)], axis=1)
    return np.reshape(crops, (-1, 3, size, size)), to_photo, found[peak]


def _settled(network: LandmarkSession, photo: torch.Tensor, landmarks: FloatArray) -> list[FloatArray]:
    """Landmarks after rounds of cropping by them, without those that leave the photo or end up at one place."""
    for _ in range(_ROUNDS):
        matrices = [matrix for one in _distinct(landmarks) if (matrix := _crop(photo, one, network.size)) is not None]
        if not matrices:
            return []
        places, presence = network(crops_of(photo.numpy(), matrices, network.size))
        kept = zip(places, matrices, presence, strict=True)
        landmarks = np.array([from_crop(one, matrix) for one, matrix, sure in kept if sure > _MAYBE])
    return list(_distinct(landmarks))


def _distinct(landmarks: FloatArray) -> FloatArray:
    """Without those whose landmarks nearly are those of one before."""
    kept: list[FloatArray] = []
    for face in landmarks:
        near = 0.05 * np.ptp(face, axis=0).max()
        if all(np.linalg.norm(face - other, axis=1).mean() > near for other in kept):
            kept.append(face)
    return np.array(kept).reshape(-1, 68, 2)


def _crop(photo: torch.Tensor, landmarks: FloatArray, size: int) -> FloatArray | None:
    """The aligned crop, if it lies mostly within the photo and is not tiny."""
    try:
        matrix = face_crop(landmarks, size)
    except InputError:
        return None
    side = float(np.hypot(*matrix[:, 0])) * size
    inside = (landmarks > 0).all(axis=1) & (landmarks < (photo.shape[1], photo.shape[0])).all(axis=1)
    shortest = min(photo.shape[:2])
    if not _FEWEST_PIXELS / 2 < side < 3 * shortest or inside.mean() < 0.6:
        return None
    return matrix


def _judged(network: LandmarkSession, photo: torch.Tensor, landmarks: FloatArray) -> FoundFace | None:
    """The face near landmarks (68, 2) by several crops of it; None where they disagree or show nothing like one."""
    aligned = _crop(photo, landmarks, network.size)
    if aligned is None:
        return None
    matrices = [turned_crop(aligned, turn, scale, network.size) for turn, scale in _LOOKS]
    looks, presence = landmarks_by_looks(network, photo.numpy(), matrices)
    mean = looks.mean(axis=0)
    final = _crop(photo, mean, network.size)
    if final is None or presence.mean() < _SURE:
        return None
    side = float(np.hypot(*final[:, 0])) * network.size
    # RMS distances of landmarks from their mean; those of the contour slide along it: only across counts
    off = looks - mean
    found = np.sqrt((off**2).sum(axis=2).mean(axis=0))
    along = np.gradient(mean[_CONTOUR], axis=0)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    found[_CONTOUR] = np.sqrt(2 * ((off[:, _CONTOUR] * across).sum(axis=2) ** 2).mean(axis=0))
    spread = np.asarray(found) / side
    target = from_crop(TEMPLATE * network.size, final)
    unlike = np.sqrt(((mean - target) ** 2).sum(axis=1).mean()) / side
    if spread.mean() > _UNSTEADY or unlike > _UNLIKE:
        return None
    doubt = max(_DOUBT, _USUAL * float(np.median(spread)))
    return FoundFace(
        landmarks=mean,
        presence=float(presence.mean()),
        confidence=np.asarray(np.maximum(_LEAST, 1 / (1 + (spread / doubt) ** 4))),
    )
