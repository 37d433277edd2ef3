"""`facepipe neural-rig apply`: a face stage that a neural rig moves, and that links it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import done, failed
from neural_faces import applied, face, millimetres, random_values, saved_rig
from oracle import bake_all
from pxr import Sdf, Usd

from facepipe.checks import validate_stage
from facepipe.core import tokens
from facepipe.neural import save_neural_rig
from facepipe.rig import slide
from facepipe.stage.recipes import read_neural_rig_link, recipe_of
from facepipe.verbs.whole_faces import MILLIMETRES, world_to_world


@pytest.mark.parametrize("kind", ["bones", "points", "points without joints"])
def test_the_stage_does_what_the_neural_rig_does(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = saved_rig(tmp_path, face("Z", 1.0, joints=kind != "points without joints"), bones=kind == "bones")
    found = applied(tmp_path, capsys, "-o", tmp_path / "neural.usda")
    values = random_values(rig, 10)
    expected, height = rig.points(values), np.ptp(rig.rest[:, 1])
    assert np.abs(millimetres(found.parts(), rig, values) - expected).max() < 1e-5 * height
    assert [one for one in validate_stage(tmp_path / "neural.usda") if one.severity == "error"] == []
    poses = []
    for row in values:
        parts, set_to = found.parts(), {one.name: v for one, v in zip(rig.controls, row.tolist(), strict=True)}
        coefficients, weights = slide(parts.sliders, parts.skeleton.joints, set_to, parts.slider_network)
        poses.append((weights, found.rig().local_transforms(coefficients)))
    to = world_to_world(1.0, "Z", MILLIMETRES)
    off = np.linalg.norm(bake_all(found, poses) @ to[:3, :3].T - expected, axis=2)
    assert off.max() < 2e-3 * height  # SkelAnimation rounds scales to half


def test_the_layer_holds_what_changed_a_link_and_the_recipe(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved_rig(tmp_path, face(), bones=True)
    (tmp_path / "out").mkdir()
    found = applied(tmp_path, capsys, "-o", tmp_path / "out" / "neural.usda", "--offset-tolerance-mm", 0.01)
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "out" / "neural.usda"))
    assert list(layer.subLayerPaths) == ["../head.usda"]
    head = layer.GetPrimAtPath(found.mesh_prim("Head").GetPath())
    assert "points" not in head.attributes
    assert "primvars:skel:jointIndices" not in head.attributes
    link = read_neural_rig_link(found.prim)
    assert link is not None
    assert (link.path, "is outside the roots" in link.refusal) == (None, True)
    (tmp_path / "facepipe.toml").touch()
    link = read_neural_rig_link(found.prim)
    assert link is not None
    assert (link.file, link.path) == ("../head.fpnr", tmp_path / "head.fpnr")
    recipe, _ = recipe_of(tmp_path / "out" / "neural.usda", "neural-rig apply")
    assert recipe.sources == ("../head.usda", "../head.fpnr")
    files = dict(zip(("face", "rig"), recipe.sources, strict=True))
    assert recipe.options == {**files, "keep_shapes": True, "offset_tolerance_mm": 0.01}
    assert recipe.digests[1] == link.digest


def test_standalone_files_link_it_too_packages_can_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved_rig(tmp_path, face(), bones=False)
    flat = applied(tmp_path, capsys, "-o", tmp_path / "flat.usda", "--flatten")
    packed = applied(tmp_path, capsys, "-o", tmp_path / "packed.usdz")
    for one in (flat, packed):
        assert [
            found for found in validate_stage(str(one.stage.GetRootLayer().realPath)) if found.severity == "error"
        ] == []
    link = read_neural_rig_link(flat.prim)
    assert link is not None
    assert link.path == tmp_path / "head.fpnr"
    assert read_neural_rig_link(packed.prim) is None


def checks(path: Path) -> dict[str, str]:
    return {one.check: one.message for one in validate_stage(path) if one.check.startswith("facepipe:NeuralRig")}


def test_what_is_wrong_with_a_link_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = saved_rig(tmp_path, face(), bones=True)
    neural = tmp_path / "neural.usda"
    applied(tmp_path, capsys, "-o", neural)
    assert checks(neural) == {}
    save_neural_rig(replace(rig, linear=2.0 * rig.linear), tmp_path / "head.fpnr", {})
    assert checks(neural).keys() == {"facepipe:NeuralRigDigest"}
    assert "has changed, expected the file of sha256:" in checks(neural)["facepipe:NeuralRigDigest"]
    (tmp_path / "head.fpnr").write_bytes(b"junk")
    assert checks(neural).keys() == {"facepipe:NeuralRigDigest", "facepipe:NeuralRigFile"}
    (tmp_path / "head.fpnr").unlink()
    assert checks(neural) == {"facepipe:NeuralRigFile": "@./head.fpnr@ can't be found, expected a neural rig (.fpnr)"}
    save_neural_rig(rig, tmp_path / "head.fpnr", {})
    stage = Usd.Stage.Open(str(neural))
    stage.GetDefaultPrim().GetAttribute(tokens.NEURAL_RIG_TOPOLOGY).Set("other")
    stage.Save()
    assert checks(neural).keys() == {"facepipe:NeuralRigFile", "facepipe:NeuralRigTopology"}


def test_a_rig_of_other_meshes_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = saved_rig(tmp_path, face(), bones=True)
    save_neural_rig(replace(rig, topology="other"), tmp_path / "head.fpnr", {})
    words: tuple[object, ...]
    for words in (
        ("neural-rig", "apply", tmp_path / "head.usda", tmp_path / "head.fpnr", "-o", tmp_path / "out.usda"),
        ("export", tmp_path / "head.usda", "--neural", tmp_path / "head.fpnr", "-o", tmp_path / "out.onnx"),
    ):
        err = failed(capsys, *words, folder=tmp_path)
        assert "head.usda" in err
        assert "other meshes than the neural rig was learned on" in err


def test_applied_faces_are_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved_rig(tmp_path, face(), bones=True)
    applied(tmp_path, capsys, "-o", tmp_path / "neural.usda")
    pictures = []
    for value in (0.0, 1.0):
        picture = tmp_path / f"{value}.png"
        words = ("render", tmp_path / "neural.usda", "-o", picture, "--slider", f"jaw={value}", "--size", 64)
        done(capsys, *words)
        pictures.append(picture.read_bytes())
    assert pictures[0] != pictures[1]
