"""Pictures of what a head got: each shape at weight 1, from the front and from between front and side."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.similarity import Similarity
from facepipe.parts import FaceParts
from facepipe.pictures.camera import View, portrait
from facepipe.pictures.face_picture import PictureOptions, poses
from facepipe.pictures.overlay import contact_sheet
from facepipe.verbs.whole_faces import whole_face, whole_parts

if TYPE_CHECKING:
    from PIL.Image import Image

_VIEWS: tuple[View, ...] = ("front", (0.66, 0.05))
_SIZE, _COLUMNS, _SAMPLES = 220, 5, 2
_MARGIN = np.array([0.15, 0.3, 0.15])  # of the landmarks' size, to either side; above there are brows alone


def shape_sheet(
    parts: FaceParts, shapes: Iterable[str], place: Similarity, framing: FloatArray, size: int = _SIZE
) -> Image:
    """A cell for the neutral and each of `shapes` that the face has, in their order.

    :param place: from whole points to where the face stands upright, looks along +Z and is in millimetres
    :param framing: (k, 3) places of the face there, that all pictures have inside with some room
    """
    from PIL import Image as Images

    whole = whole_face(parts, parts.name)
    low, high = framing.min(axis=0), framing.max(axis=0)
    room = (high - low) * _MARGIN
    corners = np.stack(np.meshgrid(*np.stack([low - room, high + room], axis=1)), axis=-1).reshape(-1, 3)
    moved = {"neutral": whole.points}
    moved |= {name: whole.points + whole.deltas[name] for name in shapes if name in whole.deltas}
    faces = {caption: place.apply(points) for caption, points in moved.items()}
    placed = whole_parts(parts, faces["neutral"])
    views = []
    for view in _VIEWS:
        options = PictureOptions(size=size, camera=portrait(corners, view, size, size), samples=_SAMPLES)
        views.append(poses(placed, list(faces.values()), options))
    cells = []
    for caption, pair in zip(faces, zip(*views, strict=True), strict=True):
        cell = Images.new("RGB", (size * len(pair), size))
        for number, image in enumerate(pair):
            cell.paste(image.convert("RGB"), (size * number, 0))
        cells.append((caption, cell))
    return contact_sheet(cells, columns=_COLUMNS)
