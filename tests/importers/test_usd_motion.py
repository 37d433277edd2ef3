"""Stages whose prims or points move: every point where USD has it at every sample, and between."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faces import clipped_face, replace_mesh
from foreign_stages import foreign_stage, read, rich_face, warned, written
from oracle import played
from pxr import Gf, Usd, UsdGeom, UsdSkel

from facepipe.core.errors import InputError, TopologyError
from facepipe.parts import FaceParts
from facepipe.rig.animation import at_times, sample_transforms, sample_weights
from facepipe.stage import Face, foreign_motion

RATE = 24.0


def moved(stage: Usd.Stage, path: str, op: str, samples: dict[float, object]) -> None:
    """A transform over time on a prim, above what it has."""
    xform = UsdGeom.Xformable(stage.GetPrimAtPath(path))
    before = xform.GetOrderedXformOps()
    ops = {"translate": xform.AddTranslateOp, "rotate": xform.AddRotateYOp, "scale": xform.AddScaleOp}
    made = ops[op](opSuffix="moves")
    for code, value in samples.items():
        made.Set(value, code)
    xform.SetXformOpOrder([made, *before])


def truth(path: Path, code: float, name: str) -> np.ndarray:
    """(n, 3) world points of an unskinned mesh at a time, by USD alone."""
    stage = Usd.Stage.Open(str(path))
    prim = next(one for one in stage.Traverse() if one.IsA(UsdGeom.Mesh) and one.GetName() == name)
    points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(code), float)
    world = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(code)).T
    return points @ world[:3, :3].T + world[:3, 3]


def shown(parts: FaceParts, seconds: float) -> dict[str, np.ndarray]:
    """Points of each mesh of the face as it plays, at one of the clip's samples."""
    face = Face.from_parts(parts)
    clip = next(one for one in parts.animations if one.name == parts.played)
    index = int(np.argmin(np.abs(np.asarray(clip.times) - seconds)))
    assert abs(np.asarray(clip.times)[index] - seconds) < 1e-9
    local, weights = face.sample(clip.name, index)
    return face.split(face.evaluate(weights, joint_transforms=local))


