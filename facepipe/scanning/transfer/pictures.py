"""Pictures of what a head got: each shape at weight 1, from the front and from between front and side."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.geometry.similarity import Similarity
from facepipe.parts import FaceParts
from facepipe.pictures.camera import View, portrait
from facepipe.pictures.face_picture import PictureOptions, poses
from facepipe.pictures.overlay import contact_sheet
from facepipe.verbs.whole_faces import whole_face, whole_parts

if TYPE_CHECKING:
    from PIL.Image import Image

_VIEWS: tuple[View, ...] = ("front", (0.66, 0.05))
_TOGETHER = {"mouthClose": ("jawOpen", "mouthClose")}  # alone it presses a closed mouth together
_SIZE, _COLUMNS, _SAMPLES = 220, 5, 2
_MARGIN = np.array([0.15, 0.3, 0.15])  # of the landmarks' size, to either side; above there are brows alone


def shape_sheet(
    parts: FaceParts, shapes: Iterable[str], shown: BoolArray, place: Similarity, framing: FloatArray, size: int = _SIZE
) -> Image:
    """A cell for the neutral and each of `shapes` that the face has, in their order.

    :param shown: (n,) whole points to draw: hair and hats may hide the face
    :param place: from whole points to where the face stands upright, looks along +Z and is in millimetres
    :param framing: (k, 3) places of the face there, that all pictures have inside with some room
    """
    from PIL import Image as Images

    whole = whole_face(parts, parts.name)
    low, high = framing.min(axis=0), framing.max(axis=0)
    room = (high - low) * _MARGIN
    corners = np.stack(np.meshgrid(*np.stack([low - room, high + room], axis=1)), axis=-1).reshape(-1, 3)
    moved = {"neutral": whole.points}
    for name in shapes:
        together = [one for one in _TOGETHER.get(name, (name,)) if one in whole.deltas]
        if name in together:
            moved[" + ".join(together)] = sum((whole.deltas[one] for one in together), whole.points)
    faces = {caption: place.apply(points) for caption, points in moved.items()}
    placed = shown_faces(whole_parts(parts, faces["neutral"]), shown)
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


def shown_faces(parts: FaceParts, shown: BoolArray) -> FaceParts:
    """The face without faces that have points which are not `shown` (n,)."""
    meshes = []
    cuts = np.cumsum([len(mesh.points) for mesh in parts.meshes])[:-1]
    for mesh, own in zip(parts.meshes, np.split(shown, cuts), strict=True):
        counts = np.asarray(mesh.face_vertex_counts)
        of_corner = np.repeat(np.arange(len(counts)), counts)
        kept = np.ones(len(counts), bool)
        np.logical_and.at(kept, of_corner, own[mesh.face_vertex_indices])
        corners, number = kept[of_corner], np.cumsum(kept) - 1
        meshes.append(
            replace(
                mesh,
                face_vertex_counts=counts[kept],
                face_vertex_indices=mesh.face_vertex_indices[corners],
                uv_sets=tuple(
                    uv if uv.indices is None else replace(uv, indices=uv.indices[corners]) for uv in mesh.uv_sets
                ),
                material_faces=tuple(
                    replace(one, faces=number[one.faces[kept[one.faces]]].astype(np.int32))
                    for one in mesh.material_faces
                ),
            )
        )
    return replace(parts, meshes=tuple(meshes))
