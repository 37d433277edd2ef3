"""The report sheet of a fit to photos: one page that shows what was found, and how well it shows what the photos do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray, require_finite
from facepipe.core.errors import InputError
from facepipe.parts import FaceParts
from facepipe.pictures import photo_pictures as pictures
from facepipe.pictures.camera import View
from facepipe.pictures.curves import TOTAL, loss_curves
from facepipe.pictures.face_picture import PictureOptions, picture
from facepipe.pictures.rasterise import NEAR
from facepipe.pictures.slider_table import shape_table, slider_table
from facepipe.pictures.typesetting import BODY, MUTED, SMALL, TITLE, below, beside, block, write

if TYPE_CHECKING:
    from PIL.Image import Image


WIDTH, BORDER, GAP = 2400, 84, 36  # pixels
INNER = WIDTH - 2 * BORDER
COLUMN = (INNER - 84) // 2  # of the tables
CAPTION = 54
FRAMED = 0.85  # a crop smaller than this share of the photo is framed in it


@dataclass(frozen=True, kw_only=True)
class SheetPhoto:
    """One photo, and what the fit makes of it. Pixels count from the photo's top left corner, y down."""

    name: str
    photo: FloatArray  # (h, w, 3) sRGB 0..1
    render: FloatArray  # (rh, rw, 4) linear colour on black and coverage 0..1, of all that the photo shows, any size
    screen: FloatArray  # (n, 3) pixel x, y and depth of the posed points of all meshes, in mesh order
    targets: FloatArray  # (l, 2) landmarks that the fit was given, pixels
    landmarks: FloatArray  # (l, 2) landmarks of the fitted face, pixels
    landmark_error: float  # mean, pixels
    eye_distance: float  # pixels between the outer eye corners, what the error is a percentage of
    expressions: Mapping[str, float]  # shape -> weight, of the shapes that were free


@dataclass(frozen=True, kw_only=True)
class PhotoSheet:
    """All that a report sheet shows."""

    parts: FaceParts
    neutral: FloatArray  # (n, 3) world points of the person without expression
    photos: tuple[SheetPhoto, ...]
    sliders: Mapping[str, float]  # name -> value, of the sliders that were free
    history: Sequence[Mapping[str, float]]  # by step: "total" and each weighted term; NaN: not known
    kept: int = 0  # step that the face is of
    stages: tuple[tuple[int, str], ...] = ()  # step at which a part of the fit begins, its name
    seconds: float | None = None
    note: str = ""  # how the fit ended
    title: str = "Photo fit"


def photo_sheet(sheet: PhotoSheet) -> Image:
    """One page, 2400 pixels wide: pictures of every photo, the neutral, sliders, expressions and losses.

    :raises InputError: no photo, arrays that don't fit each other, sliders that the face does not have, or values that
        are not finite (but for losses)
    :raises TopologyError: a mesh refers to points or materials that it does not have
    """
    _check(sheet)
    page = below([_head(sheet), *_pictures(sheet), _tables(sheet)], GAP)
    framed = block(WIDTH, page.height + 2 * BORDER)
    framed.paste(page, (BORDER, BORDER))
    return framed


def _head(sheet: PhotoSheet) -> Image:
    image = block(INNER, TITLE * 1.1 + BODY * 2.2)
    write(image, (0, TITLE * 0.86), f"{sheet.title}: {sheet.parts.name}", size=TITLE, room=INNER)
    write(image, (0, TITLE * 1.1 + BODY * 1.3), "  ·  ".join(facts(sheet)), color=MUTED, room=INNER)
    return image


def facts(sheet: PhotoSheet) -> list[str]:
    """What one wants to know first."""
    told = [_count(len(sheet.photos), "photo"), _count(max(len(sheet.history) - 1, 0), "step")]
    kept = [one.get(TOTAL, np.nan) for one in sheet.history[sheet.kept : sheet.kept + 1]]
    if np.isfinite(kept).any():
        told.append(f"loss {kept[0]:.3g} at step {sheet.kept}")
    if sheet.seconds is not None:
        told.append(f"{sheet.seconds:.1f} s")
    errors = [photo.landmark_error for photo in sheet.photos]
    shares = [photo.landmark_error / photo.eye_distance for photo in sheet.photos]
    told.append(
        f"landmark error {np.mean(errors):.2f} px, {np.mean(shares):.1%} of the distance of the outer eye corners"
    )
    return told + ([sheet.note] if sheet.note else [])


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _pictures(sheet: PhotoSheet) -> list[Image]:
    """One photo: two rows of three with the neutral. Several: a row of five for each."""
    if len(sheet.photos) == 1:
        size = (INNER - 2 * GAP) // 3
        cells = [*_of_photo(sheet, sheet.photos[0], size), _neutral(sheet, size)]
        return [beside(cells[:3], GAP), beside(cells[3:], GAP)]
    size = (INNER - 4 * GAP) // 5
    return [beside(_of_photo(sheet, photo, size), GAP) for photo in sheet.photos]


