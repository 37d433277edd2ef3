"""A registered face beside its scan, seen from three sides, and the distances between the two."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from facepipe.core.arrays import FloatArray
from facepipe.parts import FaceParts
from facepipe.pictures.camera import Frame, View, portrait
from facepipe.pictures.color_scale import color_scale
from facepipe.pictures.face_picture import PictureOptions, pictures
from facepipe.pictures.fit_sheet import opaque, scan_parts
from facepipe.pictures.heatmap import HeatMap
from facepipe.pictures.portrait import PORTRAIT
from facepipe.pictures.typesetting import MUTED, SMALL, below, beside, block, heading, write
from facepipe.scans import Scan

if TYPE_CHECKING:
    from PIL.Image import Image


# The face's left shows from the right of the sheet: a face that turns its head from left to right.
_VIEWS: tuple[View, ...] = ((-0.66, 0.05), (0.0, 0.0), (0.66, 0.05))
_GAP, _BORDER = 10, 28  # pixels
_SAMPLES = 2
# The key stands nearer to the camera than in a portrait: its shadow marks holes, but does not hide a cheek.
_STUDIO = replace(PORTRAIT, boxes=(replace(PORTRAIT.boxes[0], direction=(-0.42, 0.45, 0.95)), *PORTRAIT.boxes[1:]))


@dataclass(frozen=True, kw_only=True)
class Turntable:
    """A face and its scan in one place: millimetres, Y up."""

    title: str
    source: str = ""  # of the scan
    notes: tuple[str, ...] = ()  # below the title, a line each
    parts: FaceParts  # meshes at the registered points
    scan: Scan
    distances: FloatArray  # (n,) mm of all points from the scan, NaN where it doesn't show them
    largest_mm: float  # of the heat map
    framing: FloatArray  # (k, 3) points that all pictures have inside
    size: int = 420  # pixels a picture


def turntable(shown: Turntable) -> Image:
    """Rows of scan, registered face and distances, each from the left, the front and the right; the face without
    its clear parts, which no scan shows.

    :raises InputError: points or distances that don't fit, or a size out of range
    """
    face, distances = opaque(shown.parts, shown.distances)
    heat = HeatMap(values=distances, range=(0.0, shown.largest_mm))
    rows: list[tuple[str, FaceParts, HeatMap | None]] = [
        ("scan", scan_parts(shown.scan), None),
        ("registered", face, None),
        ("distance from the scan", face, heat),
    ]
    width = len(_VIEWS) * (shown.size + _GAP) - _GAP
    parts = [heading(width, shown.title, shown.source), _notes(width, shown.notes)]
    for name, drawn, colors in rows:
        parts += [_label(width, name), beside(_views(shown, drawn, colors), _GAP)]
    text = "distance of the registered face from the scan"
    parts.append(color_scale(width, heat.limits, text, "no place on the scan"))
    return _framed(below(parts, _GAP))


def _views(shown: Turntable, face: FaceParts, heat: HeatMap | None) -> list[Image]:
    several = [
        PictureOptions(
            size=shown.size,
            camera=portrait(shown.framing, view, Frame(width=shown.size, height=shown.size)),
            samples=_SAMPLES,
            heatmap=heat,
            bar=False,
            studio=_STUDIO if heat is None else None,
        )
        for view in _VIEWS
    ]
    return pictures(face, None, several)


def _notes(width: int, notes: tuple[str, ...]) -> Image:
    image = block(width, SMALL * 1.5 * len(notes))
    for number, note in enumerate(notes):
        write(image, (0, SMALL * (1.5 * number + 1.0)), note, size=SMALL, room=width)
    return image


def _label(width: int, text: str) -> Image:
    image = block(width, SMALL * 1.2)
    write(image, (0, SMALL), text, size=SMALL, color=MUTED)
    return image


def _framed(page: Image) -> Image:
    sheet = block(page.width + 2 * _BORDER, page.height + 2 * _BORDER)
    sheet.paste(page, (_BORDER, _BORDER))
    return sheet
