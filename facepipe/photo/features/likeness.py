"""How alike a recognition network finds a photo and a render of it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity

from facepipe.core.arrays import FloatArray
from facepipe.geometry.colors import to_srgb
from facepipe.networks.crops import sample_crop
from facepipe.photo.features.extractor import Extractor

_GREY = 0.5  # sRGB, off the render


def similarity(network: Extractor, photo: FloatArray, render: FloatArray, landmarks: FloatArray) -> float | None:
    """Cosine of the angle between the embeddings of a photo and a render, 1 for the same person; None: they are NaN.

    Both are cut at the same place, and are the same grey where the render shows nothing, so that neither background
    nor clothes count.

    :param network: of kind `identity`
    :param photo: (h, w, 3) sRGB
    :param render: (rh, rw, 4) linear colour on black and coverage 0..1, of all that the photo shows, any size
    :param landmarks: (68, 2) pixels of the photo
    """
    assert network.kind == "identity", network.kind
    matrix = network.crop_matrix(landmarks)
    reduced = matrix * (render.shape[1] / photo.shape[1])
    cover = np.clip(render[..., 3:], 0, 1)
    # sRGB is not linear: of colour on black it would change the tone of outlines; cut with coverage, since the cut
    # averages pixels
    color = to_srgb(np.clip(render[..., :3] / np.maximum(cover, 1e-6), 0, 1))
    with torch.no_grad():
        shown, share = (_cut(pixels, reduced, network.size) for pixels in (color * cover, cover))
        both = (shown, _cut(photo, matrix, network.size) * share)
        first, second = (network((each + _GREY * (1 - share)).clamp(0, 1)) for each in both)
    cosine = float(cosine_similarity(first.flatten(1), second.flatten(1))[0])
    return cosine if np.isfinite(cosine) else None


def _cut(pixels: FloatArray, matrix: FloatArray, size: int) -> Tensor:
    return sample_crop(torch.as_tensor(np.ascontiguousarray(pixels, dtype=np.float32)), matrix, size)
