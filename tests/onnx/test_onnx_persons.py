"""Persons as a graph: onnxruntime gives the points and joints that Python rebuilds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import facepipe_onnx
import numpy as np
import onnx
import onnxruntime
import pytest
from faces import tiny_face

import facepipe
from facepipe.heads import make
from facepipe.heads.assembly import skeleton
from facepipe.payload.person import PersonContent, decode_person
from facepipe.rig.bone_coefficients import coefficient_matrices
from facepipe.rig.identity_joints import coefficients_of_steps
from facepipe.rig.trs import rotation_matrices
from facepipe.stage import save_parts
from facepipe.verbs.person_basis import head_basis
from facepipe.verbs.person_layers import encode_points
from facepipe.verbs.whole_faces import whole_points

_TURNED = np.array([4.0, -3.0, 12.0, 0.05, 0.02, -0.03, 0.04])


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("graph") / "head.onnx"
    facepipe.basis(out=out)
    return out


def rows(placement: np.ndarray) -> np.ndarray:
    """(4, 3) of seven numbers, as the sidecar says."""
    placement = placement.astype(float)
    turn = placement[3:6]
    rotation = rotation_matrices(np.append(turn, np.sqrt(1 - turn @ turn)))
    return np.vstack([np.exp(placement[6]) * rotation.T, placement[:3]])


def fed(content: PersonContent) -> dict[str, Any]:
    """What a device reads of a payload."""
    basis = head_basis()
    modes, offsets = np.zeros((1, len(basis.modes))), np.zeros_like(basis.mean)
    modes[0, : len(content.modes)] = content.modes
    if content.points:
        offsets = basis.levels.decode(content.points, "points")
    joints = np.zeros((len(basis.joints.places), 3, 4))
    matrices = coefficient_matrices(coefficients_of_steps(content.joints, content.step))
    for i, (matrix, place) in enumerate(zip(matrices, basis.joints.places, strict=False)):
        linear = matrix[:3, :3] - np.eye(3)
        joints[i] = np.column_stack([linear, matrix[:3, 3] - linear @ place])
    placement = np.zeros(7) if content.placement is None else content.placement
    parts = content.parts if len(content.parts) else np.zeros((len(basis.rigid), 7))
    inputs = {"modes": modes, "placement": rows(placement)[None], "parts": np.array([[rows(one) for one in parts]])}
    inputs |= {"identity_joints": joints[None], "offsets": offsets[None]}
    return {name: np.asarray(value, np.float32) for name, value in inputs.items()}


@pytest.mark.parametrize("kind", ["drawn", "placed", "beyond"])
def test_onnxruntime_rebuilds_what_python_does(graph: Path, kind: str) -> None:
    points = whole_points(make(3))
    if kind == "placed":
        turned = rows(_TURNED)
        points = points @ turned[:3] + turned[3]
    if kind == "beyond":
        points = points + 2 * np.sin(points / 17)
    content = decode_person(encode_points(head_basis(), points, most=2000 if kind == "beyond" else 400)[0], kind)
    session = onnxruntime.InferenceSession(str(graph), providers=["CPUExecutionProvider"])
    found, joints = session.run(["points", "joints"], fed(content))
    own = head_basis().rebuilt(content, kind)
    assert bool(len(content.joints)) == (kind == "beyond")
    assert np.abs(found[0] - own).max() < 2e-4, "millimetres: of float32 at 200 of them, some 2e-5 a step"
    np.testing.assert_allclose(joints[0], 10 * skeleton(own / 10).bind_transforms[:, :3, 3], atol=2e-4)


def test_the_file_is_one_of_ours_and_small(graph: Path) -> None:
    assert not list(facepipe_onnx.validate(graph))
    model = onnx.load(str(graph))
    assert {one.op_type for one in model.graph.node} <= {"MatMul", "Mul", "Add", "Sub", "Cast", "Reshape", "Slice"} | {
        "Gather",
        "Concat",
    }
    assert graph.stat().st_size < 19_000_000
    sidecar = json.loads(graph.with_name("head.onnx.json").read_text())
    assert sidecar["face"]["basis"] == head_basis().digest.hex()
    assert [mesh["name"] for mesh in sidecar["meshes"]] == list(head_basis().topology.names)


def test_a_studios_face_has_offsets_alone(tmp_path: Path) -> None:
    save_parts(tiny_face(), tmp_path / "face.usda")
    facepipe.basis(out=tmp_path / "face.onnx", template=tmp_path / "face.usda")
    session = onnxruntime.InferenceSession(str(tmp_path / "face.onnx"), providers=["CPUExecutionProvider"])
    shapes = {one.name: one.shape for one in session.get_inputs()}
    count = tiny_face().point_count
    assert shapes == {"placement": [1, 4, 3], "offsets": [1, count, 3]}
    offsets = np.random.default_rng(0).normal(size=(1, count, 3)).astype(np.float32)
    (found,) = session.run(None, {"placement": rows(np.zeros(7))[None].astype(np.float32), "offsets": offsets})
    np.testing.assert_allclose(found[0], whole_points(tiny_face()) + offsets[0], atol=1e-3)