def test_an_unskinned_mesh_that_turns_and_its_neighbour_below_it(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    stage.SetTimeCodesPerSecond(RATE)
    moved(stage, "/Rich/Teeth", "rotate", {0: 0.0, 12: 30.0, 24: -20.0})
    path = written(stage, tmp_path / "face.usda")
    imported = read(path)
    warned(imported, "</Rich/Teeth>: what moves over time hangs on joints of its own")
    for code in (0, 12, 24):
        np.testing.assert_allclose(shown(imported.parts, code / RATE)["Teeth"], truth(path, code, "Teeth"), atol=1e-5)


def test_the_root_of_a_played_face_that_travels(tmp_path: Path) -> None:
    """Joints, shapes and the root's transform together, against UsdSkel."""
    stage = foreign_stage(replace(clipped_face(), name="Rich"))
    stage.SetTimeCodesPerSecond(RATE)
    moved(stage, "/Rich", "translate", {0: Gf.Vec3d(0, 0, 0), 6: Gf.Vec3d(1, 0.5, -2)})
    path = written(stage, tmp_path / "face.usda")
    imported = read(path)
    warned(imported, "</Rich>: its motion over time is that of the root joints")
    clip = next(one for one in imported.parts.animations if one.name == imported.parts.played)
    assert clip.times is not None
    for seconds, expected in zip(clip.times, played(path, clip.times), strict=True):
        got = np.concatenate([*shown(imported.parts, float(seconds)).values()])
        np.testing.assert_allclose(got, expected, atol=2e-5)


def between(parts: FaceParts, seconds: float) -> dict[str, np.ndarray]:
    """Points of each mesh of the face as it plays, at any time."""
    clip = next(one for one in parts.animations if one.name == parts.played)
    there = at_times(parts.skeleton, clip, np.array([seconds]))
    face, local = Face.from_parts(parts), sample_transforms(parts.skeleton, there)
    return face.split(face.evaluate(sample_weights(there), joint_transforms=local))


@pytest.mark.parametrize("turn", [200.0, 360.0, -720.0])
def test_whole_turns_between_two_samples(turn: float, tmp_path: Path) -> None:
    """USD is linear in the angle: a turntable ends where it began, and is not still."""
    stage = foreign_stage(rich_face())
    stage.SetTimeCodesPerSecond(RATE)
    moved(stage, "/Rich/Teeth", "rotate", {0: 0.0, 48: turn})
    path = written(stage, tmp_path / "face.usda")
    parts = read(path).parts
    reach = float(np.abs(truth(path, 0, "Teeth")).max())
    for code in (0, 7.3, 24, 31, 48):
        expected = truth(path, code, "Teeth")
        np.testing.assert_allclose(between(parts, code / RATE)["Teeth"], expected, atol=2e-3 * reach)


def test_a_root_that_turns_while_its_skeleton_plays(tmp_path: Path) -> None:
    """Between samples too, where a turn times a turn is no line."""
    stage = foreign_stage(replace(clipped_face(), name="Rich"))
    stage.SetTimeCodesPerSecond(RATE)
    moved(stage, "/Rich", "rotate", {0: 0.0, 12: 300.0})
    path = written(stage, tmp_path / "face.usda")
    parts = read(path).parts
    times = np.array([0.0, 0.11, 0.27, 0.5])
    for seconds, expected in zip(times, played(path, times), strict=True):
        got = np.concatenate([*between(parts, float(seconds)).values()])
        np.testing.assert_allclose(got, expected, atol=2e-3 * float(np.abs(expected).max()))


def test_more_turns_than_are_kept_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foreign_motion, "_MOST_BETWEEN", 300)
    stage = foreign_stage(rich_face())
    moved(stage, "/Rich/Teeth", "rotate", {0: 0.0, 48: 360.0})
    warned(read(written(stage, tmp_path / "face.usda")), "turn more between their samples than is kept")


@pytest.mark.parametrize("path", ["/Rich", "/Rich/Teeth"])
def test_what_grows_from_nothing(path: str, tmp_path: Path) -> None:
    """At rest it is flat, and has no inverse."""
    stage = foreign_stage(replace(clipped_face(), name="Rich"))
    stage.SetTimeCodesPerSecond(RATE)
    moved(stage, path, "scale", {0: Gf.Vec3f(0), 6: Gf.Vec3f(1, 0, 0.5), 12: Gf.Vec3f(1)})
    file = written(stage, tmp_path / "face.usda")
    parts = read(file).parts
    assert all(abs(np.linalg.det(mesh.transform)) > 1e-9 for mesh in parts.meshes)  # or no exporter would take them
    times = np.array([0.0, 0.11, 0.25, 0.5])
    for seconds, expected in zip(times, played(file, times), strict=True):
        got = np.concatenate([*between(parts, float(seconds)).values()])
        np.testing.assert_allclose(got, expected, atol=1e-3)


def test_scales_beyond_half_precision(tmp_path: Path) -> None:
    """They are read without a word of numpy's; who authors them is told that USD can't hold them."""
    stage = foreign_stage(rich_face())
    moved(stage, "/Rich/Teeth", "scale", {0: Gf.Vec3f(1), 6: Gf.Vec3f(1e5)})
    path = written(stage, tmp_path / "face.usda")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (clip,) = read(path).parts.animations
    assert np.asarray(clip.scales).max() > 65520


