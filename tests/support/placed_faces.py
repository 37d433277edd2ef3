"""Faces whose meshes, skeletons and joints at rest are placed in every way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from faces import replace_mesh, tiny_face, with_meshes

from facepipe.parts import FaceParts


def similarity(seed: int, scale: float = 1.0) -> np.ndarray:
    """A random rotation and translation, with a scale."""
    rng = np.random.default_rng(seed)
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    q[:, 0] *= np.linalg.det(q)
    matrix = np.eye(4)
    matrix[:3, :3] = q * scale
    matrix[:3, 3] = rng.normal(size=3)
    return matrix


def placed_face() -> FaceParts:
    """Every transform there is, none of them the identity."""
    face = tiny_face()
    head, teeth = face.meshes
    assert head.skin is not None
    bound = replace(head.skin, geom_bind_transform=similarity(1, 0.7) @ np.diag([1.0, 1.3, 0.8, 1.0]))
    stretched = similarity(3) @ np.diag([2.0, 0.5, 1.0, 1.0])
    return replace(
        face,
        meters_per_unit=0.1,
        skeleton=replace(face.skeleton, transform=similarity(2, 2.5)),
        meshes=(
            replace_mesh(head, skin=bound),
            replace_mesh(teeth, transform=stretched),
        ),
    )


def rest_face(*factors: np.ndarray) -> FaceParts:
    """Joints at rest away from their bind pose; `factors` go to the right of each rest transform."""
    face = tiny_face()
    rest = face.skeleton.rest_transforms.copy()
    for joint, factor in enumerate(factors):
        rest[joint] = rest[joint] @ factor
    return replace(face, skeleton=replace(face.skeleton, rest_transforms=rest))


def shear() -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 1] = 0.4
    return matrix


FACES: dict[str, Callable[[], FaceParts]] = {
    "plain": tiny_face,
    "Z up, metres": lambda: replace(tiny_face(), up_axis="Z", meters_per_unit=1.0),
    "placed": placed_face,
    "placed, Z up": lambda: replace(placed_face(), up_axis="Z"),
    "posed rest": lambda: rest_face(similarity(4), similarity(5, 1.2), similarity(6)),
    "scaled rest": lambda: rest_face(np.diag([1.5, 0.7, 1.0, 1.0]), similarity(5), similarity(6)),
    "sheared rest": lambda: rest_face(shear(), shear() @ similarity(7), shear()),
    "mirrored rest": lambda: rest_face(np.eye(4), np.diag([1.0, -1.0, 1.0, 1.0])),
    "stretched skeleton": lambda: replace(
        tiny_face(), skeleton=replace(tiny_face().skeleton, transform=similarity(8) @ np.diag([1.0, 2.0, 0.5, 1.0]))
    ),
    "mirrored mesh": lambda: with_meshes(tiny_face(), transform=np.diag([-1.0, 1, 1, 1])),
}
