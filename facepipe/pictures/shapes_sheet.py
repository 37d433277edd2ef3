"""Shapes of a face, coloured by how far they are from others of the same names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.parts import FaceParts
from facepipe.pictures.camera import Frame, portrait
from facepipe.pictures.color_scale import color_scale
from facepipe.pictures.face_picture import PictureOptions, picture
from facepipe.pictures.fit_sheet import round_above
from facepipe.pictures.heatmap import HeatMap
from facepipe.pictures.typesetting import MUTED, SMALL, below, beside, block, heading, write

if TYPE_CHECKING:
    from PIL.Image import Image


MOST = 12  # shapes that are drawn
_COLUMNS, _SAMPLES, _GAP, _BORDER = 4, 2, 10, 28


@dataclass(frozen=True, kw_only=True)
class ChangedShapes:
    """A face's shapes and what they were: points in millimetres, Y up."""

    title: str
    parts: FaceParts  # meshes at the neutral
    neutral: FloatArray  # (n, 3)
    shapes: Mapping[str, FloatArray]  # name -> (n, 3) delta
    before: Mapping[str, FloatArray]  # the same shapes, as they were
    counted: npt.NDArray[np.integer]  # points by which shapes are told as changed much or little: those that show
    framing: FloatArray  # (k, 3) points that all pictures have inside
    size: int = 300  # pixels a picture


def most_changed(given: ChangedShapes, most: int = MOST) -> list[str]:
    """The names of at most `most` shapes that have changed, from the largest distance down."""
    far = {name: float(_distances(given, name)[given.counted].max(initial=0.0)) for name in given.shapes}
    return sorted((name for name in far if far[name] > 0.0), key=lambda name: -far[name])[:most]


def shapes_sheet(given: ChangedShapes, names: Sequence[str]) -> Image:
    """Each shape at weight 1, painted with its distance from what it was; one scale for all.

    :raises InputError: no names
    """
    if not names:
        raise InputError(given.title, "no shapes to draw, expected one or more")
    limits = 0.0, _largest(given, names)
    cells = [_cell(given, name, limits) for name in names]
    rows = [beside(cells[start : start + _COLUMNS], _GAP) for start in range(0, len(cells), _COLUMNS)]
    width = _COLUMNS * (given.size + _GAP) - _GAP
    text = "distance of the shape at weight 1 from the personal template's; the last colour stands for more, too"
    scale = color_scale(width, limits, text)
    page = below([heading(width, given.title), *rows, scale], _GAP)
    framed = block(width + 2 * _BORDER, page.height + 2 * _BORDER)
    framed.paste(page, (_BORDER, _BORDER))
    return framed


def _largest(given: ChangedShapes, names: Sequence[str]) -> float:
    """A round number of millimetres that nearly all distances are below; what is beyond has the last colour."""
    together = np.concatenate([_distances(given, name)[given.counted] for name in names])
    return round_above(together[together > 0.0])


def _cell(given: ChangedShapes, name: str, limits: tuple[float, float]) -> Image:
    distances = _distances(given, name)
    options = PictureOptions(
        size=given.size,
        camera=portrait(given.framing, "front", Frame(width=given.size, height=given.size)),
        samples=_SAMPLES,
        heatmap=HeatMap(values=distances, range=limits),
        bar=False,
    )
    caption = block(given.size, SMALL * 1.7)
    write(caption, (0, SMALL * 1.0), name, size=SMALL, room=given.size * 0.7)
    largest = f"to {distances[given.counted].max():.1f} mm"
    write(caption, (given.size, SMALL * 1.0), largest, size=SMALL, color=MUTED, anchor="rs", room=given.size * 0.3)
    return below([picture(given.parts, given.neutral + given.shapes[name], options), caption], 2)


def _distances(given: ChangedShapes, name: str) -> FloatArray:
    """(n,) millimetres."""
    return np.asarray(np.linalg.norm(given.shapes[name] - given.before[name], axis=1))
