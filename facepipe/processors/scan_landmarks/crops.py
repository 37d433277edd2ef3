"""Crops of a picture for the landmark network: anywhere, turned, of any size, many at once."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray

_COARSE = 1.5  # pixels of a picture a pixel of a crop: beyond, half the picture is enough


def crop_matrix(middle: FloatArray, side: float, turn: float, size: int) -> FloatArray:
    """(2, 3) from crop pixels to picture pixels: a square about `middle` (2,), turned by radians."""
    scale = side / size
    linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return np.column_stack([linear, np.asarray(middle) - linear @ np.full(2, size / 2)])


def cut_crops(picture: FloatArray, matrices: FloatArray, size: int) -> FloatArray:
    """(k, 3, size, size) float32 crops of a picture (h, w, 3) by matrices (k, 2, 3), bilinear; outside, its border."""
    import torch
    from torch.nn import functional

    image = torch.as_tensor(np.asarray(picture, np.float32)).permute(2, 0, 1)[None]
    scales = np.linalg.norm(matrices[:, :, 0], axis=1)
    half = functional.avg_pool2d(image, 2)
    crops = np.empty((len(matrices), 3, size, size), np.float32)
    for source, chosen in ((image, scales <= _COARSE), (half, scales > _COARSE)):
        if chosen.any():
            crops[chosen] = _sampled(source, _places(matrices[chosen], size, picture.shape[:2]))
    return crops


def in_picture(landmarks: FloatArray, matrices: FloatArray) -> FloatArray:
    """(k, 68, 2) landmarks of crops in pixels of the picture."""
    turned = np.einsum("kij,klj->kli", matrices[:, :, :2], landmarks)
    return np.asarray(turned + matrices[:, None, :, 2])


def _places(matrices: FloatArray, size: int, shape: tuple[int, ...]) -> FloatArray:
    """(k, size, size, 2) x and y of every pixel, -1 to 1 over the picture."""
    center = np.arange(size, dtype=np.float32) + 0.5
    scaled = np.asarray(2 * matrices / np.array([[shape[1]], [shape[0]]]), np.float32)[
        ..., None, None
    ]  # (k, 2, 3, 1, 1)
    across, down, start = scaled[:, :, 0], scaled[:, :, 1], scaled[:, :, 2]
    places = across * center[None, :] + (down * center[:, None] + (start - 1))  # (k, 2, size, size)
    return np.ascontiguousarray(np.moveaxis(places, 1, 3))


def _sampled(image: object, places: FloatArray) -> FloatArray:
    import torch
    from torch.nn import functional

    count, size = places.shape[:2]
    grid = torch.as_tensor(places.reshape(1, count * size, size, 2))
    found = functional.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return np.asarray(found[0].reshape(3, count, size, size).permute(1, 0, 2, 3).numpy())
