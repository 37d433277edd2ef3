"""Where a photo shows nothing but a face, and where hair: not glasses, hands, clothes, nor what is behind."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from scipy.ndimage import map_coordinates

from facepipe.core.arrays import Float32Array, FloatArray
from facepipe.geometry.face_crops import face_crop, plain_crop, to_crop, turned_crop

_WIDE, _NEAR = 2.0, 1.0  # sides of crops in those of `face_crop`: a head with its hair, and a face
_INSIDE, _KNOWN = slice(17, None), 0.25  # landmarks inside the face, and the least mean share of face at them
_FADE = 0.1  # of a near crop's side, over which it takes over from the wide one


class MaskNetwork:
    """An ONNX file of the kind ``face-mask``, in onnxruntime."""

    def __init__(self, data: bytes) -> None:
        import onnxruntime as ort

        settings = ort.SessionOptions()
        settings.intra_op_num_threads = 1
        settings.log_severity_level = 4
        self._session = ort.InferenceSession(data, settings, providers=["CPUExecutionProvider"])
        described = json.loads(self._session.get_modelmeta().custom_metadata_map["facepipe.features"])
        self.size = int(described["size"])
        self._mean, self._std = (np.asarray(described[key], np.float32).reshape(3, 1, 1) for key in ("mean", "std"))

    def __call__(self, crops: Float32Array) -> Float32Array:
        """(b, 3, s, s) shares of face, hair and all else in cells of sRGB crops (b, 3, S, S) in 0..1."""
        (shares,) = self._session.run(["shares"], {"image": (crops - self._mean) / self._std})
        return np.asarray(shares)


@cache
def own_network() -> MaskNetwork:
    """The network that comes with facepipe, loaded once."""
    return MaskNetwork((files("facepipe.networks") / "face_mask.onnx").read_bytes())


@dataclass(frozen=True, kw_only=True)
class FaceMask:
    """Shares of a photo's pixels, 0..1; beyond the head both are 0."""

    face: Float32Array  # (h, w) skin, eyes and mouth, ears and neck
    hair: Float32Array  # (h, w)


def face_mask(photo: Float32Array, landmarks: FloatArray) -> FaceMask:
    """What a photo shows around a face, from far for the head and from near for the face.

    Where hardly any of the landmarks inside the face lie on what the network takes for face, it does not know such
    faces: all is face then.

    :param photo: (h, w, 3) sRGB 0..1
    :param landmarks: (68, 2) pixels
    :raises InputError: landmarks that are nothing like a face's
    """
    network = own_network()
    shares = np.zeros((2, *photo.shape[:2]), np.float32)
    aligned = face_crop(landmarks, network.size)
    for scale in (_WIDE, _NEAR):
        matrix = turned_crop(aligned, 0.0, scale, network.size)
        crop = plain_crop(photo, matrix, network.size).transpose(2, 0, 1)
        seen, mirrored = network(np.stack([crop, crop[..., ::-1]]))[:, :2]
        shown = (seen + mirrored[..., ::-1]) / 2
        # what the crop shows goes over what was there, fading in from the crop's border
        size = network.size
        height, width = shares.shape[1:]
        corners = np.array([(0, 0), (size, 0), (0, size), (size, size)]) @ matrix[:, :2].T + matrix[:, 2]
        left, top = np.clip(np.floor(corners.min(axis=0)).astype(int), 0, (width, height))
        right, bottom = np.clip(np.ceil(corners.max(axis=0)).astype(int), 0, (width, height))
        places = np.stack(np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5), axis=-1)
        inside = to_crop(places, matrix) / size  # 0..1 of the crop
        border = np.minimum(inside, 1 - inside).min(axis=-1)
        amount = np.clip(border / _FADE, 0, 1).astype(np.float32)
        at = np.moveaxis(inside[..., ::-1], -1, 0) * shown.shape[1] - 0.5
        window = shares[:, top:bottom, left:right]
        for one, channel in zip(window, shown, strict=True):
            one += amount * (map_coordinates(channel, at, order=1, mode="nearest") - one)
    column, row = np.clip(landmarks[_INSIDE], 0, np.array(photo.shape[1::-1]) - 1).astype(np.int64).T
    if shares[0, row, column].mean() < _KNOWN:
        return FaceMask(face=np.ones_like(shares[0]), hair=np.zeros_like(shares[1]))
    return FaceMask(face=shares[0], hair=shares[1])
