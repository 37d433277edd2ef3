"""Neural rigs learned from a face's own rig."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scan_domes
from command_line import done, failed, run
from neural_training import OPTIONS, SAMPLES, KilledError, turning_face

import facepipe
from facepipe.core.errors import InputError
from facepipe.geometry.shape_basis import local_basis, motion_basis
from facepipe.neural import (
    InvertNeuralRig,
    Motion,
    SampleMotion,
    SampleMotionOptions,
    TrainedNeuralRig,
    TrainNeuralRig,
    load_neural_rig,
    save_neural_rig,
    with_neural_rig,
)
from facepipe.neural.train_neural_rig import best_blendshapes, output_metric, ridge, skinned_moves
from facepipe.parts import FaceParts
from facepipe.rig import CHANNELS, build, rest_coefficients, slide
from facepipe.stage import save_parts

pytestmark = pytest.mark.needs_torch


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


def straight_face() -> FaceParts:
    parts = replace(scan_domes.face(), sliders=(), animations=())
    meshes = tuple(
        replace(mesh, blendshapes=tuple(replace(blendshape, inbetweens=()) for blendshape in mesh.blendshapes))
        for mesh in parts.meshes
    )
    return replace(parts, meshes=meshes)


def test_of_what_is_straight_nothing_is_learned(
    trained: TrainedNeuralRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert not trained.report.straight
    parts, head, file = straight_face(), tmp_path / "head.usda", tmp_path / "head.fpnr"
    save_parts(parts, head)
    few = ("--spread", 60, "--sweep", 5, "--together", 20, "--tolerance-mm", 1e-6, "--encoder-steps", 5)
    code, out, err = run(capsys, "neural-rig", "train", head, "-o", file, *few, "--plot", tmp_path / "p.svg", "--json")
    assert code == 0, err
    report = json.loads(out)
    assert (report["steps"], report["shapes"]) == (0, 2)
    assert max(report["error_max_mm"], report["linear_max_mm"]) < 1e-3
    assert report["warnings"] == [err.strip().removeprefix("facepipe: warning: ")]
    assert (tmp_path / "p.svg").exists(), "a picture that says that no steps were made"
    assert "head.usda: nothing to learn: 2 controls move the points straight, within 0.000" in err
    assert "a plain `facepipe export` is smaller, and exact" in err
    rig = load_neural_rig(file)
    assert len(rig.hidden) == 0
    attached = with_neural_rig(parts, rig, "head")
    assert attached.slider_network is None
    expected, height = build(parts).evaluate({"jawOpen": 0.7}), np.ptp(rig.rest)
    coefficients, weights = slide(attached.sliders, parts.skeleton.joints, {"jawOpen": 0.7})
    assert np.abs(build(attached).evaluate(weights, coefficients=coefficients) - expected).max() < 1e-5 * height
    found = InvertNeuralRig()(rig, rig.points(np.array([[0.3, 0.8]])))
    assert np.allclose(found.values, [[0.3, 0.8]], atol=5e-3)


def test_controls_beyond_their_limits_are_held_there(trained: TrainedNeuralRig) -> None:
    rig = trained.rig
    assert np.array_equal(rig.points(rig.values({"open": 5.0})), rig.points(rig.values({"open": 1.0})))
    with pytest.raises(InputError, match="no control 'shut', expected one of open, look"):
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


def test_bad_files_are_reported(trained: TrainedNeuralRig, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"suffix '.npz', expected .fpnr"):
        save_neural_rig(trained.rig, tmp_path / "one.npz", {})
    save_neural_rig(replace(trained.rig, linear=trained.rig.linear[:1]), tmp_path / "less.fpnr", {})
    with pytest.raises(InputError, match=r"less.fpnr -> linear: shape \(1, .*, expected \(4, "):
        load_neural_rig(tmp_path / "less.fpnr")
    (tmp_path / "junk.fpnr").write_bytes(b"junk")
    with pytest.raises(InputError, match=r"junk\.fpnr: is no neural rig, or cut short"):
        load_neural_rig(tmp_path / "junk.fpnr")


def test_still_controls_are_left_out_and_named(motion: Motion) -> None:
    still = motion.frames(np.flatnonzero(motion.values[:, 1] == 0.0))
    found = TrainNeuralRig(options=replace(OPTIONS, steps=100))(still)
    assert found.report.left_out == ("look",)
    with pytest.raises(InputError, match="no control moves in any frame"):
        TrainNeuralRig(options=OPTIONS)(
            motion.without([control.name for control in motion.controls[1:]]).frames(np.zeros(3, int))
        )


def test_a_basis_leaves_no_more_than_it_may() -> None:
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


def test_the_command_writes_a_rig_and_shows_its_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    face = tmp_path / "head.usda"
    save_parts(turning_face(), face)
    drawn = ("--plot", tmp_path / "curve.svg", "--checkpoint", tmp_path / "head.training")
    few = ("--spread", 60, "--sweep", 5, "--together", 20, "--width", 8, "--steps", 200, "--encoder-steps", 50)
    out = done(capsys, "neural-rig", "train", face, "-o", tmp_path / "head.fpnr", "--json", *drawn, *few)
    assert (tmp_path / "curve.svg").exists()
    assert not (tmp_path / "head.training").exists()
    printed = json.loads(out)
    assert printed["frames"] + printed["held_out"] == 60 + 5 * 4 + 20
    assert printed["error_mean_mm"] < printed["linear_mean_mm"]
    rig = load_neural_rig(tmp_path / "head.fpnr")
    assert {control.name for control in rig.controls} == {"open", "look", "jawOpen", "smile"}
    values = {"spread": 60, "sweep": 5, "together": 20, "width": 8, "steps": 200, "encoder_steps": 50}
    report = facepipe.neural_rig_train(face, out=tmp_path / "python.fpnr", **values)
    assert (tmp_path / "python.fpnr").read_bytes() == (tmp_path / "head.fpnr").read_bytes()
    assert report.encoder.error_mean == printed["encoder"]["error_mean"]
    err = failed(capsys, "neural-rig", "train", face, "-o", tmp_path / "head.onnx", *few, folder=tmp_path)
    assert "suffix '.onnx', expected .fpnr" in err
    failed(capsys, "neural-rig", "train", face, "-o", tmp_path / "head.fpnr", *few, folder=tmp_path)
    same = ("-o", tmp_path / "new.fpnr", "--checkpoint", tmp_path / "new.fpnr")
    assert "two outputs of one name" in failed(capsys, "neural-rig", "train", face, *same, *few, folder=tmp_path)


def test_bones_are_learned_as_bones(motion: Motion, trained: TrainedNeuralRig, tmp_path: Path) -> None:
    """Turns are straight in coefficients, so a few shapes and units do; files keep the bones."""
    rig = trained.rig
    assert rig.bones is not None
    assert sorted(map(tuple, rig.channels.tolist())) == sorted(
        (rig.bones.joints.index(joint), CHANNELS.index(channel))
        for joint, channel in (("head/jaw", "rx"), ("head/eye", "ry"), ("head/jaw", "sz"))
    )
    alone = TrainNeuralRig(options=OPTIONS)(replace(motion, bones=None, coefficients=None))
    assert alone.rig.bones is None
    assert trained.report.shapes < alone.report.shapes
    assert trained.report.error_mean_mm < alone.report.error_mean_mm
    save_neural_rig(rig, tmp_path / "one.fpnr", {})
    bones = load_neural_rig(tmp_path / "one.fpnr").bones
    assert bones is not None
    assert bones.joints == rig.bones.joints
    assert np.allclose(bones.rest, rig.bones.rest)


def test_unskinning_is_the_way_back(motion: Motion) -> None:
    bones, coefficients = motion.bones, motion.coefficients
    assert bones is not None
    assert coefficients is not None
    matrices = bones.skinning_matrices(bones.local_transforms(coefficients[7]))
    moved = bones.points + np.random.default_rng(0).normal(size=bones.points.shape)
    assert np.allclose(bones.unskin(bones.skin(moved, matrices), matrices), moved)
    flat = matrices.copy()
    flat[:, 1] = 0.0
    found = bones.unskin(bones.skin(bones.points, flat), flat)
    assert np.allclose(bones.skin(found, flat), bones.skin(bones.points, flat))
    assert np.allclose(found, bones.points)


def test_a_network_of_few_inputs_a_unit_is_not_misled_by_the_others() -> None:
    """Of twenty controls two act together: with sparse units, few frames are enough to see that."""
    from facepipe.rig.torch.distil import Samples, train

    random = np.random.default_rng(0)
    inputs = random.random((900, 20)) * (random.random((900, 20)) < 0.5)
    outputs = np.stack([inputs[:, 3] * inputs[:, 7], inputs[:, 5] ** 2], axis=1)
    parts = [Samples(inputs=inputs[rows], outputs=outputs[rows]) for rows in (slice(300), slice(300, 600))]
    errors = []
    for sparsity in (0.0, 0.2):
        found = train(*parts, width=32, activation="silu", seed=0, steps=2000, patience=2000, sparsity=sparsity)
        units = inputs[600:] @ found.hidden.T + found.hidden_bias
        message = inputs[600:] @ found.linear + units / (1.0 + np.exp(-units)) @ found.last.T + found.last_bias
        errors.append(np.sqrt(np.mean((message - outputs[600:]) ** 2)))
    assert errors[1] < 0.5 * errors[0]


def test_a_killed_training_goes_on_to_the_same_end(motion: Motion, trained: TrainedNeuralRig, tmp_path: Path) -> None:
    kept, steps = tmp_path / "head.training", iter(range(1, 1101))

    def kill() -> None:
        if next(steps) == 1100:
            raise KilledError

    with pytest.raises(KilledError):
        TrainNeuralRig(options=OPTIONS)(motion, kill, kept)
    assert kept.exists()
    with pytest.raises(InputError, match="a training of other frames or options"):
        TrainNeuralRig(options=replace(OPTIONS, seed=1))(motion, checkpoint=kept)
    counted: list[int] = []
    found = TrainNeuralRig(options=OPTIONS)(motion, lambda: counted.append(0), kept)
    assert len(counted) == found.report.steps == 1500  # those of before are counted at once
    assert np.array_equal(found.curve, trained.curve)
    assert found.report == trained.report
    for name in ("linear", "hidden", "last"):
        assert np.array_equal(getattr(found.rig, name), getattr(trained.rig, name))
    ended = kept.stat().st_mtime_ns
    again = TrainNeuralRig(options=OPTIONS)(motion, checkpoint=kept)
    assert np.array_equal(again.rig.last, trained.rig.last)
    assert kept.stat().st_mtime_ns == ended  # no step was taken: what has ended is not trained again


def test_the_curve_is_of_frames_learned_and_watched_and_drawn(trained: TrainedNeuralRig, tmp_path: Path) -> None:
    from facepipe.pictures.figures import training_chart

    assert np.array_equal(trained.curve[:, 0], np.arange(100, 1501, 100))
    assert (trained.curve[-1, 1:] < 0.5 * trained.curve[0, 1:]).all()
    curves = re.findall(r'<path d="([^"]*)"', training_chart(trained.curve).decode())
    assert [path.count("L") for path in curves] == [1501, 1501]  # every step, from check to check


def test_a_local_basis_is_the_same_space_in_fewer_places() -> None:
    """Three shapes of five points each, mixed: turned back, each is where it was."""
    random = np.random.default_rng(0)
    true = np.zeros((3, 30, 3))
    for number in range(3):
        true[number, 10 * number : 10 * number + 5] = random.normal(size=(5, 3))
    true /= np.linalg.norm(true, axis=(1, 2))[:, None, None]
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    mixed = np.tensordot(turn, true, axes=1)
    found = local_basis(mixed)
    assert np.allclose(np.abs(np.einsum("rni,sni->rs", found, true)).max(axis=1), 1.0, atol=1e-3)
    assert np.allclose(np.einsum("rni,sni->rs", found, found), np.eye(3), atol=1e-12)
    few = np.zeros((2, 4, 3))
    few[0, 1, 0] = few[1, 3, 1] = 1.0
    found = local_basis(np.tensordot([[0.8, 0.6], [-0.6, 0.8]], few, axes=1))  # no point is passed over
    assert np.allclose(np.abs(found), few, atol=1e-3)
    whole = np.full((2, 4, 3), np.sqrt(1.0 / 12.0))
    whole[1, 2:] *= -1.0
    assert np.linalg.norm(local_basis(whole), axis=2).sum() <= np.linalg.norm(whole, axis=2).sum()


def test_the_metric_is_of_what_outputs_move_and_bend(motion: Motion) -> None:
    """Against small steps of the skin itself."""
    bones = motion.bones
    assert bones is not None
    channels = np.argwhere(np.ptp(motion.coefficients, axis=0) > 0.0)
    shapes = np.random.default_rng(0).normal(size=(2, len(bones.points), 3))
    moves = skinned_moves(bones, shapes, channels)
    outputs = np.array([0.3, -0.2, *([0.01] * len(channels))])
    coefficients = rest_coefficients(len(bones.joints))
    step = 1e-4
    coefficients[channels[:, 0], channels[:, 1]] += step * outputs[2:]
    moved = bones.points + step * np.tensordot(outputs[:2], shapes, axes=1)
    at_rest = bones.skin(bones.points, bones.skinning_matrices(bones.rest))
    found = bones.skin(moved, bones.skinning_matrices(bones.local_transforms(coefficients))) - at_rest
    assert np.allclose(np.tensordot(outputs, moves, axes=1), found / step, atol=1e-3)
    triangles = motion.topology.triangles
    plain, bent = (output_metric(moves, motion.rest, triangles, detail) for detail in (0.0, 2.0))
    assert np.sum((outputs @ plain) ** 2) == pytest.approx(np.sum((found / step) ** 2), rel=1e-3)
    shift = np.ones((1, len(bones.points), 3))  # bends nothing: outputs of the metric are as without detail
    even = [output_metric(shift, motion.rest, triangles, detail).item() for detail in (0.0, 2.0)]
    assert even[0] == pytest.approx(even[1])
    assert np.sum((outputs @ bent) ** 2) > 1.01 * np.sum((outputs @ plain) ** 2)


def test_straight_models_are_exact_where_points_follow_controls_straight(motion: Motion) -> None:
    shapes = np.random.default_rng(0).normal(size=(len(motion.controls), *motion.rest.shape))
    straight = replace(motion, points=motion.rest + np.tensordot(motion.values, shapes, axes=1))
    for model in (best_blendshapes(straight), ridge(straight, 1e-4, 50)):
        found = np.stack([model.points(row) for row in motion.values[:9]])
        np.testing.assert_allclose(found, straight.points[:9], atol=1e-3)
