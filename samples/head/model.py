"""ICT-FaceKit without what the head in the box leaves out: everything behind the eyeballs in its list of parts.

Points and faces keep the numbers that they have in ICT-FaceKit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.importers.ict import EXPRESSIONS, PARTS, face_materials, read_model, shape_name

LAST = "Eyeball right"  # of the parts that are kept; then come tear film, lashes and shadow meshes
KEPT = PARTS[: 1 + [part.title for part in PARTS].index(LAST)]
POINTS, FACES = KEPT[-1].points[1], KEPT[-1].faces[1]
JOINED = {"browInnerUp": ("browInnerUpLeft", "browInnerUpRight"), "cheekPuff": ("cheekPuffLeft", "cheekPuffRight")}

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class Model:
    """n points and f faces, in centimetres."""

    points: Floats  # (n, 3) neutral
    modes: npt.NDArray[np.float32]  # (100, n, 3) offsets of a standard deviation
    shapes: dict[str, Floats]  # name -> (n, 3), those of ARKit that ICT-FaceKit has, by their ARKit names
    counts: Ints  # (f,)
    indices: Ints  # (corners,)
    uvs: Floats  # (u, 2)
    uv_indices: Ints  # (corners,)
    materials: Ints  # (f,) into importers.ict_topology.MATERIALS


def read(data: Path) -> Model:
    """The model out of ``data/ict_facekit/ict_facekit.npz``."""
    source = data / "ict_facekit" / "ict_facekit.npz"
    model = read_model(source, {}, EXPRESSIONS)
    base = model.neutral
    counts = base.face_vertex_counts[:FACES]
    corners = int(counts.sum())
    uvs, uv_indices = np.unique(base.uv_indices[:corners], return_inverse=True)
    with np.load(source) as arrays:
        modes = arrays["identity_deltas"][:, :POINTS]
    return Model(
        points=base.points[:POINTS],
        modes=modes,
        shapes=_arkit({name: shape[:POINTS].astype(np.float64) for name, shape in model.shapes.items()}),
        counts=counts,
        indices=base.face_vertex_indices[:corners],
        uvs=base.uvs[uvs],
        uv_indices=uv_indices.reshape(-1).astype(np.int32),
        materials=face_materials(model)[:FACES].astype(np.int32),
    )


def _arkit(shapes: dict[str, Floats]) -> dict[str, Floats]:
    found: dict[str, Any] = {shape_name(name): offsets for name, offsets in shapes.items()}
    for name, halves in JOINED.items():
        found[name] = sum(found.pop(half) for half in halves)
    return {name: found[name] for name in sorted(found)}
