"""`facepipe bake`, and faces that a SkelAnimation moves: frames that neural rigs are learned from."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import done, failed, run
from neural_training import AMOUNTS, OPTIONS, acted, second_face, turning_face
from oracle import played
from pxr import Sdf, Usd, UsdGeom

import facepipe
from facepipe.core.errors import InputError
from facepipe.neural import (
    FrameBlocksOptions,
    Motion,
    ReadMotion,
    SampleMotion,
    SampleMotionOptions,
    TrainNeuralRig,
    load_neural_rig,
    save_neural_rig,
)
from facepipe.neural.motion import BakeMotion
from facepipe.parts import Animation, FaceParts
from facepipe.rig import slide
from facepipe.stage import save_parts
from facepipe.stage.controls_over_time import ControlTrack, is_recorded
from facepipe.verbs.whole_faces import MILLIMETRES, world_to_world

FEW = ("--spread", 12, "--sweep", 5, "--together", 6)
WHOLE = FrameBlocksOptions(block=1000, margin=0)


def baked(tmp_path: Path, capsys: pytest.CaptureFixture[str], parts: FaceParts, *words: object) -> dict[str, object]:
    save_parts(parts, tmp_path / "head.usda")
    files = (tmp_path / "head.usda", "-o", tmp_path / "frames.usdc")
    out = done(capsys, "bake", *files, *(words or FEW), "--json", quiet=False)
    found = json.loads(out)
    assert isinstance(found, dict)
    return found


def ordered(found: Motion, other: Motion) -> np.ndarray:
    """(f, c) values of controls in the order of another motion."""
    names = [control.name for control in found.controls]
    return np.asarray(found.values[:, [names.index(control.name) for control in other.controls]])


@pytest.mark.parametrize("up_axis", ["Y", "Z"])
def test_frames_are_what_the_face_evaluates(up_axis: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = replace(acted(), up_axis=up_axis)  # type: ignore[arg-type]
    report = baked(tmp_path, capsys, parts)
    found = ReadMotion(options=WHOLE)(tmp_path / "frames.usdc")
    names = [control.name for control in found.controls]
    assert names == ["chew", "jawOpen", "smile"]  # a clip moves jawOpen, though the slider drives it
    assert (report["frames"], report["clip_frames"], report["controls"]) == (18 + 3 * 5 + 41, 41, 3)
    assert len(found.values) == report["frames"]
    face = facepipe.open(tmp_path / "head.usda")
    to = world_to_world(face.meters_per_unit, face.up_axis, MILLIMETRES)
    for row, points in list(zip(found.values, found.points, strict=True))[::5]:
        values = dict(zip(names, row.tolist(), strict=True))
        shapes = {name: values[name] for name in ("jawOpen", "smile")}
        expected = face.evaluate(shapes, sliders={"chew": values["chew"]}) @ to[:3, :3].T
        assert np.abs(points - expected).max() < 1e-5 * np.ptp(found.rest)
    talk = found.values[-41:-1]
    assert np.allclose(talk, np.stack([0.0 * AMOUNTS, 0.1 * AMOUNTS, AMOUNTS], axis=1), atol=1e-6)


@pytest.mark.parametrize(("rate", "expected"), [(30.0, 30.0), (0.0, 24.0)])
def test_frames_come_as_fast_as_those_of_the_face(rate: float, expected: float, tmp_path: Path) -> None:
    """A rate of 0 is none: USD's own is taken."""
    save_parts(acted(), tmp_path / "head.usda")
    face = facepipe.open(tmp_path / "head.usda")
    face.stage.SetTimeCodesPerSecond(rate)
    few = SampleMotionOptions(spread=2, sweep=2, together=2)
    BakeMotion(options=few)(face, tmp_path / "head.usda", tmp_path / "frames.usdc")
    assert Usd.Stage.Open(str(tmp_path / "frames.usdc")).GetTimeCodesPerSecond() == expected


