"""`facepipe neural-rig invert`: stages to controls over time, and back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import done, failed, run
from neural_faces import frames, moving, untrained_rig
from neural_training import turning_face
from oracle import played
from pxr import Sdf, Usd, UsdGeom, Vt

import facepipe
from facepipe.core.errors import InputError, TopologyError
from facepipe.neural import Motion, ReadClips, TrainEncoder, TrainEncoderOptions, save_neural_rig
from facepipe.neural.read_motion import read_targets
from facepipe.parts import Animation
from facepipe.rig import rest_coefficients
from facepipe.rig.neural_rig import Control, NeuralRig, share_limits, values_of
from facepipe.stage import save_parts
from facepipe.stage.controls_over_time import read_controls, save_controls
from facepipe.stage.face import play
from facepipe.verbs.whole_faces import Topology

TOPOLOGY = Topology.of(turning_face())


@pytest.fixture(scope="module")
def rig() -> NeuralRig:
    return replace(untrained_rig(None), topology=TOPOLOGY.digest)


def baked(path: Path, points: np.ndarray, codes: list[float], scale: float = 0.01) -> Path:
    """Whole points over time on the meshes of the face, Z up and in other units; without codes a pose."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, scale)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetTimeCodesPerSecond(30.0)
    turned = np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1) * 0.001 / scale
    starts = np.cumsum([0, *TOPOLOGY.points])
    for number, name in enumerate(TOPOLOGY.names):
        mesh = UsdGeom.Mesh.Define(stage, f"/Clip/{name}")
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(TOPOLOGY.counts[number]))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(TOPOLOGY.indices[number]))
        own = np.ascontiguousarray(turned[:, starts[number] : starts[number + 1]], np.float32)
        for row, code in zip(own, codes or [Usd.TimeCode.Default()], strict=True):
            mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(row), code)
    stage.Save()
    return path


