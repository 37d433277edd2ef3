"""A face as a photo shows it, drawn with all its surfaces in the photo's camera and light: lashes and hair too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.core.arrays import Float32Array, FloatArray
from facepipe.geometry.colors import from_srgb
from facepipe.parts import FaceParts, Material, PhotoView, TextureInput
from facepipe.pictures.camera import Camera, y_up
from facepipe.pictures.draw import draw
from facepipe.pictures.photo_light import PhotoLights
from facepipe.pictures.scene import build_scene
from facepipe.pictures.shade import Shader

LARGEST = 1024  # pixels of a render's longer side
_SAMPLES = 2


def photo_render(parts: FaceParts, view: PhotoView, points: FloatArray) -> FloatArray:
    """(h, w, 4) linear colour on black and coverage 0..1 of a face as a photo shows it, with the tints that it has.

    :param points: (n, 3) world points of the face as it is in the photo
    :raises InputError: points that don't fit or aren't finite, a broken texture
    """
    share = min(1.0, LARGEST / max(view.width, view.height))
    width, height = (max(1, round(each * share)) for each in (view.width, view.height))
    fine = max(1, LARGEST // max(width, height))  # small ones are drawn larger, where details are not blurred
    size = fine * max(width, height)
    scene = build_scene(_tinted(parts, view), points, size)
    shader = Shader(scene, camera_of(view, parts.up_axis).scaled(fine * share), lights=PhotoLights(view=view))
    mm = 1000 * parts.meters_per_unit
    on_black, on_white = (_drawn(shader, size, level, mm)[: fine * height, : fine * width] for level in (0.0, 1.0))
    coverage = 1 - (on_white - on_black).mean(axis=2, keepdims=True)
    image = np.concatenate([on_black, coverage.clip(0, 1)], axis=2)
    return np.asarray(image.reshape(height, fine, width, fine, 4).mean(axis=(1, 3)))


def _drawn(shader: Shader, size: int, level: float, mm: float) -> FloatArray:
    """(size, size, 3) linear, on a background of one brightness."""
    background: Float32Array = np.full((size, size, 3), level, np.float32)
    return np.asarray(from_srgb(draw(shader, size, background, _SAMPLES, mm) / np.float32(255)))


def camera_of(view: PhotoView, up_axis: str) -> Camera:
    """The camera of a photo in the Y-up world."""
    transform = np.asarray(view.transform, dtype=np.float64)
    axes, eye = transform[:3, :3].T, transform[:3, 3]
    return Camera(axes=y_up(axes, up_axis), eye=y_up(eye[None], up_axis)[0], focal=view.focal, center=view.center)


def _tinted(parts: FaceParts, view: PhotoView) -> FaceParts:
    """The face with its materials' colours as a photo's tints make them."""
    return replace(parts, materials=tuple(_with_tint(one, view.tint.get(one.name)) for one in parts.materials))


def _with_tint(material: Material, tint: tuple[float, float, float] | None) -> Material:
    if tint is None:
        return material
    color = material.diffuse_color
    if not isinstance(color, TextureInput):
        red, green, blue = (one * factor for one, factor in zip(color, tint, strict=True))
        return replace(material, diffuse_color=(red, green, blue))
    red, green, blue, alpha = (one * factor for one, factor in zip(color.scale, (*tint, 1.0), strict=True))
    return replace(material, diffuse_color=replace(color, scale=(red, green, blue, alpha)))
