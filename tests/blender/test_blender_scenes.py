"""Scenes of Blender as artists leave them: several faces, edit mode, hidden objects, scales, relative keys."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from blender_python import blender, needs_blender
from pxr import Usd

from facepipe.checks import validate
from facepipe.hosting.host_face import Face, faces_on

pytestmark = [pytest.mark.gate, pytest.mark.slow, needs_blender]

Scenes = tuple[Path, dict[str, np.ndarray], str]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Scenes:
    """Folder of the files, what Blender shows, and what it says."""
    folder = tmp_path_factory.mktemp("scenes")
    return folder, *blender("scenes.py", folder, answer=tmp_path_factory.mktemp("answer") / "a.npz")


def faces(folder: Path, name: str) -> tuple[Face, ...]:
    """The faces of a scene, that of the default prim first."""
    return faces_on(Usd.Stage.Open(str(folder / f"{name}.usda")))


def off(face: Face, shown: np.ndarray, weights: dict[str, float]) -> float:
    """The largest distance between a face of one mesh and what Blender shows, in the world."""
    place = face.skeleton.transform if face.skeleton.joints else face.meshes[0].transform
    points = face.evaluate(weights) @ place[:3, :3].T + place[:3, 3]
    return float(np.abs(points - shown).max())


def test_several_faces_on_one_stage(scenes: Scenes) -> None:
    folder, shown, _ = scenes
    found = faces(folder, "several")
    assert [face.prim.GetName() for face in found] == ["RigB", "RigA", "Loose"]  # the active object's first
    for face, name in zip(found, ("HeadB", "HeadA", "Loose"), strict=True):
        assert [mesh.name for mesh in face.meshes] == [name]
        assert off(face, shown[f"several {name}"], {}) < 1e-5
    assert [face.skeleton.joints for face in found] == [("root",), ("root",), ()]


def test_edit_mode_exports_what_is_being_edited(scenes: Scenes) -> None:
    folder, shown, _ = scenes
    (face,) = faces(folder, "mesh_in_edit_mode")
    wanted = shown["mesh_in_edit_mode Head"]
    assert len(wanted) == 143
    assert off(face, wanted, {}) < 1e-6
    (uv,) = face.meshes[0].uv_sets
    assert uv.name == "st"  # what the exporter calls the map that is shown
    assert np.ptp(uv.values, axis=0).min() == pytest.approx(1.0)
    assert not [one for one in validate(folder / "mesh_in_edit_mode.usda") if one.severity == "error"]
    (face,) = faces(folder, "bones_in_edit_mode")
    assert face.skeleton.joints == ("root", "extra")


def test_a_part_that_hangs_on_a_bone_follows_it_alone(scenes: Scenes) -> None:
    folder, shown, _ = scenes
    (face,) = faces(folder, "part_on_a_bone")
    eye = next(mesh for mesh in face.meshes if mesh.name == "Eye")
    assert eye.skin is not None
    assert set(eye.skin.joint_indices.ravel().tolist()) == {face.skeleton.joints.index("root")}
    assert (eye.skin.joint_weights == 1.0).all()
    points = np.concatenate([shown[f"part_on_a_bone {mesh.name}"] for mesh in face.meshes])
    assert off(face, points, {}) < 1e-5


def test_keys_relative_to_others_muted_keys_and_stretched_objects(scenes: Scenes) -> None:
    folder, shown, _ = scenes
    (face,) = faces(folder, "relative_keys")
    assert [shape.name for shape in face.meshes[0].blendshapes] == ["smile", "wide"]
    assert off(face, shown["relative_keys Head"], {"wide": 0.5}) < 1e-5


def test_modifiers_are_applied_to_each_shape(scenes: Scenes) -> None:
    folder, shown, _ = scenes
    (face,) = faces(folder, "modifiers")
    (mesh,) = face.meshes
    assert len(mesh.points) == len(shown["modifiers Head"]) > 500
    assert off(face, shown["modifiers Head"], {"smile": 1.0}) < 1e-5
    assert mesh.skin is not None
    np.testing.assert_allclose(mesh.skin.joint_weights.sum(axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(mesh.regions["mouth"], 1.0, atol=1e-6)
    assert len(mesh.uv_sets) == 1
    assert not [one for one in validate(folder / "modifiers.usda") if one.severity == "error"]


def test_what_is_left_out_is_said(scenes: Scenes) -> None:
    folder, _, said = scenes
    assert "Eye: hidden or not chosen, left out of the face of Rig" in said
    assert [mesh.name for mesh in faces(folder, "hidden_mesh")[0].meshes] == ["Head"]
    assert "Rig: hidden or not chosen, without it Head is exported as no face" in said
    assert "Head: modifiers Hidden (1 in all) are not applied, the viewport doesn't show them" in said
    assert "Head: modifiers Weld (1 in all) are not applied, they make other points of some shape key" in said
    assert len(faces(folder, "other_points")[0].meshes[0].points) == 42
    assert "Head: 2 points are in no region" in said
    assert "Head: is scaled by 0" in said
    assert not [name for name in ("hidden_armature", "flat", "no_shapes") if faces(folder, name)]
