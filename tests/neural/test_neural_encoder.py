"""Encoders of neural rigs: from points back to controls, and the same as an ONNX graph."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import done, failed, run
from facepipe_onnx import Deformer, export_encoder, validate
from neural_training import turning_face

from facepipe.core.errors import InputError, TopologyError
from facepipe.geometry.ridge import ridge
from facepipe.neural import (
    Motion,
    SampleMotion,
    SampleMotionOptions,
    TrainedEncoder,
    TrainEncoder,
    TrainEncoderOptions,
    TrainNeuralRig,
    TrainNeuralRigOptions,
    load_encoder,
    load_neural_rig,
    save_neural_rig,
)
from facepipe.neural.train_encoder import farthest_points, halved, informative_points, well_placed
from facepipe.rig.neural_rig import NeuralEncoder, NeuralRig, inputs
from facepipe.stage import save_parts

pytestmark = pytest.mark.needs_torch
OPTIONS = TrainEncoderOptions(points=32, encoder_steps=500)
FEW = replace(OPTIONS, encoder_steps=30)


def sampled(spread: int, seed: int = 0) -> Motion:
    options = SampleMotionOptions(spread=spread, sweep=9, together=spread // 2, seed=seed)
    return SampleMotion(options=options)(turning_face(), "head.usda")


@pytest.fixture(scope="module")
def motion() -> Motion:
    return sampled(200)


@pytest.fixture(scope="module")
def trained(motion: Motion) -> TrainedEncoder:
    return TrainEncoder(options=OPTIONS)(motion)


@pytest.fixture(scope="module")
def forward(motion: Motion) -> NeuralRig:
    return TrainNeuralRig(options=TrainNeuralRigOptions(width=8, steps=100))(motion).rig


def test_controls_come_back_from_points_nearer_than_by_ridge(trained: TrainedEncoder) -> None:
    report = trained.report
    print(report)
    assert report.error_mean < 0.02 * report.constant_mean
    assert report.error_mean < 0.4 * report.ridge_mean
    assert report.points == 32
    assert set(report.errors) == {"open", "look", "jawOpen", "smile"}


def test_frames_that_nobody_drew_come_back_too(motion: Motion, trained: TrainedEncoder) -> None:
    other = sampled(40, seed=7)
    off = np.abs(trained.encoder.inputs(other.points) - inputs(other.controls, other.values)).mean() / 2.0
    assert off < 2.0 * trained.report.error_mean
    values = trained.encoder.values(other.points)
    span = np.array([control.maximum - control.minimum for control in motion.controls])
    assert np.abs((values - other.values) / span).mean() == pytest.approx(off)


def test_what_is_straight_is_not_bent(motion: Motion) -> None:
    random = np.random.default_rng(6)
    moves = random.normal(size=(len(motion.controls), *motion.rest.shape))
    points = motion.rest + np.tensordot(motion.values, moves, axes=1)
    report = TrainEncoder(options=FEW)(replace(motion, points=points)).report
    assert report.ridge_mean < 1e-3 * report.constant_mean
    assert report.error_mean < 1e-3 * report.constant_mean


def test_noise_that_it_learned_with_does_it_less_harm(motion: Motion, trained: TrainedEncoder) -> None:
    scans = TrainEncoder(options=replace(OPTIONS, noise_mm=5.0))(motion).encoder
    other = sampled(40, seed=7)
    noisy = other.points + np.random.default_rng(0).normal(scale=5.0, size=other.points.shape)
    true = inputs(other.controls, other.values)
    plain, trusty = (np.abs(one.inputs(noisy) - true).mean() for one in (trained.encoder, scans))
    assert trusty < 0.85 * plain


def test_values_stay_within_limits(motion: Motion, trained: TrainedEncoder) -> None:
    wild = motion.rest + np.random.default_rng(1).normal(scale=200.0, size=(50, *motion.rest.shape))
    values = trained.encoder.values(wild)
    for number, control in enumerate(motion.controls):
        assert values[:, number].min() >= control.minimum
        assert values[:, number].max() <= control.maximum
    assert (trained.encoder.values(wild[0]) == values[0]).all()


def test_only_the_chosen_points_count(motion: Motion, trained: TrainedEncoder) -> None:
    encoder = trained.encoder
    frame = np.array(motion.points[5], np.float64)
    moved = frame + 100.0
    moved[encoder.chosen] = frame[encoder.chosen]
    assert (encoder.values(moved) == encoder.values(frame)).all()


def test_the_numbering_of_points_changes_nothing(motion: Motion) -> None:
    order = np.random.default_rng(2).permutation(len(motion.rest))
    renumbered = replace(motion, points=motion.points[:, order], rest=motion.rest[order])
    one, other = (TrainEncoder(options=FEW)(each).encoder for each in (motion, renumbered))
    assert (order[other.chosen] == one.chosen).all()
    assert np.allclose(other.values(renumbered.points), one.values(motion.points), atol=1e-4)


def test_torch_and_numpy_agree(motion: Motion, trained: TrainedEncoder) -> None:
    from facepipe.neural.learning.encoder_fit import LAYER, evaluate

    encoder = trained.encoder
    names = ("point", "point_bias", "feature", "feature_bias", "token", "places", "reduce", "reduce_bias")
    weights = {name: torch.as_tensor(getattr(encoder, name)) for name in (*names, "last", "straight", "offset")}
    weights["scale"] = torch.tensor(encoder.scale)
    for number, layer in enumerate(encoder.layers):
        weights |= {f"{number}.{name}": torch.as_tensor(getattr(layer, name)) for name in LAYER}
    offsets = (motion.points[:, encoder.chosen] - encoder.rest).astype(np.float32)
    found = evaluate(weights, torch.as_tensor(offsets), encoder.heads).numpy()
    assert np.abs(np.clip(found, -1, 1) - encoder.of_offsets(offsets)).max() < 1e-5


def test_the_graph_gives_the_same_values(trained: TrainedEncoder, tmp_path: Path) -> None:
    encoder = trained.encoder
    report = export_encoder(encoder, tmp_path / "encoder.onnx", {"Head": 961, "Eye": encoder.point_count - 961})
    assert report.bytes == (tmp_path / "encoder.onnx").stat().st_size
    assert validate(tmp_path / "encoder.onnx") == ()
    graph = Deformer(tmp_path / "encoder.onnx")
    assert graph.metadata["further_operators"] == ["Div", "Softmax", "Sqrt"]
    assert json.loads((tmp_path / "encoder.onnx.json").read_text()) == graph.metadata
    span = np.array([control.maximum - control.minimum for control in encoder.controls])
    other = sampled(40, seed=9)
    for points in (*other.points[::3], 3.0 * other.points[0]):
        points = np.asarray(points, np.float32)
        found = graph.run({"points": points})["controls"][0]
        assert (np.abs(found - encoder.values(points)) / span).max() < 1e-5
    first = (tmp_path / "encoder.onnx").read_bytes()
    export_encoder(encoder, tmp_path / "encoder.onnx", {"Head": 961, "Eye": encoder.point_count - 961})
    assert (tmp_path / "encoder.onnx").read_bytes() == first


def test_graphs_without_points_or_with_other_meshes_are_refused(trained: TrainedEncoder, tmp_path: Path) -> None:
    with pytest.raises(TopologyError, match="face -> meshes: 5 points, expected"):
        export_encoder(trained.encoder, tmp_path / "encoder.onnx", {"Head": 5})
    assert not list(tmp_path.iterdir())
    export_encoder(trained.encoder, tmp_path / "encoder.onnx")
    with pytest.raises(InputError, match=r"encoder.onnx -> points: not given, expected numbers of shape \("):
        Deformer(tmp_path / "encoder.onnx").run({})


def test_other_points_and_topologies_are_refused(motion: Motion, trained: TrainedEncoder) -> None:
    encoder = trained.encoder
    with pytest.raises(TopologyError, match=r"points: shape \(3, 3\), expected \(\.\.\., "):
        encoder.values(np.zeros((3, 3)))
    bad = np.array(motion.points[0])
    bad[0, 0] = np.nan
    with pytest.raises(InputError, match="points: NaN or infinity"):
        encoder.values(bad)
    encoder.check(motion.topology.digest, "head.usda")
    with pytest.raises(TopologyError, match=r"head.usda: topology sha256:0+\.\.\., expected sha256:"):
        encoder.check("sha256:" + "0" * 64, "head.usda")


def test_files_hold_it_beside_the_rig(
    motion: Motion, trained: TrainedEncoder, forward: NeuralRig, tmp_path: Path
) -> None:
    save_neural_rig(forward, tmp_path / "plain.fpnr", {})
    with pytest.raises(InputError, match=r"plain.fpnr: has no encoder, expected"):
        load_encoder(tmp_path / "plain.fpnr")
    save_neural_rig(forward, tmp_path / "both.fpnr", {}, trained.encoder)
    assert load_neural_rig(tmp_path / "both.fpnr").controls == forward.controls
    found = load_encoder(tmp_path / "both.fpnr")
    assert found.controls == trained.encoder.controls
    assert np.abs(found.inputs(motion.points[:30]) - trained.encoder.inputs(motion.points[:30])).max() < 1e-5
    again = TrainEncoder(options=FEW)(motion).encoder
    save_neural_rig(forward, tmp_path / "one.fpnr", {}, again)
    save_neural_rig(forward, tmp_path / "two.fpnr", {}, TrainEncoder(options=FEW)(motion).encoder)
    assert (tmp_path / "one.fpnr").read_bytes() == (tmp_path / "two.fpnr").read_bytes()


def test_encoders_that_do_not_fit_are_reported(trained: TrainedEncoder, forward: NeuralRig, tmp_path: Path) -> None:
    encoder, path = trained.encoder, tmp_path / "head.fpnr"
    with pytest.raises(TopologyError, match=r"head.fpnr -> encoder: topology other"):
        save_neural_rig(replace(forward, topology="other"), path, {}, replace(encoder, topology="sha256:1"))
    with pytest.raises(InputError, match=r"head.fpnr -> encoder: other controls"):
        save_neural_rig(forward, path, {}, replace(encoder, controls=encoder.controls[::-1]))
    assert not path.exists()
    damaged: dict[str, NeuralEncoder] = {
        r"encoder.last: shape \(1, ": replace(encoder, last=encoder.last[:1]),
        r"encoder.widen: shape \(": replace(
            encoder, layers=(replace(encoder.layers[0], widen=encoder.layers[0].widen[1:]), *encoder.layers[1:])
        ),
        "encoder.chosen: points 0 to ": replace(encoder, point_count=10),
        "3 heads for tokens of 32": replace(encoder, heads=3),
        "scale 0": replace(encoder, scale=0.0),
    }
    for message, one in damaged.items():
        save_neural_rig(forward, path, {}, one)
        with pytest.raises(InputError, match=message):
            load_encoder(path)


def test_points_and_controls_that_do_not_move_are_reported(motion: Motion) -> None:
    still = motion.frames(np.flatnonzero(motion.values[:, 1] == 0.0))
    found = TrainEncoder(options=FEW)(still)
    assert found.report.left_out == ("look",)
    assert [control.name for control in found.encoder.controls] == ["open", "jawOpen", "smile"]
    with pytest.raises(InputError, match="no point moves in any frame"):
        TrainEncoder(options=FEW)(replace(motion, points=np.tile(motion.rest, (len(motion.values), 1, 1))))


def test_small_faces_give_all_their_points(motion: Motion) -> None:
    few = np.argsort(np.ptp(motion.points, axis=0).max(axis=1))[-11:]
    points = np.tile(motion.rest, (len(motion.values), 1, 1))
    points[:, few] = motion.points[:, few]
    found = TrainEncoder(options=replace(FEW, per_token=4))(replace(motion, points=points)).encoder
    assert set(found.chosen) < set(few.tolist())
    assert found.places.shape == (2, 32)
    assert len(TrainEncoder(options=FEW)(replace(motion, points=points)).encoder.places) == 1


def test_ridge_is_least_squares_over_rows_with_all_noise() -> None:
    random = np.random.default_rng(8)
    seen, wanted, noise = random.normal(size=(30, 4)) + 2.0, random.normal(size=(30, 2)), np.array([0.1, 0.5, 1.0, 3.0])
    matrix, offset = ridge(seen, wanted, noise)
    either = [seen + sign * np.sqrt(4.0) * noise * unit for unit in np.eye(4) for sign in (-1.0, 1.0)]
    rows = np.concatenate([np.concatenate(either), np.ones((240, 1))], axis=1)
    expected = np.linalg.lstsq(rows, np.tile(wanted, (8, 1)), rcond=None)[0]
    assert np.allclose(matrix, expected[:4])
    assert np.allclose(offset, expected[4])


def test_the_points_chosen_show_more_than_points_drawn() -> None:
    random = np.random.default_rng(3)
    places = random.uniform(-50, 50, (400, 3))
    middles = random.uniform(-50, 50, (12, 3))
    near = np.exp(-np.square(places[:, None] - middles).sum(axis=2) / 400.0)  # (n, c)
    moves = near[:, None, :] * random.normal(size=(3, 12))
    chosen = informative_points(moves, 0.1, 16)
    assert len(set(chosen.tolist())) == 16

    def doubt(points: np.ndarray) -> float:
        rows = moves[points].reshape(-1, 12)
        return float(np.trace(np.linalg.inv(rows.T @ rows / 0.01 + 3.0 * np.eye(12))))

    drawn = [doubt(random.permutation(400)[:16]) for _ in range(200)]
    assert doubt(chosen) < min(drawn)
    order = random.permutation(400)
    renumbered = well_placed(places[order], moves[order], 0.1, 16, 100)
    assert (order[renumbered] == well_placed(places, moves, 0.1, 16, 100)).all()


def test_farthest_points_are_spread_and_never_still() -> None:
    places = np.random.default_rng(4).uniform(size=(300, 3))
    weight = (places[:, 0] > 0.5).astype(float)
    found = farthest_points(places, weight, 20)
    assert len(set(found.tolist())) == 20
    assert weight[found].all()
    apart = np.linalg.norm(places[found][:, None] - places[found], axis=2) + np.eye(20)
    covered = np.linalg.norm(places[weight > 0][:, None] - places[found], axis=2).min(axis=1).max()
    assert apart.min() >= covered
    assert len(farthest_points(np.zeros((5, 3)), np.array([1.0, 0.0, 1.0, 1.0, 0.0]), 9)) == 3


def test_halves_of_the_order_are_boxes() -> None:
    places = np.random.default_rng(5).uniform(size=(64, 3)) * [5.0, 1.0, 1.0]
    order = halved(places)
    assert sorted(order.tolist()) == list(range(64))
    lower, upper = places[order[:32], 0], places[order[32:], 0]
    assert lower.max() < upper.min()
    near = np.mean([np.ptp(places[order[i : i + 8]], axis=0).max() for i in range(0, 64, 8)])
    assert near < 0.5 * np.ptp(places, axis=0).max()


def test_the_command_trains_one_where_it_is_asked_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    face = tmp_path / "head.usda"
    save_parts(turning_face(), face)
    few = ("--spread", 60, "--sweep", 5, "--together", 20, "--width", 8, "--steps", 100, "--json")
    few += ("--points", 16, "--encoder-steps", 20)
    out = done(capsys, "neural-rig", "train", face, "-o", tmp_path / "head.fpnr", *few)
    printed = json.loads(out)["encoder"]
    assert printed["points"] == 16
    assert printed["error_mean"] < printed["constant_mean"]
    assert len(load_encoder(tmp_path / "head.fpnr").chosen) == 16
    out = done(capsys, "neural-rig", "train", face, "-o", tmp_path / "plain.fpnr", "--no-encoder", *few)
    assert json.loads(out)["encoder"] is None
    with pytest.raises(InputError, match="has no encoder"):
        load_encoder(tmp_path / "plain.fpnr")


def test_export_writes_its_graph_for_the_face(
    trained: TrainedEncoder, forward: NeuralRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    face, file, graph = tmp_path / "head.usda", tmp_path / "head.fpnr", tmp_path / "encoder.onnx"
    save_parts(turning_face(), face)
    save_neural_rig(forward, file, {}, trained.encoder)
    words = ("export", face, "--neural", file, "--encoder", "-o", graph)
    code, out, err = run(capsys, *words)
    assert code == 0, err
    assert (len(out.splitlines()), err.count("warning")) == (1, 0)  # it has no shapes to name
    points = np.asarray(sampled(3, seed=5).points[0], np.float32)
    span = np.array([control.maximum - control.minimum for control in trained.encoder.controls])
    found = Deformer(graph).run({"points": points})["controls"][0]
    assert (np.abs(found - trained.encoder.values(points)) / span).max() < 1e-5
    other = replace(forward, topology="sha256:1"), file, {}, replace(trained.encoder, topology="sha256:1")
    save_neural_rig(*other)
    assert "expected sha256:1... that the encoder was learned on" in failed(capsys, *words, "--force", folder=tmp_path)
    save_neural_rig(forward, file, {})
    for wrong, message in ((words, "has no encoder"), (("export", face, "--encoder", "-o", graph), "option encoder")):
        assert message in failed(capsys, *wrong, "--force", folder=tmp_path)
