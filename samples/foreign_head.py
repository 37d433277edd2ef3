"""A head that is not facepipe's own any more, to try `facepipe transfer` and `facepipe conform` on.

usage: python samples/foreign_head.py OUT.glb [SEED]

A person of `facepipe sample` (default 5) remeshed, turned, without shapes and joints, and OUT.landmarks.json beside it.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import facepipe
from facepipe.parts import FaceParts, Mesh, UvSet

TO_METRES = 0.01 * Rotation.from_euler("yx", (35.0, -8.0), degrees=True).as_matrix().T


def remeshed(mesh: Mesh) -> Mesh:
    """Another mesh of the same surface, the dual: a point in each of its quads, a face round each of its points."""
    quads = mesh.face_vertex_indices.reshape(-1, 4)
    at, before, after = (np.roll(quads, by, axis=1).ravel().tolist() for by in (0, 1, -1))
    left = {pair: number for number, pair in enumerate(zip(at, after, strict=True))}
    rings: list[list[int]] = []
    for first in {point: corner for corner, point in enumerate(at)}.values():
        ring, corner = [], first
        while corner >= 0 and corner not in ring:
            ring.append(corner)
            corner = left.get((at[corner], before[corner]), -1)
        rings += [ring] if corner == first and len(ring) > 2 else []
    used, corners = np.unique(np.concatenate(rings) // 4, return_inverse=True)
    points, colors = (values[quads].mean(axis=1)[used] for values in (mesh.points, mesh.colors))
    faces = {"face_vertex_counts": np.array([len(ring) for ring in rings]), "face_vertex_indices": corners}
    return Mesh(name=mesh.name, points=points, colors=colors, uv_sets=(UvSet(values=points[:, :2] / 50.0),), **faces)


def main(words: list[str]) -> int:
    """The exit code."""
    if not 1 <= len(words) <= 2:
        print(__doc__, file=sys.stderr)
        return 2
    out, person = Path(words[0]), facepipe.sample(seed=int(words[1]) if len(words) > 1 else 5, textures=0).parts()
    skin, *inside = person.meshes
    bare = (replace(mesh, skin=None, blendshapes=(), regions={}, landmarks={}) for mesh in inside)
    meshes = tuple(replace(mesh, points=mesh.points @ TO_METRES) for mesh in (remeshed(skin), *bare))
    head = FaceParts(name=out.stem, meshes=meshes, materials=person.materials, meters_per_unit=1.0)
    facepipe.export(facepipe.Face.from_parts(head), out, overwrite=True)
    marks = skin.points[skin.landmarks["multipie68"].indices] @ TO_METRES
    out.with_suffix(".landmarks.json").write_text(json.dumps({"scheme": "multipie68", "points": marks.tolist()}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