def test_a_skeleton_that_stays_flat_is_refused(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    UsdGeom.Xformable(stage.GetPrimAtPath("/Rich")).AddScaleOp(opSuffix="flat").Set(Gf.Vec3f(1, 1, 0))
    with pytest.raises(TopologyError, match="Skeleton: singular or non-finite matrix"):
        read(written(stage, tmp_path / "face.usda"))
    moved(stage, "/Rich", "translate", {0: Gf.Vec3d(0, 0, 0), 6: Gf.Vec3d(1, 0.5, -2)})
    with pytest.raises(InputError, match="flat at all times"):
        read(written(stage, tmp_path / "moving.usda"))


def test_a_skeleton_without_joints_may_move(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    skeleton = UsdSkel.Skeleton(next(one for one in stage.Traverse() if one.IsA(UsdSkel.Skeleton)))
    for attribute in (skeleton.GetJointsAttr(), skeleton.GetBindTransformsAttr(), skeleton.GetRestTransformsAttr()):
        attribute.Clear()
    head = stage.GetPrimAtPath("/Rich/Head")
    for one in head.GetAuthoredProperties():
        if "skel:joint" in one.GetName():
            head.RemoveProperty(one.GetName())
    moved(stage, "/Rich", "translate", {0: Gf.Vec3d(0, 0, 0), 6: Gf.Vec3d(1, 0.5, -2)})
    parts = read(written(stage, tmp_path / "face.usda")).parts
    assert any(joint.endswith("Rich") for joint in parts.skeleton.joints)


def test_shear_over_time_is_named(tmp_path: Path) -> None:
    """USD mixes matrices number by number: half way between two turns lies no turn."""
    stage = foreign_stage(rich_face())
    op = UsdGeom.Xformable(stage.GetPrimAtPath("/Rich/Teeth")).AddTransformOp(opSuffix="moves")
    op.Set(Gf.Matrix4d(1.0), 0)
    op.Set(Gf.Matrix4d(1.0).SetRotate(Gf.Rotation(Gf.Vec3d(0, 1, 0), 100.0)), 10)
    UsdGeom.Xformable(stage.GetPrimAtPath("/Rich")).AddTranslateOp().Set(Gf.Vec3d(0, 0, 1), 5)
    scaled = UsdGeom.Xformable(stage.GetPrimAtPath("/Rich")).AddScaleOp()
    scaled.Set(Gf.Vec3f(1, 2, 1), 0)
    scaled.Set(Gf.Vec3f(1, 1, 2), 10)
    warned(read(written(stage, tmp_path / "face.usda")), "transforms over time shear what they move")


def test_a_value_at_one_time_is_there_at_all_times(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    attribute = UsdGeom.Mesh(stage.GetPrimAtPath("/Rich/Teeth")).GetPointsAttr()
    attribute.Set((np.array(attribute.Get()) + 1).astype(np.float32), 7)
    path = written(stage, tmp_path / "face.usda")
    (teeth,) = (mesh for mesh in read(path).parts.meshes if mesh.name == "Teeth")
    place = np.asarray(teeth.transform)
    np.testing.assert_allclose(teeth.points @ place[:3, :3].T + place[:3, 3], truth(path, 0, "Teeth"), atol=1e-5)


def test_points_over_time_are_shapes_and_a_clip(tmp_path: Path) -> None:
    parts = rich_face()
    stage = foreign_stage(replace(parts, meshes=(replace_mesh(parts.meshes[1], blendshapes=()),)))
    stage.SetTimeCodesPerSecond(RATE)
    prim = next(one for one in stage.Traverse() if one.IsA(UsdGeom.Mesh))
    attribute = UsdGeom.Mesh(prim).GetPointsAttr()
    base, rng = np.array(attribute.Get()), np.random.default_rng(0)
    for code in (1, 3, 4, 9):
        attribute.Set((base + rng.normal(size=base.shape) * 0.1).astype(np.float32), code)
    path = written(stage, tmp_path / "face.usda")
    imported = read(path)
    warned(imported, "4 samples of points over time are ")
    for code in (1, 3, 4, 9):
        np.testing.assert_allclose(shown(imported.parts, code / RATE)["Teeth"], truth(path, code, "Teeth"), atol=1e-5)
    clip = next(one for one in imported.parts.animations if one.name == imported.parts.played)
    weights = np.asarray(clip.shape_weights)
    between = {name: float(value) for name, value in zip(clip.shapes, (weights[2] + weights[3]) / 2, strict=True)}
    face = Face.from_parts(imported.parts)
    np.testing.assert_allclose(face.split(face.evaluate(between))["Teeth"], truth(path, 6.5, "Teeth"), atol=1e-5)


def test_more_points_over_time_than_shapes_are_named(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    prim = stage.GetPrimAtPath("/Rich/Teeth")
    attribute = UsdGeom.Mesh(prim).GetPointsAttr()
    base = np.array(attribute.Get())
    for code in range(600):
        attribute.Set((base + code).astype(np.float32), code)
    warned(read(written(stage, tmp_path / "face.usdc")), "points change over time: one value is kept")


def test_samples_of_several_meshes_that_are_too_many_together_are_named(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    for number, name in enumerate(("Head", "Teeth")):
        attribute = UsdGeom.Mesh(stage.GetPrimAtPath(f"/Rich/{name}")).GetPointsAttr()
        base = np.array(attribute.Get())
        for code in range(300):
            attribute.Set((base + code).astype(np.float32), 300 * number + code)
    imported = read(written(stage, tmp_path / "face.usdc"))
    warned(imported, "Head, Teeth: points over time are too many together")


def test_samples_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    attribute = UsdGeom.Mesh(stage.GetPrimAtPath("/Rich/Teeth")).GetPointsAttr()
    base = np.array(attribute.Get())
    for code, first in enumerate((0.0, np.nan)):
        base = base.copy()
        base[0] = first
        attribute.Set(base, code)
    parts = read(written(stage, tmp_path / "face.usdc")).parts
    with pytest.raises(InputError, match="offsets: NaN or infinity, expected finite numbers"):
        Face.from_parts(parts)


def test_more_than_memory_is_refused(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    xform = UsdGeom.Xformable(stage.GetPrimAtPath("/Rich"))
    op = xform.AddTranslateOp(opSuffix="moves")
    for code in range(3000):
        op.Set(Gf.Vec3d(code, 0, 0), code)
    for number in range(1500):
        UsdGeom.Mesh.Define(stage, f"/Rich/M{number}")
    with pytest.raises(InputError, match="numbers of transforms and points over time"):
        read(written(stage, tmp_path / "face.usdc"))


def test_every_root_joint_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each gets a track of its own, with samples between those of the transform above."""
    stage = foreign_stage(rich_face())
    skeleton = UsdSkel.Skeleton(next(one for one in stage.Traverse() if one.IsA(UsdSkel.Skeleton)))
    joints = [*skeleton.GetJointsAttr().Get(), *(f"more{number}" for number in range(60))]
    skeleton.GetJointsAttr().Set(joints)
    for attribute in (skeleton.GetBindTransformsAttr(), skeleton.GetRestTransformsAttr()):
        attribute.Set([*attribute.Get(), *[Gf.Matrix4d(1.0)] * 60])
    moved(stage, "/Rich", "rotate", {float(code): 100.0 * code for code in range(10)})
    path = written(stage, tmp_path / "face.usda")
    monkeypatch.setattr(foreign_motion, "_MOST_BETWEEN", 40_000)
    imported = read(path)
    warned(imported, "turn more between their samples than is kept")
    assert len(np.asarray(imported.parts.animations[-1].times)) < 40
    monkeypatch.setattr(foreign_motion, "_MOST_NUMBERS", 16 * 10 * 60)
    with pytest.raises(InputError, match="numbers of transforms"):
        read(path)


def test_joints_with_dots(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    skeleton = UsdSkel.Skeleton(next(one for one in stage.Traverse() if one.IsA(UsdSkel.Skeleton)))
    joints = [str(joint).replace("/", "/b.") for joint in skeleton.GetJointsAttr().Get()]
    skeleton.GetJointsAttr().Set(joints)
    parts = read(written(stage, tmp_path / "face.usda")).parts
    assert parts.skeleton.names == tuple(joint.rpartition("/")[2] for joint in joints)
