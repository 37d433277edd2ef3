"""Pieces of one large polygon mesh as meshes of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.parts import Blendshape, MaterialFaces, UvSet


def face_corners(face_vertex_counts: IntArray, faces: IntArray) -> IntArray:
    """Corner numbers of `faces`, face after face."""
    counts = np.asarray(face_vertex_counts, dtype=np.int64)
    starts = np.cumsum(counts) - counts
    picked = counts[faces]
    within = np.arange(int(picked.sum())) - np.repeat(np.cumsum(picked) - picked, picked)
    return np.asarray(np.repeat(starts[faces], picked) + within)


def compact_uvs(values: FloatArray, indices: IntArray) -> UvSet:
    """A face-varying UV set that holds only the values in use, in their order."""
    used, compact = np.unique(indices, return_inverse=True)
    return UvSet(values=np.asarray(values)[used], indices=compact.reshape(-1).astype(np.int32))


def sparse_shapes(
    shapes: Mapping[str, FloatArray], points: IntArray | slice, threshold: float
) -> tuple[Blendshape, ...]:
    """Shapes, name -> offsets (n, 3), of some `points`: those that they move further than `threshold`, if any."""
    sparse = []
    for name, whole in shapes.items():
        offsets = np.asarray(whole[points])
        moved = np.flatnonzero(np.linalg.norm(offsets.astype(np.float64), axis=1) > threshold)
        if len(moved):
            sparse.append(Blendshape(name=name, point_indices=moved.astype(np.int32), offsets=offsets[moved]))
    return tuple(sparse)


def material_faces(names: Sequence[str], face_material: IntArray) -> tuple[MaterialFaces, ...]:
    """Faces by material; `face_material` (f,) indexes `names`, -1 for faces without."""
    used = np.unique(face_material[face_material >= 0])
    return tuple(
        MaterialFaces(material=names[number], faces=np.flatnonzero(face_material == number).astype(np.int32))
        for number in used
    )


def whole_region(names: Sequence[str], region: str, count: int) -> dict[str, FloatArray]:
    """Masks (count,) of all regions `names` for a loose mesh that belongs to `region` alone."""
    return {name: np.full(count, float(name == region)) for name in names}