def test_a_clip_becomes_controls_that_train_and_others_read(
    rig: NeuralRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = moving(rig, 12)
    codes = [*np.arange(8.0), *np.arange(20.0, 24.0)]
    save_neural_rig(rig, tmp_path / "one.fpnr", {})
    clip = baked(tmp_path / "clip.usdc", rig.points(values), codes)
    assert read_targets(clip, rig).blocks.tolist() == [0] * 8 + [1] * 4
    out = tmp_path / "controls.usda"
    printed = done(capsys, "neural-rig", "invert", tmp_path / "one.fpnr", clip, "-o", out, "--json")
    report = json.loads(printed)
    assert report["frames"] == 12
    assert report["error_mean_mm"] < 0.01
    assert set(report["controls"]) == {control.name for control in rig.controls}
    tracks = {track.name: track for track in read_controls(out)}
    for control, column in zip(rig.controls, values.T, strict=True):
        track = tracks[control.name]
        assert np.array_equal(track.codes, codes)
        assert np.allclose(track.values, column, atol=2e-3)
        assert (track.minimum, track.maximum, track.default) == (control.minimum, control.maximum, control.default)
    assert Usd.Stage.Open(str(out)).GetTimeCodesPerSecond() == 30.0
    assert np.allclose(ReadClips()([out], rig.controls).values[:6], values[:6], atol=2e-3)


def test_a_pose_becomes_values_without_time(rig: NeuralRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = moving(rig, 12)[5:6]
    save_neural_rig(rig, tmp_path / "one.fpnr", {})
    pose = baked(tmp_path / "pose.usda", rig.points(values), [])
    out = tmp_path / "controls.usda"
    printed = done(capsys, "neural-rig", "invert", tmp_path / "one.fpnr", pose, "-o", out)
    assert "controls of 1 frame," in printed
    tracks = {track.name: track for track in read_controls(out)}
    found = [tracks[control.name].values for control in rig.controls]
    assert np.allclose(np.array(found)[:, 0], values[0], atol=2e-3)
    assert all(len(track.codes) == 0 for track in tracks.values())


def with_encoder(path: Path) -> NeuralRig:
    """A rig so bent that its defaults lie in other valleys than many of its frames, with an encoder of what it does."""
    rig = untrained_rig(None, seed=3)
    rig = replace(rig, last=4.0 * rig.last, hidden=3.0 * rig.hidden, topology=TOPOLOGY.digest)
    random, count = np.random.default_rng(3), 600
    x = random.uniform(*share_limits(rig.controls), (count, 5)) * (random.random((count, 5)) < 0.7)
    values = values_of(rig.controls, x)
    motion = Motion(
        where="made",
        topology=TOPOLOGY,
        controls=rig.controls,
        values=values,
        points=rig.points(values),
        rest=rig.rest,
        blocks=np.arange(count),
    )
    trained = TrainEncoder(options=TrainEncoderOptions(points=64, encoder_steps=300))(motion)
    save_neural_rig(rig, path, {}, trained.encoder)
    return rig


@pytest.mark.needs_torch
def test_the_encoder_of_the_rig_starts_near_the_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From the defaults frames end in poor valleys; the encoder's guess is in the right one, and fewer steps away."""
    rig = with_encoder(tmp_path / "one.fpnr")
    clip = baked(tmp_path / "clip.usdc", rig.points(frames(rig)), [*np.arange(24.0)])
    words = ("neural-rig", "invert", tmp_path / "one.fpnr", clip, "--starts", 1, "--smoothness", 0, "--json")
    reports = []
    for number, more in enumerate(((), ("--no-encoder",))):
        message = done(capsys, *words, "-o", tmp_path / f"{number}.usda", *more)
        reports.append(json.loads(message))
    guessed, still = reports
    print([(report["steps"], report["worst_frame_mm"]) for report in reports])
    assert guessed["steps"] < 0.5 * still["steps"]
    assert guessed["worst_frame_mm"] < 0.01
    assert still["worst_frame_mm"] > 1.0


def animated(path: Path, *clips: Animation) -> Path:
    """The face in other units and Z up, with animations that nothing plays yet."""
    save_parts(replace(turning_face(), meters_per_unit=0.02, up_axis="Z", animations=clips), path)
    return path


def talk(name: str, seed: int) -> Animation:
    """Four samples of joints that turn and stretch, and of shapes."""
    random = np.random.default_rng(seed)
    skeleton = turning_face().skeleton
    coefficients = rest_coefficients(len(skeleton.joints)) + 0.2 * random.normal(size=(4, len(skeleton.joints), 9))
    coefficients[..., 6:] = np.round(64.0 * coefficients[..., 6:]) / 64.0  # exact in the halves of SkelAnimation
    shapes = ("jawOpen", "smile")
    times = np.array([1.0, 2.0, 3.0, 10.0]) / 24.0
    weights = random.random((4, 2))
    return Animation(
        name=name,
        times=times,
        joints=skeleton.joints,
        coefficients=coefficients,
        shapes=shapes,
        shape_weights=weights,
    )


def test_faces_that_an_animation_moves_are_read_as_usd_skel_moves_them(rig: NeuralRig, tmp_path: Path) -> None:
    face = animated(tmp_path / "head.usda", talk("one", 1))
    expected = played(face, np.array([1.0, 2.0, 3.0, 10.0]) / 24.0, "one")
    targets = read_targets(face, rig)
    assert targets.codes.tolist() == [1.0, 2.0, 3.0, 10.0]
    assert targets.blocks.tolist() == [0, 0, 0, 1]
    turned = 20.0 * np.stack([expected[..., 0], expected[..., 2], -expected[..., 1]], axis=-1)
    rest = read_targets(animated(tmp_path / "rest.usda"), rig).points[0]
    height = np.ptp(rest[:, 1])
    assert np.abs(targets.points - rest).max() > 0.05 * height
    assert np.abs(targets.points - turned).max() < 1e-5 * height


def test_of_several_animations_the_one_that_is_played_counts(rig: NeuralRig, tmp_path: Path) -> None:
    both = animated(tmp_path / "both.usda", talk("one", 1), talk("two", 2))
    with pytest.raises(InputError, match=r"2 animations over time \(one, two\), expected one, or one that"):
        read_targets(both, rig)
    face = facepipe.open(both)
    play(face, "two")
    face.stage.GetRootLayer().Save()
    alone = read_targets(animated(tmp_path / "alone.usda", talk("two", 2)), rig)
    assert np.array_equal(read_targets(both, rig).points, alone.points)
    still = talk("two", 2)
    coefficients, weights = np.asarray(still.coefficients), np.asarray(still.shape_weights)
    still = replace(still, times=None, coefficients=coefficients[:1], shape_weights=weights[:1])
    pose = facepipe.open(animated(tmp_path / "pose.usda", still))
    assert np.array_equal(
        read_targets(tmp_path / "pose.usda", rig).points, read_targets(animated(tmp_path / "rest.usda"), rig).points
    )
    play(pose, "two")
    pose.stage.GetRootLayer().Save()
    found = read_targets(tmp_path / "pose.usda", rig)
    assert len(found.codes) == 0
    assert np.array_equal(found.points[0], alone.points[0])


def test_a_missed_threshold_and_bad_input_are_reported(
    rig: NeuralRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_neural_rig(rig, tmp_path / "one.fpnr", {})
    shaken = rig.rest + np.random.default_rng(0).normal(size=(3, *rig.rest.shape))
    clip = baked(tmp_path / "clip.usda", shaken, [1.0, 2.0, 3.0])
    out = tmp_path / "controls.usda"
    words = ("neural-rig", "invert", tmp_path / "one.fpnr")
    code, _, err = run(capsys, *words, clip, "-o", out, "--threshold-mm", 0.5)
    assert (code, err.count("\n")) == (1, 1)
    assert "mm off, more than 0.5 mm" in err
    assert out.exists()
    for more, message in (
        ((clip, "-o", out), "exists, expected a new file"),
        ((clip, "-o", tmp_path / "controls.json"), "suffix '.json'"),
        (
            (clip, "-o", out, "--force", "--threshold-mm", "-1"),
            "option threshold_mm: is -1.0, expected a number",
        ),
        ((clip, "-o", out, "--force", "--starts", "0"), "option starts: is 0"),
    ):
        assert message in failed(capsys, *words, *more, folder=tmp_path)


def test_other_meshes_are_refused(rig: NeuralRig, tmp_path: Path) -> None:
    clip = baked(tmp_path / "clip.usda", rig.rest[None], [])
    with pytest.raises(TopologyError, match=r"clip.usda: meshes .* points, expected those that the neural rig was"):
        read_targets(clip, replace(rig, topology="sha256:other"))
    Usd.Stage.CreateNew(str(tmp_path / "empty.usda")).Save()
    with pytest.raises(InputError, match="no mesh, expected those"):
        read_targets(tmp_path / "empty.usda", rig)


def test_controls_that_usd_cannot_hold_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="control '1st one', expected letters"):
        save_controls(tmp_path / "one.usda", [Control(name="1st one")], np.zeros((1, 1)), np.zeros(0))
    with pytest.raises(InputError, match="NaN"):
        save_controls(tmp_path / "one.usda", [Control(name="one")], np.full((1, 1), np.nan), np.zeros(0))
    assert not list(tmp_path.iterdir())


def test_controls_are_numbers_of_one_prim(tmp_path: Path) -> None:
    controls = [Control(name="jaw:open"), Control(name="look", minimum=-1.0)]
    save_controls(tmp_path / "one.usda", controls, np.array([[0.5, -0.5], [0.25, 0.0]]), np.array([1.0, 4.0]))
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "one.usda"))
    assert layer.defaultPrim == "Controls"
    assert (layer.startTimeCode, layer.endTimeCode) == (1.0, 4.0)
    assert [track.name for track in read_controls(tmp_path / "one.usda")] == ["jaw:open", "look"]
