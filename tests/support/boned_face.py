"""A small face whose head and eyes are boxes of points around their joints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from faces import replace_mesh, tiny_face

from facepipe.parts import FaceParts, Skeleton


def boned(up: str = "Y", eye_shapes: bool = False) -> FaceParts:
    """A face of 10 units whose head and eyes are boxes of points around their joints, each joint at an odd angle."""
    joints = ("spine", "spine/Head", "spine/Head/eye_L", "spine/Head/eye_R")
    places = {"spine": (0, 0, 0), "spine/Head": (0, 5, 0), joints[2]: (2, 8, 4), joints[3]: (-2, 8, 4)}
    to_stage = np.eye(4)
    if up == "Z":
        to_stage[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    world = np.stack([np.eye(4)] * 4)
    rng = np.random.default_rng(4)
    for i, joint in enumerate(joints):
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        world[i, :3, :3] = q * np.sign(np.linalg.det(q))
        world[i, :3, 3] = places[joint]
    world = to_stage @ world
    rest = world.copy()
    for i, parent in ((1, 0), (2, 1), (3, 1)):
        rest[i] = np.linalg.inv(world[parent]) @ world[i]
    skeleton = Skeleton(joints=joints, bind_transforms=world, rest_transforms=rest)
    mesh = tiny_face().meshes[0]
    count = len(mesh.points)
    owner = np.arange(count) % 3 + 1
    points = np.array([places[joints[one]] for one in owner]) + rng.uniform(-1, 1, (count, 3)) + (0, 0, 1)
    assert mesh.skin is not None
    weights = np.zeros((count, 3), np.float32)
    weights[:, 0] = 1
    skin = replace(mesh.skin, joint_indices=np.tile(owner[:, None], (1, 3)).astype(np.int32), joint_weights=weights)
    shapes = mesh.blendshapes
    if eye_shapes:
        left = np.flatnonzero(owner == 2).astype(np.int32)
        shapes = (
            *shapes,
            replace(shapes[1], name="eyeLookUpLeft", point_indices=left, offsets=shapes[1].offsets[left]),
        )
    head = replace_mesh(mesh, points=points @ to_stage[:3, :3].T, skin=skin, blendshapes=shapes)
    return replace(tiny_face(), meshes=(head,), skeleton=skeleton, up_axis=up, animations=())
