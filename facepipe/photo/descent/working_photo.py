"""The part of a photo that a fit looks at: the head, at about the resolution that is asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.photo.renderer.camera import Camera

_ROOM = 1.9  # sides of the box of the landmarks that a head with hair and neck takes
_UP = 0.12  # of that box's height by which the head's middle is above the landmarks'


@dataclass(frozen=True, kw_only=True)
class WorkingPhoto:
    """A window of whole photo pixels, averaged over `step` by `step` of them."""

    pixels: Tensor  # (h, w, 3) sRGB 0..1
    linear: Tensor  # (h, w, 3)
    face: Tensor  # (h, w) share that is face, 0..1
    left: int  # of the window, photo pixels
    top: int
    step: int

    @classmethod
    def from_photo(
        cls, photo: FloatArray, landmarks: FloatArray, size: int, face: FloatArray | None = None
    ) -> WorkingPhoto:
        """The head around `landmarks` (68, 2) in a photo (h, w, 3) sRGB 0..1, at most about `size` pixels a side.

        Windows are cut at the photo's borders and never enlarged.

        :param face: (h, w) share of the photo's pixels that is face; None: all
        """
        height, width = photo.shape[:2]
        low, high = landmarks.min(axis=0), landmarks.max(axis=0)
        side = _ROOM * float((high - low).max())
        middle = (low + high) / 2 - (0.0, _UP * float(high[1] - low[1]))
        step = max(1, min(round(side / size), height, width))
        half = side / 2
        left, right = _window(middle[0] - half, middle[0] + half, width, step)
        top, bottom = _window(middle[1] - half, middle[1] + half, height, step)
        rows, columns = (bottom - top) // step, (right - left) // step

        def averaged(values: FloatArray) -> Tensor:
            window = np.asarray(values[top:bottom, left:right], dtype=np.float32)
            return torch.as_tensor(window.reshape(rows, step, columns, step, -1).mean(axis=(1, 3)))

        pixels = averaged(photo)
        shown = torch.ones(pixels.shape[:2]) if face is None else averaged(face)[..., 0]
        return cls(pixels=pixels, linear=to_linear(pixels), face=shown, left=left, top=top, step=step)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in working pixels."""
        return self.pixels.shape[0], self.pixels.shape[1]

    def camera(self, camera: Camera) -> Camera:
        """A camera of the photo in working pixels."""
        corner = camera.center.new_tensor([self.left, self.top])
        return replace(camera, focal=camera.focal / self.step, center=(camera.center - corner) / self.step)

    def landmarks(self, landmarks: FloatArray) -> FloatArray:
        """(68, 2) photo pixels in working pixels."""
        return np.asarray((landmarks - (self.left, self.top)) / self.step)


def to_linear(color: Tensor) -> Tensor:
    """Linear light of sRGB 0..1 (IEC 61966-2-1): `geometry.colors.from_srgb` with gradients."""
    return torch.where(color <= 0.04045, color / 12.92, ((color.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4)


def to_srgb(light: Tensor) -> Tensor:
    """sRGB of linear light (IEC 61966-2-1), 0..1: `geometry.colors.to_srgb` with gradients."""
    light = light.clamp(0, 1)
    return torch.where(light <= 0.0031308, light * 12.92, 1.055 * light.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def _window(low: float, high: float, limit: int, step: int) -> tuple[int, int]:
    """First pixel and the one after the last of a span inside the photo, a multiple of `step` long."""
    first = int(np.clip(np.floor(low), 0, max(limit - step, 0)))
    last = int(np.clip(np.ceil(high), first + step, limit))
    return first, first + max((last - first) // step, 1) * step
