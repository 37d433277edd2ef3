"""The report folder of a photo fit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from facepipe.core.atomic import write_bytes
from facepipe.geometry.colors import to_srgb
from facepipe.pictures import photo_page, save_png
from facepipe.pictures import photo_pictures as pictures
from facepipe.processors.photo_fit.landmark_file import write_landmarks
from facepipe.processors.photo_fit.report_sheet import report_sheet

if TYPE_CHECKING:
    from facepipe.pictures import PhotoSheet, SheetPhoto
    from facepipe.processors.photo_fit.fit_face import Fitted
    from facepipe.processors.photo_fit.report import PhotoFitReport

_OVERLAY = 1024  # pixels of an overlay's longer side
_MARK = 1 / 120  # of the landmarks' larger extent, the radius of one
_LEAST = 1.5  # pixels of that


def write_folder(folder: Path, fitted: Fitted, report: PhotoFitReport) -> None:
    """Write report.html, report.json and, called as the poses of the photos, their renders, overlays and landmarks."""
    photos, names = fitted.inputs.photos, [one.animation for one in report.photos.values()]
    sheet = report_sheet(fitted.parts, fitted.fit, photos)
    for name, one, photo, marks in zip(names, sheet.photos, photos, fitted.inputs.landmarks, strict=True):
        save_png(render_image(one), folder / f"{name}.render.png")
        save_png(overlay_image(one, sheet), folder / f"{name}.overlay.png")
        write_landmarks(folder / f"{name}.landmarks.json", marks, photo)
    write_bytes(folder / "report.html", photo_page(sheet))
    figures = json.loads(report.to_json())
    del figures["seconds"]  # the same input gives the same bytes
    write_bytes(folder / "report.json", f"{json.dumps(figures, sort_keys=True, indent=2)}\n".encode())


def render_image(one: SheetPhoto) -> Image.Image:
    """The face as the camera of the photo sees it, sRGB, transparent around it."""
    cover = np.clip(one.render[..., 3:], 0, 1)
    color = to_srgb(np.clip(one.render[..., :3] / np.maximum(cover, 1e-6), 0, 1))
    return Image.fromarray((np.concatenate([color * (cover > 0), cover], axis=2) * 255 + 0.5).astype(np.uint8))


def overlay_image(one: SheetPhoto, sheet: PhotoSheet) -> Image.Image:
    """The photo, darker, with the edges of the fitted face, its landmarks, and those that it was given as rings."""
    height, width = one.photo.shape[:2]
    crop = pictures.whole(width, height, _OVERLAY)
    image = pictures.wireframe_picture(one.photo, crop, sheet.parts, one.screen)
    given, fitted = crop.place(one.targets), crop.place(one.landmarks)
    radius = max(_LEAST, _MARK * float(np.ptp(given, axis=0).max()))
    pictures.given_mark(image, given, radius)
    pictures.fitted_mark(image, fitted, radius)
    (left, top), (right, bottom) = np.rint(crop.place(np.array([(0.0, 0.0), (width, height)]))).astype(int).tolist()
    return image.crop((left, top, max(right, left + 1), max(bottom, top + 1)))
