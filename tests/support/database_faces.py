"""Small made-up people for database tests: a head and teeth, with neutrals and expressions of a few modes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from faces import grid_mesh

from facepipe.parts import Blendshape, FaceParts
from facepipe.verbs.whole_faces import WholeFace, whole_face

SHAPES = ("jawOpen", "mouthSmileLeft", "browInnerUp")
_MODES = 9


def person(seed: int, *, shapes: Sequence[str] = SHAPES, units: float = 0.01) -> FaceParts:
    """A face of a few centimetres; points and shapes depend on the same nine numbers of the person."""
    rng, numbers = np.random.default_rng(7), np.random.default_rng([seed, 1]).standard_normal(_MODES)
    meshes = []
    for mesh, moved in ((grid_mesh(), 36), (grid_mesh("Teeth", 3, -0.5), 9)):
        count = len(mesh.points)
        modes = 0.1 * rng.standard_normal((_MODES, count, 3)) / np.arange(1, _MODES + 1)[:, None, None]
        points = (mesh.points + np.tensordot(numbers, modes, axes=1)) * 0.01 / units
        own = []
        for name in SHAPES:
            mean = rng.standard_normal((moved, 3))
            ways = 0.3 * rng.standard_normal((_MODES, moved, 3))
            offsets = (0.3 * mean + 0.1 * np.tensordot(numbers, ways, axes=1)) * 0.01 / units
            if name in shapes and not (mesh.name == "Teeth" and name != "jawOpen"):
                own.append(Blendshape(name=name, point_indices=np.arange(moved, dtype=np.int32), offsets=offsets))
        meshes.append(replace(mesh, points=points, blendshapes=tuple(own)))
    return FaceParts(name=f"P{seed}", meters_per_unit=units, meshes=tuple(meshes))


def source(seed: int, **settings: object) -> Callable[[], WholeFace]:
    """A person as databases take them."""
    return lambda: whole_face(person(seed, **settings), f"p{seed}")  # type: ignore[arg-type]


def sources(count: int, first: int = 0) -> list[Callable[[], WholeFace]]:
    """Several people."""
    return [source(seed) for seed in range(first, first + count)]