def test_sweeps_and_random_frames_are_apart_and_the_same_as_for_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = turning_face()
    baked(tmp_path, capsys, parts)
    found, read = ReadMotion(options=WHOLE)(tmp_path / "frames.usdc"), facepipe.open(tmp_path / "head.usda").parts()
    own = SampleMotion(options=SampleMotionOptions(spread=12, sweep=5, together=6))(read, "head")
    assert set(found.controls) == set(own.controls)
    assert found.topology.digest == own.topology.digest
    assert np.allclose(ordered(found, own), own.values)
    for name in ("points", "rest", "blocks"):
        assert np.allclose(getattr(found, name), getattr(own, name), rtol=0, atol=1e-4), name
    stage = Usd.Stage.Open(str(tmp_path / "frames.usdc"))
    head = UsdGeom.Mesh.Get(stage, stage.GetDefaultPrim().GetPath().AppendChild(parts.meshes[0].name))
    box = np.array(head.GetExtentAttr().Get(stage.GetEndTimeCode()))
    points = np.array(head.GetPointsAttr().Get(stage.GetEndTimeCode()))
    assert np.array_equal(box, [points.min(axis=0), points.max(axis=0)])


@pytest.mark.needs_torch
def test_rigs_are_trained_and_carried_from_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    baked(tmp_path, capsys, second_face(), "--spread", 60, "--sweep", 0, "--together", 0)
    own = TrainNeuralRig(options=replace(OPTIONS, steps=200))(
        SampleMotion(options=SampleMotionOptions(spread=100, sweep=5, together=40))(turning_face(), "first")
    )
    save_neural_rig(own.rig, tmp_path / "first.fpnr", {})
    words: tuple[object, ...] = ("retarget", tmp_path / "first.fpnr", tmp_path / "head.usda")
    words = (*words, "--frames", tmp_path / "frames.usdc", "-o", tmp_path / "second.fpnr")
    out = done(capsys, "neural-rig", *words, "--json")
    printed = json.loads(out)
    assert printed["controls"] == "given"
    assert printed["error_mean_mm"] < 0.7 * printed["copy_mean_mm"]
    words = ("train", tmp_path / "frames.usdc", "-o", tmp_path / "own.fpnr", "--steps", 20, "--no-encoder", "--json")
    out = done(capsys, "neural-rig", *words)
    assert json.loads(out)["source"] == "samples"
    assert {control.name for control in load_neural_rig(tmp_path / "own.fpnr").controls} == {
        control.name for control in own.rig.controls
    }


def test_what_can_not_be_baked_gives_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    head, bare, other = tmp_path / "head.usda", tmp_path / "bare.usda", tmp_path / "other.usda"
    save_parts(turning_face(), head)
    still = tuple(replace(mesh, blendshapes=()) for mesh in turning_face().meshes)
    save_parts(replace(turning_face(), sliders=(), meshes=still), bare)
    Usd.Stage.CreateNew(str(other)).Save()
    for words, message in (
        ((bare,), "bare.usda: has neither sliders nor shapes"),
        ((head, "--clip", other), "other.usda: moves nothing, expected some of look, open"),
        ((head, "--spread", 0, "--sweep", 0, "--together", 0), "no frame, expected some"),
        ((head, "--busy", 2), "busy"),
        ((tmp_path / "none.usda",), "none.usda"),
    ):
        assert message in failed(capsys, "bake", *words, "-o", tmp_path / "frames.usdc", folder=tmp_path)
    (tmp_path / "frames.usdc").write_bytes(b"mine")
    code, _, err = run(capsys, "bake", head, "-o", tmp_path / "frames.usdc", *FEW)
    assert (code, "expected a new file (or --force)" in err) == (2, True)
    assert (tmp_path / "frames.usdc").read_bytes() == b"mine"


def moved(path: Path, frames: Motion, *, every: int = 1) -> Path:
    """A face whose skeleton plays frames of its sliders and shapes, with its sliders as numbers."""
    parts = turning_face()
    joints, coefficients, weights = parts.skeleton.joints, [], []
    names = [control.name for control in frames.controls]
    for row in frames.values:
        values = dict(zip(names, row.tolist(), strict=True))
        own, _ = slide(parts.sliders, joints, {name: values[name] for name in ("open", "look")})
        coefficients.append(own)
        weights.append([values["jawOpen"], values["smile"]])
    clip = Animation(
        name="rom",
        times=np.arange(len(frames.values)) / 24.0,
        joints=joints,
        coefficients=np.array(coefficients),
        shapes=("jawOpen", "smile"),
        shape_weights=np.array(weights),
    )
    save_parts(replace(parts, animations=(clip,)), path)
    stage = Usd.Stage.Open(str(path))
    prim = stage.DefinePrim("/Controls")
    for name, column in zip(names, frames.values.T, strict=True):
        number = prim.CreateAttribute(f"facepipe:control:{name}", Sdf.ValueTypeNames.Double)
        number.Set(0.0)
        for code, value in list(enumerate(column.tolist()))[::every]:
            number.Set(value, float(code))
    stage.Save()
    return path


