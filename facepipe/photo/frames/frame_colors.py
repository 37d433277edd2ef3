"""Colours of video frames as sRGB: by the matrix, range, transfer curve and primaries that the video says it has."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import ByteArray, Float32Array
from facepipe.geometry.colors import from_srgb, to_srgb

# Numbers of ITU-T H.273
_MATRICES = {1: 1, 4: 4, 5: 5, 6: 5, 7: 7, 9: 9, 10: 9}  # of a frame -> of the scaler
_BT709, _BT601, _FULL = 1, 5, 2
_HD = 720  # rows or columns from which on a video that does not say its matrix has that of BT.709
_PQ, _HLG = 16, 18
_TO_BT709 = {
    9: ((1.6605, -0.5876, -0.0728), (-0.1246, 1.1329, -0.0083), (-0.0182, -0.1006, 1.1187)),  # BT.2020
    12: ((1.2249, -0.2249, 0.0), (-0.0421, 1.0421, 0.0), (-0.0196, -0.0786, 1.0983)),  # Display P3
}
_WHITE = 203.0  # cd/m2 of a sheet of paper in HDR (BT.2408)
_PEAK = 1000.0  # cd/m2 of the screen that HLG is graded on
_BT2020_LUMA = np.array((0.2627, 0.6780, 0.0593), np.float32)
_SHOULDER = 0.8  # linear; brighter colours are pressed together below 1


def srgb_picture(frame: Any, size: tuple[int, int]) -> ByteArray:
    """(h, w, 3) sRGB of a frame of PyAV, not turned yet.

    :param size: width and height to scale it to
    """
    curve, matrix = int(frame.color_trc), _TO_BT709.get(int(frame.color_primaries))
    wide = curve in (_PQ, _HLG) or matrix is not None
    unsaid = _BT709 if min(frame.width, frame.height) >= _HD else _BT601
    shrinks = size[0] * size[1] < frame.width * frame.height
    rgb = frame.reformat(
        *size,
        format="rgb48le" if wide else "rgb24",
        src_colorspace=_MATRICES.get(int(frame.colorspace), unsaid),
        dst_color_range=_FULL,
        interpolation="AREA" if shrinks else "BICUBIC",
    ).to_ndarray()
    if not wide:
        return np.ascontiguousarray(rgb)
    return np.concatenate([_narrowed(band, curve, matrix) for band in np.array_split(rgb, max(len(rgb) // 64, 1))])


def _narrowed(rgb: npt.NDArray[np.uint16], curve: int, matrix: tuple[tuple[float, ...], ...] | None) -> ByteArray:
    """HDR and wide colours as sRGB, paper white as its white."""
    light = _linear(rgb.astype(np.float32) / np.float32(65535), curve)
    if matrix is not None:
        light = np.maximum(light @ np.array(matrix, np.float32).T, 0)
    most = np.maximum(light.max(axis=-1, keepdims=True), 1e-6)
    room = 1 - _SHOULDER
    pressed = np.where(most < _SHOULDER, most, 1 - room * np.exp((_SHOULDER - most) / room))
    pressed = pressed if curve in (_PQ, _HLG) else np.minimum(most, 1)  # others have nothing above white
    return np.asarray(to_srgb(light * (pressed / most)) * 255 + 0.5).astype(np.uint8)


def _linear(signal: Float32Array, curve: int) -> Float32Array:
    """Light on the screen over that of paper white (BT.2100)."""
    if curve == _PQ:
        root = signal ** (1 / 78.84375)
        light = (
            10000 / _WHITE * (np.maximum(root - 0.8359375, 0) / (18.8515625 - 18.6875 * root)) ** (1 / 0.1593017578125)
        )
    elif curve == _HLG:
        scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - 0.55991073) / 0.17883277) + 0.28466892) / 12)
        luma = np.maximum(scene @ _BT2020_LUMA, 1e-9)[..., None]
        light = _PEAK / _WHITE * scene * luma**0.2
    else:
        light = from_srgb(signal)
    return np.asarray(light, dtype=np.float32)
