"""Where a photo shows nothing but a face, and where hair: not glasses, hands, clothes, nor what is behind."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from facepipe.core.arrays import Float32Array, FloatArray
from facepipe.learn.features.crops import face_crop, plain_crop, to_crop, turned_crop
from facepipe.learn.networks.files import FaceMaskSession

_WIDE, _NEAR = 2.0, 1.0  # sides of crops in those of `face_crop`: a head with its hair, and a face
_FADE = 0.1  # of a near crop's side, over which it takes over from the wide one


@dataclass(frozen=True, kw_only=True)
class FaceMask:
    """Shares of a photo's pixels, 0..1; beyond the head both are 0."""

    face: Float32Array  # (h, w) skin, eyes and mouth, ears and neck
    hair: Float32Array  # (h, w)


def face_mask(network: FaceMaskSession, photo: Float32Array, landmarks: FloatArray) -> FaceMask:
    """What a photo shows around a face, from far for the head and from near for the face.

    :param photo: (h, w, 3) sRGB 0..1
    :param landmarks: (68, 2) pixels
    :raises InputError: landmarks that are nothing like a face's
    """
    shares = np.zeros((2, *photo.shape[:2]), np.float32)
    aligned = face_crop(landmarks, network.size)
    for scale in (_WIDE, _NEAR):
        matrix = turned_crop(aligned, 0.0, scale, network.size)
        crop = plain_crop(photo, matrix, network.size).transpose(2, 0, 1)
        seen, mirrored = network(np.stack([crop, crop[..., ::-1]]))[:, :2]
        _lay(shares, (seen + mirrored[..., ::-1]) / 2, matrix, network.size)
    return FaceMask(face=shares[0], hair=shares[1])


def _lay(shares: Float32Array, seen: FloatArray, matrix: FloatArray, size: int) -> None:
    """Put what a crop shows (2, s, s) over shares (2, h, w) of the photo, fading in from the crop's border."""
    height, width = shares.shape[1:]
    corners = np.array([(0, 0), (size, 0), (0, size), (size, size)]) @ matrix[:, :2].T + matrix[:, 2]
    left, top = np.clip(np.floor(corners.min(axis=0)).astype(int), 0, (width, height))
    right, bottom = np.clip(np.ceil(corners.max(axis=0)).astype(int), 0, (width, height))
    places = np.stack(np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5), axis=-1)
    inside = to_crop(places, matrix) / size  # 0..1 of the crop
    border = np.minimum(inside, 1 - inside).min(axis=-1)
    amount = np.clip(border / _FADE, 0, 1).astype(np.float32)
    at = np.moveaxis(inside[..., ::-1], -1, 0) * seen.shape[1] - 0.5
    window = shares[:, top:bottom, left:right]
    for one, channel in zip(window, seen, strict=True):
        one += amount * (map_coordinates(channel.astype(np.float32), at, order=1, mode="nearest") - one)