@pytest.fixture(scope="module")
def frames() -> Motion:
    options = SampleMotionOptions(spread=60, sweep=5, together=20)
    return SampleMotion(options=options)(turning_face(), "head.usda")


def test_a_face_that_an_animation_moves_is_frames_with_bones(frames: Motion, tmp_path: Path) -> None:
    path = moved(tmp_path / "head.usda", frames)
    assert is_recorded(path)
    found = ReadMotion(options=WHOLE)(path)
    assert np.allclose(ordered(found, frames), frames.values, atol=1e-6)
    assert np.abs(found.points - frames.points).max() < 1e-3
    assert found.coefficients is not None
    assert frames.coefficients is not None
    assert np.abs(found.coefficients - frames.coefficients).max() < 1e-4
    to = world_to_world(turning_face().meters_per_unit, turning_face().up_axis, MILLIMETRES)
    judged = played(path, [0.0, 7 / 24.0], animation="rom") @ to[:3, :3].T
    height = np.ptp(found.rest)
    assert np.abs(judged - found.points[[0, 7]]).max() < 2e-3 * height  # SkelAnimation rounds scales to half


@pytest.mark.needs_torch
@pytest.mark.slow
def test_rigs_are_learned_from_faces_that_an_animation_moves(
    frames: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = moved(tmp_path / "head.usda", frames)
    words = ("--steps", 200, "--width", 16, "--block", 4, "--margin", 0, "--no-encoder", "--json")
    out = done(capsys, "neural-rig", "train", path, "-o", tmp_path / "head.fpnr", *words)
    report, rig = json.loads(out), load_neural_rig(tmp_path / "head.fpnr")
    assert (report["source"], report["frames"] + report["held_out"]) == ("samples", len(frames.values))
    assert rig.bones is not None
    assert report["error_mean_mm"] < 0.1 * report["motion_mean_mm"]
    words = ("--frames", path, "-o", tmp_path / "again.fpnr", "--json")
    out = done(capsys, "neural-rig", "retarget", tmp_path / "head.fpnr", path, *words)
    assert json.loads(out)["controls"] == "given"
    assert json.loads(out)["error_mean_mm"] < 0.1 * report["motion_mean_mm"]


def test_a_control_is_guessed_only_between_samples_that_differ() -> None:
    track = ControlTrack(name="open", where="", codes=np.array([0.0, 2, 4, 6]), values=np.array([0.0, 1, 1, 3]))
    codes = np.array([-1.0, 0, 1, 2, 3, 4, 5, 6, 7])
    assert track.at(codes).tolist() == [0, 0, 0.5, 1, 1, 1, 2, 3, 3]
    assert codes[track.guessed(codes)].tolist() == [1, 5]


def test_controls_between_samples_of_the_animation_are_not_guessed(frames: Motion, tmp_path: Path) -> None:
    path = moved(tmp_path / "head.usda", frames, every=2)
    with pytest.raises(InputError, match=r"time code \d+: no sample, between two that differ"):
        ReadMotion()(path)
    still = turning_face()
    save_parts(still, tmp_path / "still.usda")
    stage = Usd.Stage.Open(str(tmp_path / "still.usda"))
    number = stage.DefinePrim("/Controls").CreateAttribute("facepipe:control:open", Sdf.ValueTypeNames.Double)
    number.Set(0.0, 1.0)
    number.Set(1.0, 2.0)
    stage.Save()
    with pytest.raises(InputError, match="or a face that a SkelAnimation moves over time"):
        ReadMotion()(tmp_path / "still.usda")
