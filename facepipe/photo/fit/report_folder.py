"""The report folder of a photo fit: its page, pictures and landmarks."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from facepipe.core.arrays import FloatArray
from facepipe.core.atomic import write_bytes
from facepipe.geometry.colors import to_srgb
from facepipe.parts import FaceParts, Material, TextureInput
from facepipe.photo.fit.landmark_file import write_landmarks
from facepipe.photo.fit.report import ENDS
from facepipe.photo.pictures import photo_pictures as pictures
from facepipe.photo.pictures.photo_report import photo_page
from facepipe.pictures import save_png
from facepipe.rig import Rig, build, slide

if TYPE_CHECKING:
    from facepipe.photo.descent.result import FittedView, PhotoFit
    from facepipe.photo.fit.fit_face import Fitted
    from facepipe.photo.fit.photo_file import Photo
    from facepipe.photo.fit.report import PhotoFitReport
    from facepipe.photo.pictures.photo_report import PhotoSheet, SheetPhoto
    from facepipe.photo.renderer.face_model import FaceModel

_OVERLAY = 1024  # pixels of an overlay's longer side
_MARK = 1 / 120  # of the landmarks' larger extent, the radius of one
_LEAST = 1.5  # pixels of that


def report_sheet(parts: FaceParts, fit: PhotoFit, photos: Sequence[Photo]) -> PhotoSheet:
    """What `facepipe.pictures.photo_page` shows of a fit.

    :param parts: the face that was fitted, without the result
    :param photos: that were fitted, one a view
    :raises InputError: sliders, shapes or materials that the face does not have
    """
    from facepipe.photo.pictures.photo_report import PhotoSheet
    from facepipe.photo.renderer.face_model import FaceModel

    tinted = replace(
        parts, materials=tuple(_tinted(material, fit.tint.get(material.name)) for material in parts.materials)
    )
    rig, model = build(tinted), FaceModel(tinted)
    return PhotoSheet(
        parts=tinted,
        neutral=fitted_points(rig, tinted, fit),
        photos=tuple(_photo(rig, tinted, fit, model, *one) for one in zip(photos, fit.views, strict=True)),
        sliders=fit.sliders,
        history=fit.history,
        kept=fit.kept,
        note=ENDS[fit.stopped],
    )


def fitted_points(rig: Rig, parts: FaceParts, fit: PhotoFit, view: FittedView | None = None) -> FloatArray:
    """(n, 3) world points of the neutral, or of the person in a view."""
    coefficients, weights = slide(parts.sliders, rig.joints, fit.sliders)
    for name, weight in (view.expressions if view else {}).items():
        weights[name] = weights.get(name, 0.0) + weight
    return rig.evaluate(weights, coefficients=coefficients)


def _photo(rig: Rig, parts: FaceParts, fit: PhotoFit, model: FaceModel, photo: Photo, view: FittedView) -> SheetPhoto:
    from facepipe.geometry.landmarks import eye_distance
    from facepipe.photo.descent.view_image import project, view_image
    from facepipe.photo.pictures.photo_report import SheetPhoto

    points = fitted_points(rig, parts, fit, view)
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


def write_folder(folder: Path, fitted: Fitted, report: PhotoFitReport) -> None:
    """Write report.html, report.json and, called as the poses of the photos, their renders, overlays and landmarks."""
    photos, names = fitted.inputs.photos, [one.animation for one in report.photos.values()]
    alike = [photo.similarity for photo in report.photos.values()]
    both = zip(fitted.sheet.photos, alike, strict=True)
    sheet = replace(
        fitted.sheet, photos=tuple(replace(photo, similarity=one) for photo, one in both), unseen=report.unseen
    )
    for name, one, photo, marks in zip(names, sheet.photos, photos, fitted.inputs.landmarks, strict=True):
        save_png(render_image(one.render), folder / f"{name}.render.png")
        save_png(overlay_image(one, sheet), folder / f"{name}.overlay.png")
        write_landmarks(folder / f"{name}.landmarks.json", marks, photo)
    write_bytes(folder / "report.html", photo_page(sheet))
    figures = report.to_dict()
    del figures["seconds"]  # the same input gives the same bytes
    write_bytes(folder / "report.json", f"{json.dumps(figures, sort_keys=True, indent=2)}\n".encode())


def render_image(render: FloatArray) -> Image.Image:
    """An 8-bit picture, transparent around the face, of linear colour on black and coverage (h, w, 4)."""
    cover = np.clip(render[..., 3:], 0, 1)
    color = to_srgb(np.clip(render[..., :3] / np.maximum(cover, 1e-6), 0, 1))
    return Image.fromarray((np.concatenate([color * (cover > 0), cover], axis=2) * 255 + 0.5).astype(np.uint8))


def overlay_image(photo: SheetPhoto, sheet: PhotoSheet) -> Image.Image:
    """The photo, darker, with the edges of the fitted face, its landmarks, and those that it was given as rings."""
    height, width = photo.photo.shape[:2]
    crop = pictures.whole(width, height, _OVERLAY)
    image = pictures.wireframe_picture(photo.photo, crop, sheet.parts, photo.screen)
    given, fitted = crop.place(photo.targets), crop.place(photo.landmarks)
    radius = max(_LEAST, _MARK * float(np.ptp(given, axis=0).max()))
    pictures.given_mark(image, given, radius)
    pictures.fitted_mark(image, fitted, radius)
    (left, top), (right, bottom) = np.rint(crop.place(np.array([(0.0, 0.0), (width, height)]))).astype(int).tolist()
    return image.crop((left, top, max(right, left + 1), max(bottom, top + 1)))
