"""Skeletons from joint positions."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Skeleton
from facepipe.rig.trs import rotation_matrices


def skeleton_of(old: Skeleton, paths: tuple[str, ...], positions: FloatArray, rotations: FloatArray) -> Skeleton:
    """The skeleton `old` with other joints.

    :param positions: (j, 3) in the world, stage units
    :param rotations: (j, 4) quaternions x y z w relative to the parent's axes; roots: to the skeleton's
    """
    plain = Skeleton(joints=paths)
    to_skeleton = np.linalg.inv(np.asarray(old.transform, np.float64))
    bind = np.tile(np.eye(4), (len(paths), 1, 1))
    turns = rotation_matrices(rotations)
    for i, parent in enumerate(plain.parents):
        bind[i, :3, :3] = turns[i] if parent < 0 else bind[parent, :3, :3] @ turns[i]
    bind[:, :3, 3] = positions @ to_skeleton[:3, :3].T + to_skeleton[:3, 3]
    return with_binds(old, paths, bind)


def with_binds(old: Skeleton, paths: tuple[str, ...], bind: FloatArray) -> Skeleton:
    """The skeleton `old` with other joints of bind transforms (j, 4, 4) in skeleton space, at rest as bound.

    Joints of the paths that are there keep their names.
    """
    plain, known = Skeleton(joints=paths), dict(zip(old.joints, old.names, strict=True))
    names = [known.get(path, leaf) for path, leaf in zip(paths, plain.names, strict=True)]
    parents = plain.parents
    inverse = np.linalg.inv(bind)
    rest = np.array([bind[i] if p < 0 else inverse[p] @ bind[i] for i, p in enumerate(parents)]).reshape(-1, 4, 4)
    made = Skeleton(name=old.name, joints=paths, bind_transforms=bind, rest_transforms=rest, transform=old.transform)
    return made.called(names)
