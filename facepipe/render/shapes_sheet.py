"""Shapes of a face, coloured by how far they are from others of the same names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.parts import FaceParts
from facepipe.render.camera import Frame, View, portrait
from facepipe.render.color_scale import color_scale
from facepipe.render.fit_sheet import round_above
from facepipe.render.heatmap import HeatMap
from facepipe.render.picture import PictureOptions, picture
from facepipe.render.sheet import contact_sheet
from facepipe.render.typesetting import below, block, heading

if TYPE_CHECKING:
    from PIL.Image import Image

FloatArray = npt.NDArray[np.floating]

MOST = 12  # shapes that are drawn
_COLUMNS, _SAMPLES, _BORDER = 4, 2, 28
_VIEW: View = (0.35, 0.05)  # what moves forward shows too


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
    distances = {name: _distances(given, name) for name in names}
    together = np.concatenate([each[given.counted] for each in distances.values()])
    limits = (0.0, round_above(together[together > 0.0]))
    camera = portrait(given.framing, _VIEW, Frame(width=given.size, height=given.size))
    images = []
    for name in names:
        heat = HeatMap(values=distances[name], range=limits)
        options = PictureOptions(size=given.size, camera=camera, samples=_SAMPLES, heatmap=heat, bar=False)
        largest = float(distances[name][given.counted].max())
        images.append(
            (f"{name}, up to {largest:.1f} mm", picture(given.parts, given.neutral + given.shapes[name], options))
        )
    sheet = contact_sheet(images, _COLUMNS)
    width = max(sheet.width, _COLUMNS * given.size)
    scale = color_scale(width, limits, "distance of the shape at weight 1 from the personal template's")
    page = below([heading(width, given.title), sheet, scale], 8)
    framed = block(page.width + 2 * _BORDER, page.height + 2 * _BORDER)
    framed.paste(page, (_BORDER, _BORDER))
    return framed


def _distances(given: ChangedShapes, name: str) -> FloatArray:
    """(n,) millimetres."""
    return np.asarray(np.linalg.norm(given.shapes[name] - given.before[name], axis=1))
