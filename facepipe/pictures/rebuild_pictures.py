"""Pictures of a rebuild: registered faces beside their scans, and shapes by how far they have changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.parts import FaceParts
from facepipe.pictures.camera import Frame, View, portrait
from facepipe.pictures.face_picture import PictureOptions, picture, pictures
from facepipe.pictures.fit_sheet import opaque, round_above, scan_parts
from facepipe.pictures.heatmap import HeatMap
from facepipe.pictures.overlay import PAPER
from facepipe.pictures.portrait import PORTRAIT
from facepipe.scans import Scan

if TYPE_CHECKING:
    from PIL.Image import Image

MOST = 12  # changed shapes that are drawn
# The face's left shows from the right of the picture: a face that turns its head from left to right.
_VIEWS: tuple[View, ...] = ((-0.66, 0.05), (0.0, 0.0), (0.66, 0.05))
_GAP = 10  # pixels
_SAMPLES = 2
# The key stands nearer to the camera than in a portrait: its shadow marks holes, but does not hide a cheek.
_STUDIO = replace(PORTRAIT, boxes=(replace(PORTRAIT.boxes[0], direction=(-0.42, 0.45, 0.95)), *PORTRAIT.boxes[1:]))


@dataclass(frozen=True, kw_only=True)
class Turntable:
    """A face and its scan in one place: millimetres, Y up."""

    parts: FaceParts  # meshes at the registered points
    scan: Scan
    distances: FloatArray  # (n,) mm of all points from the scan, NaN where it doesn't show them
    largest_mm: float  # of the heat map
    framing: FloatArray  # (k, 3) points that all pictures have inside
    size: int = 420  # pixels a picture


def turntable(shown: Turntable) -> dict[str, Image]:
    """Scan, registered face and distances, each from the left, the front and the right; the face without its clear
    parts, which no scan shows.

    :raises InputError: points or distances that don't fit, or a size out of range
    """
    face, distances = opaque(shown.parts, shown.distances)
    heat = HeatMap(values=distances, range=(0.0, shown.largest_mm))
    return {
        "scan": _views(shown, scan_parts(shown.scan), None),
        "registered face": _views(shown, face, None),
        "distance from the scan": _views(shown, face, heat),
    }


def stacked(images: Sequence[Image]) -> Image:
    """Pictures of one width on top of each other."""
    return _pasted(images, 0, 1)


def _views(shown: Turntable, face: FaceParts, heat: HeatMap | None) -> Image:
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
    return _pasted(pictures(face, None, several), 1, 0)


def _pasted(images: Sequence[Image], right: int, down: int) -> Image:
    from PIL import Image as Images

    width, height = images[0].size
    across, along = (width + _GAP) * right, (height + _GAP) * down
    last = len(images) - 1
    sheet = Images.new("RGB", (width + across * last, height + along * last), PAPER)
    for number, image in enumerate(images):
        sheet.paste(image, (across * number, along * number))
    return sheet


@dataclass(frozen=True, kw_only=True)
class ChangedShapes:
    """A face's shapes and what they were: points in millimetres, Y up."""

    parts: FaceParts  # meshes at the neutral
    neutral: FloatArray  # (n, 3)
    shapes: Mapping[str, FloatArray]  # name -> (n, 3) delta
    before: Mapping[str, FloatArray]  # the same shapes, as they were
    counted: npt.NDArray[np.integer]  # points that show, by which shapes count as changed
    framing: FloatArray  # (k, 3) points that all pictures have inside
    size: int = 300  # pixels a picture


def most_changed(given: ChangedShapes, most: int = MOST) -> list[str]:
    """The names of at most `most` shapes that have changed, from the largest distance down."""
    far = {name: change_mm(given, name) for name in given.shapes}
    return sorted((name for name in far if far[name] > 0.0), key=lambda name: -far[name])[:most]


def changed_pictures(given: ChangedShapes, names: Sequence[str]) -> tuple[list[Image], tuple[float, float]]:
    """Each shape at weight 1, painted with its distance from what it was; and the millimetres of the colours' ends.

    The scale is one for all: from 0 to a round number that nearly all distances are below.
    """
    distances = {name: _distances(given, name) for name in names}
    known = np.concatenate([distances[name][given.counted] for name in names])
    limits = 0.0, round_above(known[known > 0.0])
    options = PictureOptions(
        size=given.size,
        camera=portrait(given.framing, "front", Frame(width=given.size, height=given.size)),
        samples=_SAMPLES,
        bar=False,
    )
    images = [
        picture(
            given.parts,
            given.neutral + given.shapes[name],
            replace(options, heatmap=HeatMap(values=distances[name], range=limits)),
        )
        for name in names
    ]
    return images, limits


def change_mm(given: ChangedShapes, name: str) -> float:
    """How far the shape is from what it was where that is furthest, of the points that count."""
    return float(_distances(given, name)[given.counted].max(initial=0.0))


def _distances(given: ChangedShapes, name: str) -> FloatArray:
    """(n,) millimetres."""
    return np.asarray(np.linalg.norm(given.shapes[name] - given.before[name], axis=1))
