"""The whole way of set faces: commands that set a person, the export, and what readers and engines make of the file.

The sample by sliders, MakeHuman by sliders of its pose units, and a fit of a real photo: at rest, under every shape and
in the 50 poses of the stated error.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import gltf_reader
import numpy as np
import pytest
from command_line import exit_code
from engine_faces import pose_in
from engines import File, babylon, three
from facepipe_onnx.runtime import Deformer
from import_data import shared
from node import validate
from photographed_face import OFF
from small_head import make
from with_torch import torch

import facepipe
from facepipe.parts import FaceParts
from facepipe.rig import SetFace, coefficient_matrices, rest_coefficients, set_face
from facepipe.rig.set_error import random_poses
from facepipe.stage import Face, save_parts

pytestmark = [pytest.mark.needs_torch, pytest.mark.gate, pytest.mark.slow]
assert torch  # fits of photos need it

TOLERANCE = 1e-5  # of the head height
SETTINGS = {
    "sample": {"noseWidth": 0.8, "jawWidth": 0.9, "eyeSize": -0.5, "chinLength": 0.7, "cheekHeight": 0.6},
    "makehuman": {"LeftBrowDown": 0.4, "NasolabialDeepener": 0.6, "CheeksPump": 0.3},
}


class Delivered(NamedTuple):
    face: Face
    expected: SetFace
    glb: Path
    report: dict[str, Any]
    onnx: Path

    @property
    def height(self) -> float:
        """Of the head, stage units."""
        return self.face.head_height

    @property
    def stated(self) -> float:
        """The error that the report states for poses, in stage units."""
        error = self.report["pose_error"]["max_mm"] + (self.report["error_mm"] or 0.0)
        return float(error) / self.face.mm_per_unit


def set_on(kind: str, folder: Path) -> Path:
    """A stage with a person, made by commands."""
    template, person = folder / "template.usdc", folder / "person.usda"
    if kind == "photo":
        photo = shared("photos/astronaut.png")
        save_parts(make(0), template)
        marks = shared("photos/astronaut.landmarks.json")
        assert (
            exit_code(
                "fit-photo",
                photo,
                "--landmarks",
                marks,
                template,
                "-o",
                person,
                "--iterations",
                "60",
                "--size",
                "128",
                *OFF,
            )
            == 0
        )
        return person
    if kind == "sample":
        save_parts(make(0), template)
    else:
        source = shared("makehuman/makehuman_head.npz")
        assert exit_code("import", "makehuman", source, template, "--shapes", "expression/caucasian/*") == 0
    values = [word for name, value in SETTINGS[kind].items() for word in ("--set", f"{name}={value}")]
    assert exit_code("sliders", template, *values, "-o", person) == 0
    return person


@pytest.fixture(scope="module", params=["sample", "makehuman", "photo"])
def delivered(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Delivered:
    folder = tmp_path_factory.mktemp(request.param)
    with pytest.MonkeyPatch.context() as patch:
        printed: list[str] = []
        patch.setattr("builtins.print", lambda *words, **_: printed.append(" ".join(map(str, words))))
        person = set_on(request.param, folder)
        del printed[:]
        assert exit_code("export", person, "-o", folder / "person.glb", "--influences", "8", "--json") == 0
        report = json.loads("\n".join(line for line in printed if not line.startswith("facepipe: ")))
        assert exit_code("export", person, "-o", folder / "person.onnx") == 0
    face = facepipe.open(person)
    return Delivered(face, set_face(face.parts()), folder / "person.glb", report, folder / "person.onnx")


def poses_of(one: Delivered) -> list[tuple[dict[str, float], np.ndarray]]:
    parts: FaceParts = one.face.parts()
    return random_poses(one.face.rig(), parts)


def motion_of(one: Delivered, expression: np.ndarray) -> dict[str, np.ndarray]:
    """Matrices of the joints' nodes after their own, metres; the axes of all three faces are glTF's."""
    coefficients = one.expected.carried(expression)
    coefficients[:, :3] *= one.face.meters_per_unit
    names = gltf_reader.read(one.glb).joint_names()
    return dict(zip(names, coefficient_matrices(coefficients), strict=True))


def worst(one: Delivered, by_mesh: dict[str, np.ndarray], expected: np.ndarray) -> float:
    """Largest distance in stage units of points that faces use."""
    split, largest = one.face.split(expected), 0.0
    for mesh in one.face.meshes:
        used = np.unique(mesh.face_vertex_indices)
        found = by_mesh[mesh.name][used] / one.face.meters_per_unit
        largest = max(largest, float(np.linalg.norm(found - split[mesh.name][used], axis=1).max(initial=0.0)))
    return largest


def test_it_is_another_person_and_the_file_is_clean(delivered: Delivered) -> None:
    moved = delivered.face.evaluate(pose="set") - delivered.face.evaluate()
    assert np.linalg.norm(moved, axis=1).max() * delivered.face.mm_per_unit > 1.0
    assert delivered.report["pose"].startswith("set by sliders")
    assert delivered.report["pose_error"]["poses"] == 50
    issues = validate([delivered.glb])[delivered.glb]["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0)


def test_glb_is_the_set_face(delivered: Delivered) -> None:
    file, exact = gltf_reader.read(delivered.glb), TOLERANCE * delivered.height
    rest = rest_coefficients(len(delivered.face.skeleton.joints))
    few = delivered.report["error_mm"] or 0.0  # of fewer influences, where a face has more
    for weights in ({}, *({name: 1.0} for name in delivered.face.shapes)):
        found = file.evaluate(weights, motion_of(delivered, rest))
        off = worst(delivered, found, delivered.face.evaluate(weights, pose="set"))
        assert off < exact + few / delivered.face.mm_per_unit, weights
    for weights, expression in poses_of(delivered):
        expected = delivered.face.evaluate(weights, coefficients=expression, pose="set")
        off = worst(delivered, file.evaluate(weights, motion_of(delivered, expression)), expected)
        assert off < exact + delivered.stated


def test_onnx_is_the_set_face(delivered: Delivered) -> None:
    deformer, exact = Deformer(delivered.onnx), TOLERANCE * delivered.height
    for weights in ({}, *({name: 1.0} for name in delivered.face.shapes)):
        found = deformer.evaluate(weights)["points"].reshape(-1, 3)
        assert np.linalg.norm(found - delivered.face.evaluate(weights, pose="set"), axis=1).max() < exact, weights
    for weights, expression in poses_of(delivered):
        found = deformer.evaluate(weights, coefficients=delivered.expected.carried(expression))["points"].reshape(-1, 3)
        expected = delivered.face.evaluate(weights, coefficients=expression, pose="set")
        assert np.linalg.norm(found - expected, axis=1).max() < exact + delivered.stated


@pytest.mark.parametrize("engine", [three, babylon])
def test_engines_show_the_set_face(delivered: Delivered, engine: Any, tmp_path: Path) -> None:
    """At rest, with each shape, and in the 50 poses where the engine reads as many joints a vertex as the file has."""
    face, parts, document = delivered.face, delivered.expected.parts, gltf_reader.read(delivered.glb)
    rest = rest_coefficients(len(face.skeleton.joints))
    asked = [({}, rest), *(({name: 1.0}, rest) for name in face.shapes)]
    attributes = document.list("meshes")[0]["primitives"][0]["attributes"]
    asked += poses_of(delivered) if engine is babylon or "JOINTS_1" not in attributes else []
    poses = [pose_in(parts, document, weights, delivered.expected.carried(one)) for weights, one in asked]
    (pieces,) = engine([File(delivered.glb, poses)], tmp_path)
    for i, (weights, expression) in enumerate(asked):
        expected = face.split(face.evaluate(weights, coefficients=expression, pose="set"))
        allowed = TOLERANCE * delivered.height + (0.0 if expression is rest else delivered.stated)
        for piece in pieces:
            found = piece.positions[i] / face.meters_per_unit
            assert np.linalg.norm(found - expected[piece.mesh][piece.points], axis=1).max() < allowed, (piece.mesh, i)
