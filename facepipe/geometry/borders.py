"""Open borders of polygon meshes."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import edges


def back_of_border(points: FloatArray, face_vertex_counts: IntArray, face_vertex_indices: IntArray) -> int | None:
    """The point at the back of the open border, nearest to the middle in x; None for a closed mesh.

    Y is up and the face looks along +Z. On a head this is the nape end of the neck border: the anchor.
    """
    pairs, faces = edges(face_vertex_counts, face_vertex_indices)
    border = np.unique(pairs[faces == 1])
    if len(border) == 0:
        return None
    behind = border[points[border, 2] <= np.median(points[border, 2])]
    return int(behind[np.argmin(np.abs(points[behind, 0]))])
