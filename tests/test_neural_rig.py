"""Neural rigs learned from a face's own rig."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scan_domes
from test_cli import run

from facepipe.errors import InputError
from facepipe.geometry.motion_basis import motion_basis
from facepipe.parts import FaceParts, Slider
from facepipe.processors.neural_rig import (
    Motion,
    SampleMotion,
    SampleMotionOptions,
    TrainedNeuralRig,
    TrainNeuralRig,
    TrainNeuralRigOptions,
    load_neural_rig,
    save_neural_rig,
)
from facepipe.stage import save_parts

torch = pytest.importorskip("torch")
SAMPLES = SampleMotionOptions(spread=200, sweep=9, together=100)
OPTIONS = TrainNeuralRigOptions(width=24, steps=1500, patience=1500)


def turning_face() -> FaceParts:
    """Sliders that turn the jaw and the eye far, and shapes without a slider."""
    jaw = Slider(name="open", minimum=-0.2, channels=(("head/jaw", "rx", 1.0),))
    eye = Slider(name="look", minimum=-1.0, channels=(("head/eye", "ry", 0.6), ("head/jaw", "sz", 0.3)))
    return replace(scan_domes.face(), sliders=(jaw, eye), animations=())


@pytest.fixture(scope="module")
def motion() -> Motion:
    return SampleMotion(options=SAMPLES)(turning_face(), "head.usda")


@pytest.fixture(scope="module")
def trained(motion: Motion) -> TrainedNeuralRig:
    return TrainNeuralRig(options=OPTIONS)(motion)


def test_a_neural_rig_is_nearer_than_the_best_blendshapes(trained: TrainedNeuralRig) -> None:
    report = trained.report
    print(report)
    assert report.motion_mean_mm > 1.0
    assert report.error_mean_mm < 0.5 * report.linear_mean_mm
    assert report.error_max_mm < report.linear_max_mm


def test_frames_that_nobody_drew_are_near_too(motion: Motion, trained: TrainedNeuralRig) -> None:
    other = SampleMotion(options=SampleMotionOptions(spread=50, sweep=0, together=0, seed=7))(
        turning_face(), "head.usda"
    )
    off = np.linalg.norm(trained.rig.points(other.values) - other.points, axis=2).mean()
    assert off < 1.5 * trained.report.error_mean_mm


def test_what_is_straight_is_learned_exactly() -> None:
    parts = replace(scan_domes.face(), sliders=(), animations=())
    straight = tuple(
        replace(mesh, blendshapes=tuple(replace(one, inbetweens=()) for one in mesh.blendshapes))
        for mesh in parts.meshes
    )
    motion = SampleMotion(options=SampleMotionOptions(spread=60, sweep=5, together=20))(
        replace(parts, meshes=straight), "head.usda"
    )
    found = TrainNeuralRig(options=replace(OPTIONS, steps=100, tolerance_mm=1e-6))(motion)
    assert found.report.error_max_mm < 1e-3
    assert found.report.shapes == 2


def test_controls_beyond_their_limits_are_held_there(trained: TrainedNeuralRig) -> None:
    rig = trained.rig
    assert np.array_equal(rig.points(rig.values({"open": 5.0})), rig.points(rig.values({"open": 1.0})))
    with pytest.raises(InputError, match="no control 'shut', expected some of open, look"):
        rig.values({"shut": 1.0})
    with pytest.raises(InputError, match="neural rig -> open: value nan"):
        rig.values({"open": float("nan")})


def test_files_hold_all_of_it_and_the_same_training_gives_the_same_bytes(
    motion: Motion, trained: TrainedNeuralRig, tmp_path: Path
) -> None:
    save_neural_rig(trained.rig, tmp_path / "one.fpnr", {})
    rig = load_neural_rig(tmp_path / "one.fpnr")
    assert rig.controls == trained.rig.controls
    assert np.allclose(rig.points(motion.values[:20]), trained.rig.points(motion.values[:20]), atol=1e-3)
    save_neural_rig(TrainNeuralRig(options=OPTIONS)(motion).rig, tmp_path / "two.fpnr", {})
    assert (tmp_path / "one.fpnr").read_bytes() == (tmp_path / "two.fpnr").read_bytes()


def test_bad_files_are_told(trained: TrainedNeuralRig, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"suffix '.npz', expected .fpnr"):
        save_neural_rig(trained.rig, tmp_path / "one.npz", {})
    save_neural_rig(replace(trained.rig, linear=trained.rig.linear[:1]), tmp_path / "less.fpnr", {})
    with pytest.raises(InputError, match=r"less.fpnr -> linear: shape \(1, .*, expected \(4, "):
        load_neural_rig(tmp_path / "less.fpnr")
    (tmp_path / "junk.fpnr").write_bytes(b"junk")
    with pytest.raises(InputError, match=r"junk\.fpnr"):
        load_neural_rig(tmp_path / "junk.fpnr")


def test_still_controls_are_left_out_and_named(motion: Motion) -> None:
    still = motion.frames(np.flatnonzero(motion.values[:, 1] == 0.0))
    found = TrainNeuralRig(options=replace(OPTIONS, steps=100))(still)
    assert found.report.left_out == ("look",)
    with pytest.raises(InputError, match="no control moves in any frame"):
        TrainNeuralRig(options=OPTIONS)(
            motion.without([one.name for one in motion.controls[1:]]).frames(np.zeros(3, int))
        )


def test_a_basis_leaves_no_more_than_it_is_told() -> None:
    random = np.random.default_rng(0)
    true = random.normal(size=(5, 40, 3))
    deltas = np.tensordot(random.normal(size=(30, 5)), true, axes=1)
    shapes, activations = motion_basis(deltas, 1e-9, 50)
    assert len(shapes) == 5
    assert np.allclose(np.tensordot(activations, shapes, axes=1), deltas)
    assert np.allclose(shapes.reshape(5, -1) @ shapes.reshape(5, -1).T, np.eye(5))
    some, weights = motion_basis(deltas, 2.0, 50)
    left = np.sqrt(((np.tensordot(weights, some, axes=1) - deltas) ** 2).sum(axis=2).mean())
    assert len(some) < 5
    assert left <= 2.0


def test_the_command_writes_a_rig_and_tells_its_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    face = tmp_path / "head.usda"
    save_parts(turning_face(), face)
    few = ("--spread", 60, "--sweep", 5, "--together", 20, "--width", 8, "--steps", 200)
    code, out, err = run(capsys, "neural-rig", "train", face, "-o", tmp_path / "head.fpnr", "--json", *few)
    assert code == 0, err
    told = json.loads(out)
    assert told["frames"] + told["held_out"] == 60 + 5 * 4 + 20
    assert told["error_mean_mm"] < told["linear_mean_mm"]
    rig = load_neural_rig(tmp_path / "head.fpnr")
    assert {one.name for one in rig.controls} == {"open", "look", "jawOpen", "smile"}
    code, _, err = run(capsys, "neural-rig", "train", face, "-o", tmp_path / "head.onnx", *few)
    assert (code, err.count("\n")) == (2, 1)
    assert "suffix '.onnx', expected .fpnr" in err
    code, _, err = run(capsys, "neural-rig", "train", face, "-o", tmp_path / "head.fpnr", *few)
    assert code == 2
