"""What a network for first guesses is trained on: heads with landmarks, of photos or rendered with known parameters.

They are varied as the world varies them: noisy landmarks, other lights and cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from facepipe.core.arrays import ByteArray, FloatArray
from facepipe.geometry.face_crops import face_crop, to_crop
from facepipe.geometry.landmarks import eye_distance
from facepipe.networks.crops import sample_crop
from facepipe.photo.amortised.network import MEAN, SIZE, STD
from facepipe.photo.amortised.pose import CropSpace
from facepipe.photo.descent.pose import PoseSpace
from facepipe.photo.descent.working_photo import WorkingPhoto, to_linear

_GAIN, _CAST, _SHADE, _NOISE = 0.2, 0.07, 0.25, 0.02  # standard deviations; all but noise of logarithms
_CELLS = 4  # a side of the picture that shades
HEAD = 160  # pixels a side, about, at which heads are seen


def noisy_landmarks(picture: Picture, sigma: float, rng: np.random.Generator) -> FloatArray:
    """(68, 2) with noise of up to `sigma`, a share of the distance of the outer eye corners."""
    spread = sigma * rng.uniform(0, 1) * max(eye_distance(picture.landmarks), 1.0)
    return np.asarray(picture.landmarks + spread * rng.standard_normal(picture.landmarks.shape))


def batch(crops: Sequence[Crop]) -> tuple[Tensor, Tensor]:
    """What the network takes."""
    return torch.stack([crop.image for crop in crops]), torch.stack([crop.landmarks for crop in crops])


def varied(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Crops (b, 3, s, s) as the network takes them, in other light and with noise."""
    count = len(images)
    gain = rng.normal(0, _GAIN, (count, 1, 1, 1)) + rng.normal(0, _CAST, (count, 3, 1, 1))
    shade = rng.normal(0, _SHADE, (count, 1, _CELLS, _CELLS)) * rng.random((count, 1, 1, 1))
    factor = functional.interpolate(_float(shade), images.shape[2:], mode="bicubic", align_corners=False)
    noise = torch.randn(images.shape, generator=torch.Generator().manual_seed(int(rng.integers(2**31))))
    strength = _float(_NOISE * rng.random((count, 1, 1, 1)))
    light = (images * STD + MEAN) * (factor + _float(gain)).exp() + strength * noise
    return (light.clamp(0, 1) - MEAN) / STD


def _float(values: FloatArray) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float32)


@dataclass(frozen=True, kw_only=True)
class Truth:
    """The parameters of a render, and its lamp."""

    shares: FloatArray  # (f,)
    expressions: FloatArray  # (e,)
    pose: FloatArray  # (7,) as `PoseSpace`
    lamp: Tensor  # (8,) as `KeyLight`


@dataclass(frozen=True, kw_only=True)
class Picture:
    """The head in a photo, in few bytes."""

    pixels: ByteArray  # (h, w, 3) sRGB
    left: int  # as `WorkingPhoto`
    top: int
    step: int
    landmarks: FloatArray  # (68, 2) pixels of the photo
    space: PoseSpace
    truth: Truth | None = None

    @classmethod
    def from_photo(cls, photo: FloatArray, landmarks: FloatArray, space: PoseSpace) -> Picture:
        """The head around the landmarks in a photo (h, w, 3) sRGB 0..1."""
        seen = WorkingPhoto.from_photo(photo, landmarks, HEAD)
        pixels = np.round(seen.pixels.numpy() * 255).astype(np.uint8)
        return cls(pixels=pixels, left=seen.left, top=seen.top, step=seen.step, landmarks=landmarks, space=space)

    def working(self) -> WorkingPhoto:
        """As the joint loss compares it."""
        pixels = torch.as_tensor(self.pixels, dtype=torch.float32) / 255
        place = {"left": self.left, "top": self.top, "step": self.step}
        return WorkingPhoto(pixels=pixels, linear=to_linear(pixels), face=torch.ones(pixels.shape[:2]), **place)

    def crop(self, landmarks: FloatArray) -> Crop:
        """The crop by landmarks (68, 2) in pixels of the photo.

        :raises InputError: as `face_crop`
        """
        matrix = face_crop(landmarks, SIZE)
        window = matrix - np.array([[0, 0, self.left], [0, 0, self.top]])
        pixels = torch.as_tensor(self.pixels, dtype=torch.float32) / 255
        image = (sample_crop(pixels, window / self.step, SIZE)[0] - MEAN) / STD
        shares = torch.as_tensor(to_crop(landmarks, matrix) / SIZE, dtype=torch.float32)
        return Crop(image=image, landmarks=shares, matrix=matrix)


@dataclass(frozen=True, kw_only=True)
class Crop:
    """What the network is given of a picture, and where that lies."""

    image: Tensor  # (3, 128, 128) as the network takes it
    landmarks: Tensor  # (68, 2) sides of the crop
    matrix: FloatArray  # (2, 3) from crop pixels to photo pixels

    def space(self, photo: PoseSpace, up_axis: str) -> CropSpace:
        """Of poses relative to this crop."""
        return CropSpace(space=photo, crop=self.matrix, side=SIZE, up_axis=up_axis)
