"""What the tests of the VRM exporter share."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import small_head as sample
from facepipe_gltf import vrm
from facepipe_gltf.vrm.options import LICENSE_URL
from gltf_export import Parts, limited
from node import vrm_load

from facepipe.core.reports import ExportReport
from facepipe.parts import FaceParts, FloatArray, Skeleton
from facepipe.rig import build

TERMS = {"license_url": LICENSE_URL, "authors": "someone"}
EMOTIONS = ("happy", "angry", "sad", "relaxed", "surprised")
VOWELS = ("aa", "ih", "ou", "ee", "oh")
BLINKS = ("blink", "blinkLeft", "blinkRight")
LOOKS = ("lookUp", "lookDown", "lookLeft", "lookRight")
TURN = (0.1 * 3**-0.5, 0.9 * 0.5, 0.0)  # axis times sine of half the angle: mostly to the side
HEAD_TURN = [*TURN, float(np.sqrt(1 - np.square(TURN).sum()))]


def exported(parts: FaceParts, path: Path, **options: Any) -> ExportReport:
    """A face as VRM with a stub body."""
    return vrm.export(Parts(parts), path, vrm.Options(**TERMS | {"stub_body": True} | options))


def seen(file: Path, parts: FaceParts, poses: Sequence[Mapping[str, Any]]) -> tuple[dict[str, Any], list[FloatArray]]:
    """three-vrm's answer, and the points (n, 3) of all meshes in each pose; NaN where no vertex stands for one."""
    answer = vrm_load(file, poses)
    found = []
    for pose in answer["poses"]:
        points = {mesh.name: np.full((len(mesh.points), 3), np.nan) for mesh in parts.meshes}
        for one in pose["meshes"]:
            name = one["name"] if one["name"] in points else one["name"].rpartition("_")[0]  # three numbers primitives
            points[name][np.array(one["points"], np.int64)] = one["positions"]
        found.append(np.concatenate(list(points.values())))
    return answer, found


def evaluated(
    parts: FaceParts, weights: Mapping[str, float], head: str | None = None, turn: Sequence[float] = (0, 0, 0, 1)
) -> FloatArray:
    """(n, 3) points in metres of a Y-up face by the rig, of the 4 largest influences, its `head` joint turned."""
    rig = build(four(parts))
    local = None
    if head is not None:
        local = np.array(parts.skeleton.rest_transforms, np.float64)
        joint = parts.skeleton.joints.index(head)
        rest = rotation_at_rest(parts.skeleton, joint)
        local[joint, :3, :3] = local[joint, :3, :3] @ rest.T @ rotation(turn) @ rest
    return np.asarray(rig.evaluate(dict(weights), joint_transforms=local) * parts.meters_per_unit)


def four(parts: FaceParts) -> FaceParts:
    """The face with the 4 largest influences of every point."""
    return replace(parts, meshes=tuple(limited(mesh, 4) for mesh in parts.meshes))


def rotation_at_rest(skeleton: Skeleton, joint: int) -> FloatArray:
    """(3, 3) rotation of a joint in the skeleton's space at rest."""
    world = np.eye(3)
    while joint >= 0:
        world = np.asarray(skeleton.rest_transforms)[joint, :3, :3] @ world
        joint = int(skeleton.parents[joint])
    return world


def rotation(quaternion: Sequence[float]) -> FloatArray:
    """(3, 3) of x, y, z, w."""
    x, y, z, w = quaternion
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


@cache
def head() -> FaceParts:
    """The sample."""
    return sample.make()


def read_json(path: Path) -> Any:
    """The JSON of a GLB."""
    data = path.read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + size])


def extension(path: Path) -> Any:
    """The VRM extension of a file."""
    return read_json(path)["extensions"]["VRMC_vrm"]
