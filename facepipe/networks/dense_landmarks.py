"""Many landmarks of a face, the 68 among them, by a network that sees the face larger than the search does."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.face_crops import face_crop, from_crop, turned_crop
from facepipe.networks.crops import sample_crop
from facepipe.networks.files import DenseLandmarkSession
from facepipe.rig.torch import torch

COUNT, PUPILS = 68, 2
# Crops that landmarks are the mean of, each as it is and mirrored: turn in radians, scale.
_LOOKS = ((0.0, 1.0), (0.08, 1.05), (-0.08, 0.96))
_ROUNDS = 2


def dense_landmarks(
    network: DenseLandmarkSession, photo: torch.Tensor, landmarks: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """(n, 2) landmarks, the first 68 those of Multi-PIE, the last two the pupils, and errors to expect of them (n,).

    All in pixels; None: no crop.

    After Wood et al., "3D Face Reconstruction with Dense Landmarks", ECCV 2022.

    :param photo: (h, w, 3) sRGB 0..1, float32
    :param landmarks: (68, 2) pixels, about where they are
    """
    points = landmarks
    for _ in range(_ROUNDS):
        try:
            aligned = face_crop(points[:COUNT], network.size)
        except InputError:
            return None
        matrices = [turned_crop(aligned, turn, scale / network.zoom, network.size) for turn, scale in _LOOKS]
        crops = np.concatenate([sample_crop(photo, matrix, network.size).numpy() for matrix in matrices])
        places, errors = network(np.concatenate([crops, crops[..., ::-1]]))
        places[len(crops) :] = [network.size, 0] + places[len(crops) :, network.mirrored] * [-1, 1]
        errors[len(crops) :] = errors[len(crops) :, network.mirrored]
        looks = np.array([from_crop(one, matrix) for one, matrix in zip(places, matrices * 2, strict=True)])
        points = looks.mean(axis=0)
    spread = ((looks - points) ** 2).sum(axis=2).mean(axis=0)
    scales = np.array([np.hypot(*matrix[:, 0]) for matrix in matrices * 2])
    return points, np.sqrt(((errors * scales[:, None]) ** 2).mean(axis=0) + spread)
