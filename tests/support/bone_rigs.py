"""Rigs, poses and derivatives that the steps of bone fits are tested on."""

from __future__ import annotations

import functools

import numpy as np
from faces import tiny_face
from import_data import shared

from facepipe.importers import makehuman
from facepipe.parts import FaceParts
from facepipe.rig import Rig, build, rest_coefficients
from facepipe.verbs.fit_bones.skinning import Tree, stacked

MM = 100.0  # millimetres in a unit of MakeHuman


@functools.cache
def parts() -> FaceParts:
    return makehuman.read(shared("makehuman/makehuman_head.npz"), makehuman.Options()).parts


@functools.cache
def head() -> Rig:
    return build(parts())


@functools.cache
def small() -> Rig:
    return build(tiny_face(0))


def face_joints(rig: Rig) -> np.ndarray:
    """MakeHuman's 35 face joints that points hang at."""
    weighted = np.flatnonzero(np.asarray(abs(rig.influences[:, : len(rig.joints)]).sum(axis=0)).ravel() > 0)
    return np.array([joint for joint in weighted if "neck01" in rig.joints[joint].split("/")])


def random_pose(rng: np.random.Generator, count: int, joints: np.ndarray, reach: float = 0.1) -> np.ndarray:
    """Coefficients spanning +-10 mm (for MakeHuman), +-0.6 rad and 0.7 to 1.4."""
    pose, size = rest_coefficients(count), (len(joints), 3)
    spans = (rng.uniform(-reach, reach, size), rng.uniform(-0.6, 0.6, size), rng.uniform(0.7, 1.4, size))
    pose[joints] = np.concatenate(spans, axis=1)
    return pose


def limits(count: int, joints: np.ndarray, reach: float = 0.11) -> tuple[np.ndarray, np.ndarray]:
    """A little wider than `random_pose`; the other joints are locked at rest."""
    lower, upper = rest_coefficients(count), rest_coefficients(count)
    lower[joints] = [-reach] * 3 + [-0.65] * 3 + [0.68] * 3
    upper[joints] = [reach] * 3 + [0.65] * 3 + [1.42] * 3
    return lower, upper


def jacobian(tree: Tree, coefficients: np.ndarray, joints: np.ndarray | None = None) -> np.ndarray:
    """(3 n, 9 m) dense derivatives of all points by m joints, or all, from the tree's generators."""
    pose = tree.pose(coefficients)
    generators = tree.generators(pose)
    columns = []
    for joint in range(len(tree.rig.joints)) if joints is None else joints:
        below = tree.below[joint][:, None, None]
        for channel in range(9):
            moved = below * (generators[joint, channel] @ pose.skinning)
            columns.append((tree.rows @ stacked(moved)).ravel())
    return np.stack(columns, axis=1)
