"""The report folder of a photo fit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.report_folder import REPORT, check_report_folder

if TYPE_CHECKING:
    from PIL.Image import Image

    from facepipe.pictures import PhotoSheet, SheetPhoto
    from facepipe.processors.photo_fit import Landmarks68, Photo, PhotoFitReport

_SHEET = "sheet.png"
_KNOWN = re.compile(r"report\.json|sheet\.png|[^/]+\.(landmarks\.json|render\.png|overlay\.png)")
_OVERLAY = 1024  # pixels of an overlay's longer side
_MARK = 1 / 120  # of the landmarks' larger extent, the radius of one
_LEAST = 1.5  # pixels of that


def check_folder(folder: Path, *, force: bool, taken: Sequence[Path]) -> None:
    """Check that a report may be written as `folder`: that it is new, or with `force` a report from before.

    :param taken: files that must not be in it: inputs and outputs
    :raises InputError: it may not
    """
    check_report_folder(folder, force=force, taken=taken, known=_KNOWN, command="fit-photo")


def write_folder(
    folder: Path, sheet: PhotoSheet, photos: Sequence[Photo], landmarks: Sequence[Landmarks68], report: PhotoFitReport
) -> None:
    """Write sheet.png, report.json and, called as the poses of the photos, their renders, overlays and landmarks."""
    from facepipe.core.atomic import write_bytes
    from facepipe.pictures import photo_sheet, save_png
    from facepipe.processors.photo_fit import write_landmarks

    names = [one.animation for one in report.photos.values()]
    for name, one, photo, marks in zip(names, sheet.photos, photos, landmarks, strict=True):
        save_png(render_image(one), folder / f"{name}.render.png")
        save_png(overlay_image(one, sheet), folder / f"{name}.overlay.png")
        write_landmarks(folder / f"{name}.landmarks.json", marks, photo)
    save_png(photo_sheet(sheet), folder / _SHEET)
    write_bytes(folder / REPORT, f"{report.to_json()}\n".encode())


def render_image(one: SheetPhoto) -> Image:
    """The face as the camera of the photo sees it, sRGB, transparent around it."""
    import numpy as np
    from PIL import Image

    from facepipe.pictures.textures import linear_to_srgb

    cover = np.clip(one.render[..., 3:], 0, 1)
    color = linear_to_srgb(np.clip(one.render[..., :3] / np.maximum(cover, 1e-6), 0, 1))
    return Image.fromarray((np.concatenate([color * (cover > 0), cover], axis=2) * 255 + 0.5).astype(np.uint8))


def overlay_image(one: SheetPhoto, sheet: PhotoSheet) -> Image:
    """The photo, darker, with the edges of the fitted face, its landmarks, and those that it was given as rings."""
    import numpy as np

    from facepipe.pictures import photo_pictures as pictures

    height, width = one.photo.shape[:2]
    crop = pictures.whole(width, height, _OVERLAY)
    image = pictures.wireframe_picture(one.photo, crop, sheet.parts, one.screen)
    given, fitted = crop.place(one.targets), crop.place(one.landmarks)
    radius = max(_LEAST, _MARK * float(np.ptp(given, axis=0).max()))
    pictures.given_mark(image, given, radius)
    pictures.fitted_mark(image, fitted, radius)
    (left, top), (right, bottom) = np.rint(crop.place(np.array([(0.0, 0.0), (width, height)]))).astype(int).tolist()
    return image.crop((left, top, max(right, left + 1), max(bottom, top + 1)))
