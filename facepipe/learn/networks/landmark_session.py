"""The landmark network in onnxruntime: crops in, landmarks and presence out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.learn.features.onnx_file import read_model

_BATCH = 32
_KEY = "facepipe.features"


class LandmarkSession:
    """An ONNX file of the kind ``landmarks``."""

    def __init__(self, source: Path | bytes) -> None:
        """
        :param source: a file, or its bytes
        :raises InputError: no file, no ONNX model, one with data in other files, or one of another kind
        """
        import onnxruntime as ort

        where = "landmark network" if isinstance(source, bytes) else source
        data = source if isinstance(source, bytes) else read_model(source).SerializeToString()
        settings = ort.SessionOptions()
        settings.intra_op_num_threads = 1
        settings.log_severity_level = 4
        try:
            self._session = ort.InferenceSession(data, settings, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own classes share no other base
            raise InputError(where, f"can't be read: {str(error)[:120]}, expected an ONNX landmark network") from None
        outputs = {one.name for one in self._session.get_outputs()}
        try:
            described = json.loads(self._session.get_modelmeta().custom_metadata_map[_KEY])
            known = described["kind"] == "landmarks" and {"landmarks", "presence"} <= outputs
            self.size = int(described["size"])
            self._mean, self._std = (np.asarray(described[key], np.float32).reshape(3, 1, 1) for key in ("mean", "std"))
        except (KeyError, TypeError, ValueError):
            known = False
        if not known:
            raise InputError(where, f"no landmark network, expected '{_KEY}' of kind landmarks and both its outputs")

    def __call__(self, crops: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Landmarks (b, 68, 2) in pixels of the crops and presence (b,) of sRGB crops (b, 3, S, S) in 0..1."""
        landmarks, presence = [np.zeros((0, 68, 2))], [np.zeros(0)]
        for start in range(0, len(crops), _BATCH):
            batch = (np.asarray(crops[start : start + _BATCH], np.float32) - self._mean) / self._std
            places, present = self._session.run(["landmarks", "presence"], {"image": batch})
            landmarks.append(places.astype(np.float64) * self.size)
            presence.append(present[:, 0].astype(np.float64))
        return np.concatenate(landmarks), np.concatenate(presence)
