"""What a fitted camera sees, in numpy."""

from __future__ import annotations

import numpy as np
import torch

from facepipe.core.arrays import FloatArray
from facepipe.photo.descent.result import FittedCamera, FittedView
from facepipe.photo.descent.shadows import Shadows
from facepipe.photo.renderer.camera import Camera
from facepipe.photo.renderer.face_model import FaceModel, Look
from facepipe.photo.renderer.light import KeyLight

LARGEST = 1024  # pixels of an image's longer side


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
