"""One face, four judges: facepipe's rig, UsdSkel.BakeSkinning, the GLB read back, and onnxruntime.

Every shape alone and 50 random poses, for the sample, in few triangles and as it is, ICT-FaceKit and MakeHuman: the
largest difference is at most 1e-5 of the head height. The USD side is limited to the influences that the GLB holds.
"""

from __future__ import annotations

from collections.abc import Callable

import facepipe_gltf
import gltf_reader
import numpy as np
import pytest
import small_head
from agreement import (
    INFLUENCES,
    OPTIONS,
    POSES,
    SOURCES,
    TOLERANCE,
    Judged,
    glb_read_back_is_the_rig,
    limited,
    onnx_is_the_rig,
    poses_of,
    rig_is_usdskel,
    saved,
)
from facepipe_gltf.options import ENGINES, renamed
from node import three_load

from facepipe.heads import make
from facepipe.importers import load
from facepipe.rig import coefficient_matrices


@pytest.fixture(
    scope="module",
    params=["small sample", *(pytest.param(name, marks=pytest.mark.slow) for name in ("sample", "ict")), "makehuman"],
)
def judged(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Judged:
    name = request.param
    if name in SOURCES and not SOURCES[name].exists():
        pytest.skip(f"needs {SOURCES[name].name} in ../shared/data")
    if name in SOURCES:
        parts = load(name, SOURCES[name], OPTIONS.get(name)).parts
    else:
        small = name == "small sample"
        parts = small_head.make(3, textures=16) if small else make(3, textures=16, controls="bones")
    folder = tmp_path_factory.mktemp(name)
    face = saved(limited(parts, INFLUENCES), folder / "face.usdc")
    poses = poses_of(face)
    points = np.stack([face.evaluate(pose.weights, coefficients=pose.coefficients) for pose in poses])
    return Judged(face, poses, points, folder)


def test_the_poses_move_the_face(judged: Judged) -> None:
    moved = np.linalg.norm(judged.points - judged.points[0], axis=-1).max(axis=1) / judged.face.head_height
    assert len(moved) == 1 + len(judged.face.shapes) + POSES
    assert moved[1:].min() > 1e-3


@pytest.mark.parametrize("agree", [rig_is_usdskel, onnx_is_the_rig], ids=lambda agree: agree.__name__)
def test_the_judges_agree(judged: Judged, agree: Callable[[Judged], None]) -> None:
    agree(judged)


@pytest.mark.parametrize(
    "judged",
    ["small sample", *(pytest.param(name, marks=pytest.mark.slow) for name in ("sample", "ict", "makehuman"))],
    indirect=True,
)
def test_the_glb_that_is_read_back_agrees(judged: Judged) -> None:
    glb_read_back_is_the_rig(judged)


def test_three_js_is_the_rig(judged: Judged) -> None:
    """Four influences: three.js reads no more."""
    face = saved(limited(judged.face.parts(), 4), judged.folder / "four.usdc")
    path = judged.folder / "three.glb"
    facepipe_gltf.export(face, path, facepipe_gltf.Options())
    pose = judged.poses[-1]
    coefficients = pose.coefficients.copy()
    expected = face.split(face.evaluate(pose.weights, coefficients=coefficients) * face.meters_per_unit)
    local = np.array(face.skeleton.rest_transforms)
    local = local @ coefficient_matrices(coefficients)
    local[:, :3, 3] *= face.meters_per_unit
    names = [renamed(ENGINES["three"], name, joint=True) for name in face.skeleton.names]
    joints = {name: matrix.T.ravel().tolist() for name, matrix in zip(names, local, strict=True)}
    targets = {target.name: target for target in face.rig().targets}
    vector = face.rig().weight_vector(pose.weights)
    weights = {name: float(target.curve(vector[target.shape])) for name, target in targets.items()}
    answer = three_load(path, weights, joints)
    assert answer["joints"] == len(names)
    found = {name for mesh in answer["meshes"] for name in mesh["targets"]}
    assert found == set(targets)
    tolerance = TOLERANCE * face.head_height * face.meters_per_unit
    document = gltf_reader.read(path).json
    order = [mesh["name"] for mesh in document["meshes"] for _ in mesh["primitives"]]
    assert len(order) == len(answer["meshes"])
    for name, mesh in zip(order, answer["meshes"], strict=True):
        numbers = np.array(mesh["points"], dtype=int)
        distance = np.linalg.norm(np.array(mesh["positions"]) - expected[name][numbers], axis=1).max()
        assert distance < tolerance, name
