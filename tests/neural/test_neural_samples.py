"""Frames of rigs from stages: what is read, how it is cut into blocks, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scan_domes
from baked_frames import bake
from command_line import done, failed
from neural_training import chewing_face
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from facepipe.core.errors import FacepipeError, InputError
from facepipe.neural import (
    FrameBlocksOptions,
    Motion,
    ReadMotion,
    SampleMotion,
    SampleMotionOptions,
    TrainNeuralRig,
    TrainNeuralRigOptions,
)
from facepipe.neural.motion import frame_blocks
from facepipe.stage import open_face, save_parts
from facepipe.verbs.whole_faces import Topology, whole_points

FEW = SampleMotionOptions(spread=12, sweep=5, together=10)
Change = Callable[[Usd.Stage], object]


@pytest.fixture(scope="module")
def sampled() -> Motion:
    return SampleMotion(options=FEW)(chewing_face(), "head.usda")


def changed(path: Path, change: Change) -> Path:
    stage = Usd.Stage.Open(str(path))
    change(stage)
    stage.Save()
    return path


def test_a_rig_baked_to_a_stage_and_read_back_is_the_same_motion(sampled: Motion, tmp_path: Path) -> None:
    found = ReadMotion()(bake(sampled, tmp_path / "rom.usdc"))
    assert found.source == "samples"
    assert found.controls == sampled.controls
    assert np.array_equal(found.values, sampled.values)
    assert np.array_equal(found.points, sampled.points)
    assert np.array_equal(found.blocks, sampled.blocks)
    assert np.allclose(found.rest, sampled.rest, atol=1e-4)
    assert found.topology.digest == sampled.topology.digest == Topology.of(chewing_face()).digest


def test_units_axes_and_transforms_of_the_stage_are_honoured(sampled: Motion, tmp_path: Path) -> None:
    """Decimetres, Z up, and a root that moves: world points are what counts."""

    def turned(stage: Usd.Stage) -> None:
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 0.1)
        root = UsdGeom.Xform.Get(stage, "/Rig")
        root.AddScaleOp().Set(Gf.Vec3f(0.01))
        root.AddRotateXOp().Set(90.0)

    found = ReadMotion()(changed(bake(sampled, tmp_path / "rom.usdc"), turned))
    assert np.allclose(found.points, sampled.points, atol=1e-4)
    assert np.allclose(found.rest, sampled.rest, atol=1e-4)


def test_points_that_transforms_move_are_frames_too(sampled: Motion, tmp_path: Path) -> None:
    def slid(stage: Usd.Stage) -> None:
        move = UsdGeom.Xform.Get(stage, "/Rig").AddTranslateOp()
        for code in UsdGeom.Mesh.Get(stage, "/Rig/Head").GetPointsAttr().GetTimeSamples():
            move.Set(Gf.Vec3d(code, 0, 0), code)

    plain = bake(sampled, tmp_path / "rom.usdc")
    found = ReadMotion()(changed(plain, slid))
    codes = np.arange(len(sampled.values)) + 3.0 * sampled.blocks
    assert np.allclose(found.points - sampled.points, codes[:, None, None] * [1.0, 0.0, 0.0], atol=1e-3)


def test_a_face_keeps_its_sliders_and_shapes(tmp_path: Path) -> None:
    """Sliders by their own range, the shapes that no slider drives, and points as its skin places them."""
    path, codes = tmp_path / "head.usda", [1.0, 2.0, 3.0]
    save_parts(chewing_face(), path)
    points = np.asarray(chewing_face().meshes[0].points, np.float32)

    def animated(stage: Usd.Stage) -> None:
        root = stage.GetDefaultPrim()
        value = root.GetAttribute("facepipe:slider:chew:value")
        mesh = UsdGeom.Mesh.Get(stage, f"{root.GetPath()}/Head").GetPointsAttr()
        weights = UsdSkel.Animation.Define(stage, "/Clip")
        weights.CreateBlendShapesAttr(["jawOpen", "smile"])
        for code, amount in zip(codes, (0.0, 0.5, 1.0), strict=True):
            value.Set(amount - 0.25, code)
            weights.CreateBlendShapeWeightsAttr().Set(Vt.FloatArray([0.5 * amount, amount]), code)
            mesh.Set(Vt.Vec3fArray.FromNumpy(points + np.float32(amount)), code)

    found = ReadMotion()(changed(path, animated))
    assert [(control.name, control.minimum, control.maximum) for control in found.controls] == [
        ("chew", -0.5, 1.0),
        ("smile", 0.0, 1.0),
    ]
    assert np.array_equal(found.values, [[-0.25, 0.0], [0.25, 0.5], [0.75, 1.0]])
    head = slice(0, len(points))
    assert np.allclose(found.rest, whole_points(chewing_face()), atol=1e-4)
    for frame, amount in enumerate((0.0, 0.5, 1.0)):
        moved = whole_points(chewing_face())
        moved[head] += 10.0 * amount  # of centimetres
        assert np.allclose(found.points[frame], moved, atol=1e-4)
    assert found.topology.digest == Topology.of(open_face(path).parts()).digest


def test_limits_defaults_and_names_of_controls(sampled: Motion, tmp_path: Path) -> None:
    """Of numbers of a prim: declared limits, else how far they go; the value without time, else the first."""

    def controls(stage: Usd.Stage) -> None:
        prim = stage.DefinePrim("/Rig/Panel")
        codes = UsdGeom.Mesh.Get(stage, "/Rig/Head").GetPointsAttr().GetTimeSamples()
        for name in ("userProperties:brow", "facepipe:control:lid", "blink"):
            own = prim.CreateAttribute(name, Sdf.ValueTypeNames.Float)
            for number, code in enumerate(codes):
                own.Set(float(number) + 1.0, code)
        prim.GetAttribute("blink").Set(-3.0)
        prim.GetAttribute("userProperties:brow").SetCustomDataByKey("maximum", 500)
        prim.CreateAttribute("note", Sdf.ValueTypeNames.String).Set("no number")

    path = changed(bake(sampled, tmp_path / "rom.usdc"), controls)
    found = ReadMotion(prims=["/Rig/Panel"])(path)
    last = float(len(sampled.values))
    got = {control.name: (control.minimum, control.maximum, control.default) for control in found.controls}
    assert got == {"brow": (1.0, 500.0, 1.0), "lid": (1.0, last, 1.0), "blink": (-3.0, last, -3.0)}


def test_what_sparse_writers_leave_out_is_held(sampled: Motion, tmp_path: Path) -> None:
    """Samples that repeat the one before and the one after them carry nothing."""
    frames = np.flatnonzero(sampled.blocks < 2)
    motion = sampled.frames(np.concatenate([[frames[0]] * 4, frames, [frames[-1]] * 4]))
    motion = replace(motion, blocks=np.zeros(len(motion.values), int))

    def sparse(stage: Usd.Stage) -> None:
        for attribute in (
            *(UsdGeom.Mesh.Get(stage, f"/Rig/{name}").GetPointsAttr() for name in motion.topology.names),
            *(stage.GetPrimAtPath("/Rig").GetAttribute(f"facepipe:control:{one.name}") for one in motion.controls),
        ):
            codes = attribute.GetTimeSamples()
            values = [attribute.Get(code) for code in codes]
            for number in range(1, len(codes) - 1):
                if values[number - 1] == values[number] == values[number + 1]:
                    attribute.ClearAtTime(codes[number])

    whole = ReadMotion()(bake(motion, tmp_path / "whole.usdc"))
    found = ReadMotion()(changed(bake(motion, tmp_path / "sparse.usdc"), sparse))
    assert len(found.values) < len(whole.values)
    assert set(found.blocks.tolist()) == {0}
    assert np.array_equal(np.unique(found.values, axis=0), np.unique(whole.values, axis=0))
    for row, points in zip(found.values, found.points, strict=True):
        same = np.flatnonzero((whole.values == row).all(axis=1))[0]
        assert np.allclose(points, whole.points[same], rtol=1e-6)  # USD rounds between two equal samples


def test_blocks_of_a_long_clip_are_apart_and_gaps_end_clips() -> None:
    codes = np.concatenate([np.arange(100.0), 110.0 + np.arange(7.0), [130.0]])
    values = codes[:, None]
    kept, blocks = frame_blocks(codes, values, FrameBlocksOptions(block=20, margin=3))
    assert blocks.tolist() == sorted(blocks.tolist())
    clip = kept[blocks < 5]
    assert np.bincount(blocks).tolist() == [20, 17, 17, 17, 17, 7, 1]
    for one in range(5):
        for other in range(one):
            assert np.abs(np.subtract.outer(clip[blocks[:88] == one], clip[blocks[:88] == other])).min() > 3
    held, same = frame_blocks(codes, np.zeros((len(codes), 1)), FrameBlocksOptions(block=200, margin=3))
    assert (len(held), same.max()) == (len(codes), 0)
    seconds, by_second = frame_blocks(codes * 1000.0, values, FrameBlocksOptions(block=20, margin=3))
    assert np.array_equal(kept, seconds)
    assert np.array_equal(blocks, by_second)
    with pytest.raises(InputError, match="option margin: is 10, expected less than half of block 20"):
        FrameBlocksOptions(block=20, margin=10)


def _points(change: Callable[[np.ndarray], np.ndarray], code: float) -> Change:
    def apply(stage: Usd.Stage) -> None:
        points = UsdGeom.Mesh.Get(stage, "/Rig/Eye").GetPointsAttr()
        points.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(change(np.array(points.Get(code))))), code)

    return apply


def _control(change: Callable[[Usd.Attribute], object], name: str = "smile") -> Change:
    return lambda stage: change(stage.GetPrimAtPath("/Rig").GetAttribute(f"facepipe:control:{name}"))


def _without_controls(stage: Usd.Stage) -> None:
    for name in ("chew", "smile"):
        stage.GetPrimAtPath("/Rig").RemoveProperty(f"facepipe:control:{name}")


def _still(stage: Usd.Stage) -> None:
    for name in ("Head", "Eye"):
        points = UsdGeom.Mesh.Get(stage, f"/Rig/{name}").GetPointsAttr()
        for code in points.GetTimeSamples():
            points.ClearAtTime(code)


def _one_frame(stage: Usd.Stage) -> None:
    prim = stage.GetPrimAtPath("/Rig")
    for attribute in (
        *(UsdGeom.Mesh.Get(stage, f"/Rig/{name}").GetPointsAttr() for name in ("Head", "Eye")),
        *(prim.GetAttribute(f"facepipe:control:{name}") for name in ("chew", "smile")),
    ):
        for code in attribute.GetTimeSamples()[1:]:
            attribute.ClearAtTime(code)


def _no_rest(stage: Usd.Stage) -> None:
    for name in ("Head", "Eye"):
        UsdGeom.Mesh.Get(stage, f"/Rig/{name}").GetPointsAttr().ClearDefault()
    stage.GetPrimAtPath("/Rig").GetAttribute("facepipe:control:chew").Set(0.1234)


def _two_clips(stage: Usd.Stage) -> None:
    _without_controls(stage)
    for name in ("One", "Two"):
        weights = UsdSkel.Animation.Define(stage, f"/{name}")
        weights.CreateBlendShapesAttr(["smile"])
        weights.CreateBlendShapeWeightsAttr().Set(Vt.FloatArray([0.0]), 1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_points(lambda one: one[:-1], 2.0), r"Eye>?: \d+ points at a time sample, .*\(time code 2\)"),
        (_points(lambda one: np.where(one == one[3], np.nan, one), 2.0), "Eye: points hold NaN .* at time code 2,"),
        (_control(lambda one: one.Set(float("nan"), 3.0)), "control:smile: NaN or infinity at time code 3, expected"),
        (_control(lambda one: one.Set(5.0, 3.0)), "-> smile: 5 in frame 3, expected 0 to 1"),
        (_control(lambda one: one.Set(-5.0)), "control:smile: default -5, expected 0 to 1"),
        (_control(lambda one: one.SetCustomDataByKey("minimum", 2.0)), "control:smile: from 2 to 1, expected a range"),
        (_control(lambda one: one.SetCustomDataByKey("minimum", "low")), "control:smile: limit low, expected a finite"),
        (
            _control(lambda one: one.ClearAtTime(2.0), "chew"),
            "control:chew -> time code 2: no sample, between two that differ, expected controls and points sampled at",
        ),
        (
            lambda stage: UsdGeom.Mesh.Get(stage, "/Rig/Head").GetPointsAttr().ClearAtTime(10.0),
            "Head -> time code 10: no sample, between two that differ",
        ),
        (
            _control(lambda one: one.Set(0.5, 2.5)),
            "-> (chew|Head|Eye|/Rig.*) -> time code 2.5: no sample, between two that differ",
        ),
        (
            _points(lambda one: one, 900.0),
            "controls -> time code 900: sampled from 0 to .* only, expected controls and points",
        ),
        (_control(lambda one: one.Set(0.5, -7.0)), "points -> time code -7: sampled from 0 to .* only"),
        (_without_controls, "rom.usda: no control with time samples, expected facepipe:control:<name>, sliders"),
        (_still, "rom.usda: no point cache, expected meshes whose points have time samples"),
        (_one_frame, "rom.usda: one frame, expected several"),
        (_no_rest, "rom.usda: no frame with all controls at their defaults, and no points without time"),
        (_two_clips, "One, Two: 2 SkelAnimations with weights over time, expected one"),
        (
            lambda stage: (
                stage.GetPrimAtPath("/Rig").CreateAttribute("facepipe:control:note", Sdf.ValueTypeNames.String).Set("a")
            ),
            "control:note: type string, expected a number",
        ),
    ],
)
def test_stages_that_do_not_fit_give_one_line(sampled: Motion, tmp_path: Path, change: Change, message: str) -> None:
    path = changed(bake(sampled, tmp_path / "rom.usda"), change)
    with pytest.raises(FacepipeError, match=message) as caught:
        ReadMotion()(path)
    assert "rom.usda" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_prims_that_have_no_controls_are_reported(sampled: Motion, tmp_path: Path) -> None:
    path = bake(sampled, tmp_path / "rom.usda")
    for prim, message in (
        ("/Rig/Eye", "no custom attribute that is a number"),
        ("Rig", "no such prim"),
        ("/", "no cu"),
    ):
        with pytest.raises(InputError, match=message):
            ReadMotion(prims=[prim])(path)


@pytest.mark.needs_torch
def test_controls_that_never_move_are_left_out_and_only_those_are_an_error(tmp_path: Path, sampled: Motion) -> None:
    still = sampled.frames(np.flatnonzero(sampled.values[:, 1] == 0.0))
    found = ReadMotion()(bake(still, tmp_path / "rom.usdc"))
    assert found.constant == ("smile",)
    none = sampled.frames(np.zeros(8, int))
    none = replace(none, blocks=np.arange(8), points=none.points + np.arange(8, dtype=np.float32)[:, None, None])
    with pytest.raises(InputError, match="no control moves in any frame"):
        TrainNeuralRig()(ReadMotion()(bake(none, tmp_path / "none.usdc")))


@pytest.mark.needs_torch
def test_training_from_a_stage_is_training_from_the_rig_itself(tmp_path: Path) -> None:
    motion = SampleMotion(options=SampleMotionOptions(spread=60, sweep=5, together=30))(chewing_face(), "head.usda")
    options = TrainNeuralRigOptions(width=8, steps=200)
    own = TrainNeuralRig(options=options)(replace(motion, bones=None, coefficients=None)).report
    read = TrainNeuralRig(options=options)(ReadMotion()(bake(motion, tmp_path / "rom.usdc"))).report
    assert (read.source, own.source) == ("samples", "rig")
    assert (read.frames, read.held_out) == (own.frames, own.held_out)
    for name in ("motion_mean_mm", "error_mean_mm", "error_max_mm", "linear_mean_mm", "linear_max_mm"):
        assert getattr(read, name) == pytest.approx(getattr(own, name), rel=1e-3)


@pytest.mark.needs_torch
def test_the_command_takes_either_kind_of_stage(
    sampled: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    head, rom = tmp_path / "head.usda", bake(sampled, tmp_path / "rom.usdc")
    save_parts(replace(scan_domes.face(), animations=()), head)
    few = (
        "--spread",
        20,
        "--sweep",
        3,
        "--together",
        5,
        "--width",
        4,
        "--steps",
        50,
        "--no-encoder",
        "--json",
        "--force",
    )
    for data, more, source in (
        (head, (), "rig"),
        (rom, (), "samples"),
        (rom, ("--controls", "/Rig", "--block", 10), "samples"),
    ):
        out = done(capsys, "neural-rig", "train", data, "-o", tmp_path / "a.fpnr", *few, *more)
        assert json.loads(out)["source"] == source
    for data, more, message in (
        (head, ("--source", "samples"), "head.usda: no control with time samples"),
        (rom, ("--source", "rig"), "no prim with FacepipeFaceAPI"),
        (head, ("--source", "rig", "--controls", "/A"), "--controls: given with --source rig"),
    ):
        err = failed(capsys, "neural-rig", "train", data, "-o", tmp_path / "a.fpnr", *few, *more, folder=tmp_path)
        assert message in err
