"""Points of a face by facepipe's rig, UsdSkel, the GLB read back and onnxruntime, against each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import facepipe_gltf
import facepipe_onnx
import gltf_reader
import numpy as np
from facepipe_onnx.runtime import Deformer
from faces import replace_mesh
from node import validate
from oracle import bake_all, random_coefficients
from places import SHARED

import facepipe
from facepipe.importers import makehuman
from facepipe.parts import FaceParts
from facepipe.rig import coefficient_matrices, rest_coefficients
from facepipe.stage import Face, save_parts

SOURCES = {"ict": SHARED / "ict_facekit" / "ict_facekit.npz", "makehuman": SHARED / "makehuman" / "makehuman_head.npz"}
OPTIONS = {"makehuman": makehuman.Options(shapes="expression/caucasian/*")}  # the targets that are expressions
TOLERANCE = 1e-5
POSES = 50
INFLUENCES = 8


class Pose(NamedTuple):
    weights: dict[str, float]
    coefficients: np.ndarray


class Judged(NamedTuple):
    face: Face  # limited to INFLUENCES
    poses: Sequence[Pose]  # the neutral, every shape alone, then random ones
    points: np.ndarray  # (poses, n, 3) of facepipe's rig
    folder: Path


def limited(parts: FaceParts, influences: int) -> FaceParts:
    """The face with only the largest weights of every point, summing to 1."""
    meshes = []
    for mesh in parts.meshes:
        if mesh.skin is None or mesh.skin.joint_weights.shape[1] <= influences:
            meshes.append(mesh)
            continue
        order = np.argsort(-mesh.skin.joint_weights, axis=1, kind="stable")[:, :influences]
        weights = np.take_along_axis(mesh.skin.joint_weights, order, axis=1).astype(np.float64)
        weights /= weights.sum(axis=1, keepdims=True)
        indices = np.take_along_axis(mesh.skin.joint_indices, order, axis=1)
        skin = replace(mesh.skin, joint_indices=np.where(weights > 0, indices, 0), joint_weights=weights)
        meshes.append(replace_mesh(mesh, skin=skin))
    return replace(parts, meshes=tuple(meshes))


def saved(parts: FaceParts, path: Path) -> Face:
    save_parts(parts, path)
    return facepipe.open(path)


def poses_of(face: Face) -> list[Pose]:
    rng = np.random.default_rng(2024)
    joints, shapes = len(face.skeleton.joints), face.shapes
    alone = [Pose({name: 1.0}, rest_coefficients(joints)) for name in shapes]
    random = [
        Pose(
            {str(name): float(rng.random()) for name in rng.permutation(shapes)[:8]},
            random_coefficients(rng, joints, 10.0 / face.mm_per_unit),
        )
        for _ in range(POSES)
    ]
    return [Pose({}, rest_coefficients(joints)), *alone, *random]


def worst(judged: Judged, points: np.ndarray) -> float:
    """Largest distance to the rig's points, in head heights."""
    assert points.shape == judged.points.shape
    return float(np.linalg.norm(points - judged.points, axis=-1).max() / judged.face.head_height)


def rig_is_usdskel(judged: Judged) -> None:
    local = [judged.face.rig().local_transforms(pose.coefficients) for pose in judged.poses]
    baked = bake_all(judged.face, [(pose.weights, one) for pose, one in zip(judged.poses, local, strict=True)])
    assert worst(judged, baked) < TOLERANCE


def glb_read_back_is_the_rig(judged: Judged) -> None:
    path = judged.folder / "face.glb"
    facepipe_gltf.export(judged.face, path, facepipe_gltf.Options(influences=INFLUENCES))
    document = gltf_reader.read(path)
    names = list(judged.face.skeleton.names)
    assert document.joint_names() == names
    results = []
    for pose in judged.poses:
        coefficients = pose.coefficients.copy()
        coefficients[:, :3] *= judged.face.meters_per_unit
        motion = dict(zip(names, coefficient_matrices(coefficients), strict=True))
        by_mesh = document.evaluate(pose.weights, motion)
        results.append(np.concatenate([by_mesh[mesh.name] for mesh in judged.face.meshes]))
    assert worst(judged, np.stack(results) / judged.face.meters_per_unit) < TOLERANCE
    issues = validate([path])[path]["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0)


def onnx_is_the_rig(judged: Judged) -> None:
    path = judged.folder / "face.onnx"
    facepipe_onnx.export(judged.face, path, facepipe_onnx.Options())
    deformer = Deformer(path)
    joints = len(judged.face.skeleton.joints)
    results = [
        deformer.evaluate(pose.weights, coefficients=pose.coefficients if joints else None)["points"].reshape(-1, 3)
        for pose in judged.poses
    ]
    assert worst(judged, np.stack(results)) < TOLERANCE
