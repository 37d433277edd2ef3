"""What a fitted camera sees, in numpy."""

from __future__ import annotations

import numpy as np
import torch

from facepipe.core.arrays import FloatArray
from facepipe.learn.camera import Camera
from facepipe.learn.face_model import FaceModel, Look
from facepipe.learn.light import DARK, KeyLight
from facepipe.learn.photo.result import FittedCamera, FittedView
from facepipe.learn.photo.shadows import Shadows
from facepipe.parts import PhotoView

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
    return _image(model, points, size, view.camera, (view.light, view.key))


def photo_image(model: FaceModel, photo: PhotoView, points: FloatArray) -> FloatArray:
    """(h, w, 4) as `view_image`, of a photo on a stage, with the tints that it has.

    :param points: (n, 3) world points of the face as it is in the photo
    """
    from scipy.spatial.transform import Rotation

    inverse = np.linalg.inv(np.asarray(photo.transform, dtype=np.float64))
    camera = FittedCamera(
        rotation=Rotation.from_matrix(inverse[:3, :3]).as_rotvec(),
        translation=inverse[:3, 3],
        focal=photo.focal,
        center=photo.center,
    )
    lamp = photo.key
    key = DARK if lamp is None else (*lamp.direction, *lamp.color, lamp.shine, np.log(lamp.exponent))
    tint = torch.tensor([photo.tint.get(name, (1.0, 1.0, 1.0)) for name in model.colors.names], dtype=torch.float32)
    return _image(model, points, (photo.width, photo.height), camera, (photo.light, np.array(key)), tint)


def _image(
    model: FaceModel,
    points: FloatArray,
    size: tuple[int, int],
    camera: FittedCamera,
    numbers: tuple[FloatArray, FloatArray],
    tint: torch.Tensor | None = None,
) -> FloatArray:
    """:param numbers: of harmonics (9, 3) and lamp (8,)"""
    share = min(1.0, LARGEST / max(size))
    width, height = (max(1, round(each * share)) for each in size)
    light, key, place = (torch.as_tensor(np.asarray(each), dtype=torch.float32) for each in (*numbers, points))
    reduced = camera_of(camera, share, torch.float32)
    with torch.no_grad():
        shadows = Shadows.from_lamp(model, place, reduced, key)
        look = Look(
            camera=reduced,
            light=light,
            background=torch.zeros(3),
            tint=tint,
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
