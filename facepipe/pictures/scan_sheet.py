"""Landmarks on a scan, seen from several sides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.coarse_surface import Look
from facepipe.geometry.pinhole import Pinhole
from facepipe.pictures.landmarks import DOT
from facepipe.pictures.overlay import INK, font
from facepipe.pictures.surface_view import draw_surface

if TYPE_CHECKING:
    from PIL.Image import Image


_FINE = 2  # pixels drawn for one of the sheet, so that dots have smooth edges
_HIDDEN = (240, 170, 170)
_SLACK = 0.02  # of the depth: a landmark this far behind the surface still shows


def scan_sheet(look: Look, views: Sequence[Pinhole], landmarks: FloatArray) -> Image:
    """Pictures side by side, of the views' size, with numbered dots; those behind the surface are pale.

    :param landmarks: (l, 3), rows of NaN are left out
    """
    from PIL import Image

    pictures = [np.asarray(_picture(look, view, landmarks)) for view in views]
    return Image.fromarray(np.hstack(pictures))


def _picture(look: Look, view: Pinhole, landmarks: FloatArray) -> Image:
    from PIL import Image, ImageDraw

    fine = Pinhole(axes=view.axes, eye=view.eye, focal=view.focal * _FINE, size=view.size * _FINE)
    pixels, depth = draw_surface(look, fine)
    image = Image.fromarray((pixels * 255 + 0.5).astype(np.uint8))
    pen, letters, radius = ImageDraw.Draw(image), font(fine.size / 60), fine.size / 220
    for number, (place, far) in enumerate(zip(*fine.project(landmarks), strict=True)):
        if not np.isfinite(place).all() or not ((place >= 0) & (place < fine.size)).all():
            continue
        x, y = place.tolist()
        hidden = far > depth[int(y), int(x)] * (1 + _SLACK)
        box = (x - radius, y - radius, x + radius, y + radius)
        pen.ellipse(box, fill=_HIDDEN if hidden else DOT, outline=(255, 255, 255), width=_FINE)
        if not hidden:
            pen.text((x + 1.5 * radius, y), str(number), fill=INK, font=letters, anchor="lm")
    return image.reduce(_FINE)
