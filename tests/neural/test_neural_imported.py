"""MakeHuman as imported, by commands alone: a neural rig trained and exported, its clips and sliders in three.js."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from command_line import exit_code
from facepipe_onnx import Deformer
from gltf_reader import read
from import_data import shared
from neural_graphs import asked
from node import node_packages, three_load, three_play

import facepipe
from facepipe.stage import Face

pytestmark = pytest.mark.slow

HEAD = "makehuman/makehuman_head.npz"
FEW = ("--spread", 150, "--sweep", 4, "--together", 60)
QUICK = (*FEW, "--steps", 300, "--width", 48, "--shapes", 48, "--no-encoder")
CLIPS = ("JawDrop", "MouthLeftPullUp", "TongueLeft")
SETTINGS: tuple[Mapping[str, float], ...] = (
    {"JawDrop": 1.0},  # jawOpen of ARKit
    {"LeftUpperLidClosed": 1.0},  # eyeBlinkLeft
    {"MouthLeftPullUp": 0.6},  # mouthSmileLeft
    {"JawDrop": 0.5, "LeftUpperLidClosed": 0.7, "MouthLeftPullUp": 1.0},
)


class Delivered(NamedTuple):
    """A face as it was imported, and what an engine gets of its neural rig."""

    face: Face
    glb: Path
    graph: Deformer
    error_mm: float  # of the neural rig, on frames held out
    left_mm: float  # what the files say they leave beside it


def ran(*words: object) -> dict[str, Any]:
    """The JSON that a command prints."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        assert exit_code(*words, "--json") == 0
    found = json.loads(text.getvalue())
    assert isinstance(found, dict)
    return found


@pytest.fixture(scope="module", params=["face", "frames"])
def delivered(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Delivered:
    """Trained on the face itself, with its bones, or on what `facepipe bake` writes of it, by shapes alone."""
    folder = tmp_path_factory.mktemp("delivered")
    head, rig = folder / "head.usdc", folder / "head.fpnr"
    assert exit_code("import", "makehuman", shared(HEAD), head) == 0
    data = head
    if request.param == "frames":
        data = folder / "frames.usdc"
        ran("bake", head, "-o", data, *FEW)
    report = ran("neural-rig", "train", data, "-o", rig, *QUICK)
    return exported(folder, head, rig, report["error_max_mm"])


def exported(folder: Path, head: Path, rig: Path, error_mm: float) -> Delivered:
    """What `facepipe export --neural` writes, and what it says of it."""
    ran("export", head, "--neural", rig, "-o", folder / "rig.onnx")
    words = ("-o", folder / "rig.glb", "--animations")
    report = ran("export", head, "--neural", rig, *words)
    left = report["dropped_mm"] + report["clips_mm"] + (report["error_mm"] or 0.0)
    return Delivered(facepipe.open(head), folder / "rig.glb", Deformer(folder / "rig.onnx"), error_mm, left)


def millimetres(delivered: Delivered, answer: Mapping[str, Any], positions: np.ndarray, expected: np.ndarray) -> float:
    """How far the vertices that three.js shows are at most from (n, 3) points of the face, stage units."""
    points, start = delivered.face.split(expected * delivered.face.mm_per_unit), 0
    worst = 0.0
    for mesh in answer["meshes"]:
        own = points[mesh["name"]][np.array(mesh["points"], int)]
        found, start = positions[start : start + len(own)], start + len(own)
        worst = max(worst, float(np.linalg.norm(1e3 * found - own, axis=1).max()))
    return worst


@pytest.mark.needs_torch
def test_clips_play_as_the_face_has_them(delivered: Delivered, tmp_path: Path) -> None:
    node_packages()
    face = delivered.face
    assert [one["name"] for one in read(delivered.glb).list("animations")] == [
        animation.name for animation in face.animations
    ]
    for name in CLIPS:
        answer, shown = three_play(delivered.glb, name, [0.0], tmp_path / "shown.bin")
        local, weights = face.sample(name)
        expected = face.evaluate(weights, joint_transforms=local)
        off = millimetres(delivered, answer, shown[0], expected)
        print(name, off, delivered.left_mm)
        assert off < delivered.left_mm + 1e-5 * face.head_height * face.mm_per_unit


@pytest.mark.needs_torch
@pytest.mark.parametrize("values", SETTINGS, ids=lambda values: "+".join(values))
def test_sliders_play_as_the_face_has_them(delivered: Delivered, values: Mapping[str, float]) -> None:
    node_packages()
    face, found = delivered.face, delivered.graph.evaluate(sliders=values)
    answer = three_load(delivered.glb, *asked(delivered.face.parts(), read(delivered.glb), delivered.graph, found))
    positions = np.concatenate([np.array(mesh["positions"]) for mesh in answer["meshes"]])
    expected, rest = face.evaluate(sliders=values), face.evaluate()
    off = millimetres(delivered, answer, positions, expected)
    moved = np.linalg.norm(expected - rest, axis=1).max() * face.mm_per_unit
    print(values, off, delivered.error_mm, delivered.left_mm, moved)
    assert off < delivered.error_mm + delivered.left_mm
    assert off < 0.5 * moved