def _of_photo(sheet: PhotoSheet, one: SheetPhoto, size: int) -> list[Image]:
    """The five pictures of a photo, with captions."""
    height, width = one.photo.shape[:2]
    whole = pictures.whole(width, height, size)
    marks = np.concatenate([one.targets, one.landmarks])
    near = pictures.portrait(marks, one.screen[one.screen[:, 2] > NEAR, :2], width, height, size)
    close = pictures.close_up(marks, width, height, size)
    photo = pictures.photo_picture(one.photo, whole)
    if near.side < FRAMED * max(width, height):
        photo = pictures.framed(photo, whole, near)
    return [
        _cell(photo, one.name, f"{width} x {height}"),
        _landmark_cell(one, close),
        _cell(pictures.wireframe_picture(one.photo, near, sheet.parts, one.screen), "fitted mesh"),
        _cell(pictures.render_picture(one.render, one.photo, near, on_photo=False), "render, same camera"),
        _cell(pictures.render_picture(one.render, one.photo, near, on_photo=True), "render on the photo"),
    ]


def _landmark_cell(one: SheetPhoto, crop: pictures.Crop) -> Image:
    """Landmarks, with the legend of their marks and their mean error below."""
    shown = pictures.landmark_picture(one.photo, crop, one.targets, one.landmarks)
    cell = _cell(shown, "", f"{one.landmark_error:.2f} px, {one.landmark_error / one.eye_distance:.1%}")
    line, left = crop.size + CAPTION * 0.7, 0.0
    for mark, name in ((pictures.given_mark, "given"), (pictures.fitted_mark, "fitted")):
        mark(cell, np.array([(left + BODY * 0.62, line - BODY * 0.3)]), BODY * 0.2)
        left += BODY * 1.5
        left += write(cell, (left, line), name) + BODY * 0.8
    return cell


def _cell(image: Image, caption: str, note: str = "") -> Image:
    """A picture with a caption at the left below it, and a note at the right."""
    cell = block(image.width, image.height + CAPTION)
    cell.paste(image, (0, 0))
    line = image.height + CAPTION * 0.7
    taken = write(cell, (image.width, line), note, size=SMALL, color=MUTED, anchor="rs") if note else 0.0
    write(cell, (0, line), caption, room=image.width - taken - BODY)
    return cell


def _neutral(sheet: PhotoSheet, size: int, view: View = "front", caption: str = "without expression") -> Image:
    ground = (pictures.GROUND[0] / 255, pictures.GROUND[1] / 255, pictures.GROUND[2] / 255)
    options = PictureOptions(size=size, view=view, background=ground, samples=2)
    return _cell(picture(sheet.parts, sheet.neutral, options), caption)


def _tables(sheet: PhotoSheet) -> Image:
    """Two columns of about the same height: sliders at the left, the other blocks where the page becomes shortest."""
    blocks = [
        shape_table([photo.expressions for photo in sheet.photos], [photo.name for photo in sheet.photos], COLUMN),
        loss_curves(sheet.history, COLUMN, sheet.stages),
    ]
    if len(sheet.photos) > 1:
        size = (COLUMN - GAP) // 2
        blocks.insert(0, beside([_neutral(sheet, size), _neutral(sheet, size, "three-quarter", "")], GAP))
    first = slider_table(sheet.parts.sliders, sheet.sliders, COLUMN)
    choices = []
    for sides in product((True, False), repeat=len(blocks)):
        right = [each for each, side in zip(blocks, sides, strict=True) if side]
        left = [first, *(each for each, side in zip(blocks, sides, strict=True) if not side)]
        choices.append([below(column or [block(COLUMN, 1)], GAP) for column in (left, right)])
    return beside(min(choices, key=lambda columns: max(each.height for each in columns)), INNER - 2 * COLUMN)


def _check(sheet: PhotoSheet) -> None:
    """:raises InputError: what `photo_sheet` says"""
    if not sheet.photos:
        raise InputError("photo sheet", "no photos, expected one or more")
    unknown = sorted(set(sheet.sliders) - {slider.name for slider in sheet.parts.sliders})
    if unknown:
        raise InputError(f"{sheet.parts.name} -> sliders", f"no slider {unknown[0]!r}")
    require_finite(dict(sheet.sliders), "sliders")
    count = sum(len(mesh.points) for mesh in sheet.parts.meshes)
    for one in sheet.photos:
        require_finite(one, one.name)
        if one.photo.ndim != 3 or one.photo.shape[2] != 3 or not one.photo.size:
            raise InputError(f"{one.name} -> photo", f"shape {one.photo.shape}, expected (height, width, 3)")
        if one.photo.min() < 0 or one.photo.max() > 1:
            raise InputError(f"{one.name} -> photo", f"values up to {one.photo.max():g}, expected sRGB in 0..1")
        if one.render.ndim != 3 or one.render.shape[2] != 4 or not one.render.size:
            raise InputError(f"{one.name} -> render", f"shape {one.render.shape}, expected (height, width, 4)")
        if one.screen.shape != (count, 3):
            raise InputError(f"{one.name} -> screen", f"shape {one.screen.shape}, expected ({count}, 3)")
        if one.targets.shape != one.landmarks.shape or one.targets.shape[1:] != (2,) or not len(one.targets):
            shapes = f"{one.targets.shape} given and {one.landmarks.shape} fitted"
            raise InputError(f"{one.name} -> landmarks", f"{shapes}, expected (l, 2) of both")
        if one.eye_distance <= 0:
            raise InputError(f"{one.name} -> eye distance", f"{one.eye_distance} pixels, expected more than 0")
