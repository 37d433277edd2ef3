"""What the report page of a photo fit shows, from the fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import FaceParts, Material, TextureInput
from facepipe.processors.photo_fit.text import ENDS
from facepipe.rig import Rig, build, slide

if TYPE_CHECKING:
    from facepipe.learn.face_model import FaceModel
    from facepipe.learn.photo.result import FittedView, PhotoFit
    from facepipe.pictures import PhotoSheet, SheetPhoto
    from facepipe.processors.photo_fit.photo_file import Photo


def report_sheet(
    parts: FaceParts, fit: PhotoFit, photos: Sequence[Photo], *, seconds: float | None = None
) -> PhotoSheet:
    """What `facepipe.pictures.photo_page` shows of a fit.

    :param parts: the face that was fitted, without the result
    :param photos: that were fitted, one a view
    :param seconds: that the fit took
    :raises InputError: sliders, shapes or materials that the face does not have
    """
    from facepipe.learn.face_model import FaceModel
    from facepipe.pictures import PhotoSheet

    tinted = replace(parts, materials=tuple(_tinted(one, fit.tint.get(one.name)) for one in parts.materials))
    rig, model = build(tinted), FaceModel(tinted)
    return PhotoSheet(
        parts=tinted,
        neutral=_points(rig, tinted, fit),
        photos=tuple(_photo(rig, tinted, fit, model, *one) for one in zip(photos, fit.views, strict=True)),
        sliders=fit.sliders,
        history=fit.history,
        kept=fit.kept,
        seconds=seconds,
        note=ENDS[fit.stopped],
    )


def _points(rig: Rig, parts: FaceParts, fit: PhotoFit, view: FittedView | None = None) -> FloatArray:
    """(n, 3) world points of the neutral, or of the person in a view."""
    coefficients, weights = slide(parts.sliders, rig.joints, fit.sliders)
    for name, weight in (view.expressions if view else {}).items():
        weights[name] = weights.get(name, 0.0) + weight
    return rig.evaluate(weights, coefficients=coefficients)


def _photo(rig: Rig, parts: FaceParts, fit: PhotoFit, model: FaceModel, photo: Photo, view: FittedView) -> SheetPhoto:
    from facepipe.geometry.landmarks import eye_distance
    from facepipe.learn.photo.view_image import project, view_image
    from facepipe.pictures import SheetPhoto

    points = _points(rig, parts, fit, view)
    height, width = photo.pixels.shape[:2]
    return SheetPhoto(
        name=photo.name,
        photo=photo.pixels,
        render=view_image(model, view, points, (width, height)),
        screen=project(view.camera, points),
        targets=np.asarray(view.targets),
        landmarks=np.asarray(view.landmarks),
        landmark_error=view.landmark_error,
        eye_distance=eye_distance(view.targets),
        expressions=view.expressions,
    )


def _tinted(material: Material, tint: tuple[float, float, float] | None) -> Material:
    """The material with its colour multiplied."""
    color = material.diffuse_color
    if tint is None:
        return material
    if not isinstance(color, TextureInput):
        return replace(material, diffuse_color=_product(color, tint))
    scale, bias = ((*_product(each[:3], tint), each[3]) for each in (color.scale, color.bias))
    return replace(material, diffuse_color=replace(color, scale=scale, bias=bias))


def _product(color: tuple[float, float, float], tint: tuple[float, float, float]) -> tuple[float, float, float]:
    return color[0] * tint[0], color[1] * tint[1], color[2] * tint[2]
