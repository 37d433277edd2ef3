"""The part of a photo that a fit looks at, at about the resolution asked for, and what a fitted camera sees."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.photo.descent.shadows import Shadows
from facepipe.photo.descent.subject import FittedCamera, FittedView
from facepipe.photo.renderer.camera import Camera
from facepipe.photo.renderer.face_model import FaceModel, Look
from facepipe.photo.renderer.light import KeyLight

LARGEST = 1024  # pixels of an image's longer side
_ROOM = 1.9  # sides of the box of the landmarks that a head with hair and neck takes
_UP = 0.12  # of that box's height by which the head's middle is above the landmarks'


def project(camera: FittedCamera, points: FloatArray) -> FloatArray:
    """(n, 3) pixel x and y of the photo, and depth in stage units, of world points (n, 3)."""
    seen = camera_of(camera, 1.0, torch.float64).project(torch.as_tensor(np.asarray(points, dtype=np.float64)))
    return np.asarray(seen.numpy())


def view_image(model: FaceModel, view: FittedView, points: FloatArray, size: tuple[int, int]) -> FloatArray:
    """(h, w, 4) linear colour on black and coverage 0..1 of a face as the photo of a view shows it, self-shadows too.

    :param points: (n, 3) world points
    :param size: width and height of the photo; the image of a larger one than `LARGEST` is reduced to that
    """
    share = min(1.0, LARGEST / max(size))
    width, height = (max(1, round(each * share)) for each in size)
    light, key, place = (
        torch.as_tensor(np.asarray(each), dtype=torch.float32) for each in (view.light, view.key, points)
    )
    reduced = camera_of(view.camera, share, torch.float32)
    with torch.no_grad():
        shadows = Shadows.from_lamp(model, place, reduced, key)
        look = Look(
            camera=reduced,
            light=light,
            background=torch.zeros(3),
            shadow=shadows.transfer,
            key=KeyLight(numbers=key, arriving=shadows.arriving),
        )
        image = model.image(place, look, height=height, width=width)
    return np.asarray(image.numpy())


def camera_of(camera: FittedCamera, share: float, dtype: torch.dtype) -> Camera:
    """The camera of a photo that is reduced to a share of its size."""
    numbers = (camera.rotation, camera.translation, camera.focal * share, np.array(camera.center) * share)
    rotation, translation, focal, center = (torch.as_tensor(np.asarray(number), dtype=dtype) for number in numbers)
    return Camera(rotation=rotation, translation=translation, focal=focal, center=center)


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

        Windows are cut at the photo's borders, never enlarged. `face` (h, w) is how far pixels are face; None: all.
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
