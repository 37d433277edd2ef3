"""`--symmetric` from the face to the file: what both sides are given, and what can't be paired."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bone_faces import pose, save_sources, saved, sculpt, small
from command_line import Capsys, done, failed, run
from small_head import make

import facepipe
from facepipe.core.names import mirrored_name
from facepipe.parts import BoneLimits, FaceParts
from facepipe.performing import read_kept
from facepipe.rig import Rig, build, rest_coefficients
from facepipe.verbs.fit_bones import FitBones, FitBonesToTargets, read_targets

MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


def sample() -> FaceParts:
    """The sample head with limits that are the same on both sides."""
    parts = make(0)
    limits = np.zeros((len(parts.skeleton.joints), 9)), np.zeros((len(parts.skeleton.joints), 9))
    for array, sign in zip(limits, (-1, 1), strict=True):
        array += np.repeat([0.5 * sign, 0.5 * sign, 1 + 0.3 * sign], 3)
    return replace(parts, bone_limits=BoneLimits(lower=limits[0], upper=limits[1]))


def partners(joints: tuple[str, ...]) -> list[int]:
    names = [joint.rpartition("/")[2] for joint in joints]
    return [names.index(mirrored_name(name)) for name in names]


def check_mirrored(rig: Rig, coefficients: np.ndarray) -> None:
    """Pairs hold the same float32 numbers but for signs, and move as mirror images."""
    others, stored = partners(rig.joints), coefficients.astype(np.float32)
    np.testing.assert_array_equal(stored, coefficients)
    np.testing.assert_array_equal(np.abs(stored), np.abs(stored)[others])
    np.testing.assert_array_equal(stored[:, 6:], stored[others, 6:])
    worlds = rig.joint_worlds(rig.local_transforms(coefficients)) @ np.linalg.inv(rig.joint_worlds(rig.rest))
    np.testing.assert_allclose(worlds[others], MIRROR @ worlds @ MIRROR, atol=1e-5)


@pytest.mark.parametrize("residual", [False, True], ids=["bones", "residual"])
def test_stored_coefficients_of_pairs_are_mirror_images(residual: bool, tmp_path: Path) -> None:
    """Shapes of one side, from coefficients to start from that are not the same on both."""
    face = facepipe.open(saved(sample(), tmp_path / "rig.usdc"))
    rig = face.rig()
    start = rest_coefficients(len(rig.joints)) + np.random.default_rng(0).normal(0, 0.01, (len(rig.joints), 9))
    targets = read_targets(face, ["mouthSmileLeft", "jawOpen"])
    with face.deriving(tmp_path / "out.usda") as result:
        report = FitBones(symmetric=True, residual=residual, initial=start, max_iterations=8)(result, targets)
    saved_face = facepipe.open(tmp_path / "out.usda")
    found = {
        animation.name: animation.coefficients
        for animation in saved_face.animations
        if animation.name in report.targets
    }
    weighted = np.isin(rig.joints, report.weightless, invert=True)
    for name, frames in found.items():
        assert frames is not None
        assert report.targets[name].distances.rms_mm < report.targets[name].before.rms_mm
        assert np.abs(frames[0] - rest_coefficients(len(rig.joints)))[weighted].max() > 0.01
        check_mirrored(rig, frames[0])
    assert not residual or report.warnings == ()


# --- the command


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder: pairs.usda with a joint for each end of the mouth; aside.usda; rig.usda without pairs."""
    monkeypatch.chdir(save_sources(tmp_path))
    saved(pairs(), Path("pairs.usda"))
    saved(sculpt(pairs(), build(pairs()).evaluate(coefficients=pose(build(pairs()), 1, 0.3))), Path("aside.usda"))
    return tmp_path


def pairs() -> FaceParts:
    """The small face with a joint for each end of the mouth."""
    rest = np.tile(np.eye(4), (3, 1, 1))
    rest[1:, 0, 3] = 0.5, -0.5
    joints = ("root", "root/lip_L", "root/lip_R")
    skeleton = replace(small().skeleton, joints=joints, rest_transforms=rest, bind_transforms=rest)
    return replace(small(), skeleton=skeleton)


def test_the_recipe_keeps_it_and_an_edit_takes_it_back(folder: Path, capsys: Capsys) -> None:
    line = ("pairs.usda", "--target", "aside.usda", "--threshold-mm", "100")
    code, out, err = run(capsys, "fit-bones", *line, "--symmetric", "-o", "a.usda", "--json")
    assert (code, err, json.loads(out)["warnings"]) == (0, "", [])
    assert read_kept("a.usda", FitBonesToTargets).values["symmetric"]
    own = facepipe.open("a.usda").animations[-1].coefficients
    assert own is not None
    check_mirrored(facepipe.open("a.usda").rig(), own[0])
    first = Path("a.usda").read_bytes()
    done(capsys, "fit-bones", "--edit", "a.usda", "--force")
    assert Path("a.usda").read_bytes() == first
    done(capsys, "fit-bones", "--edit", "a.usda", "--no-symmetric", "-o", "b.usda")
    done(capsys, "fit-bones", *line, "-o", "c.usda")
    assert Path("b.usda").read_bytes() == Path("c.usda").read_bytes() != first
    assert not read_kept("b.usda", FitBonesToTargets).values["symmetric"]


def test_joints_without_a_partner_are_reported(folder: Path, capsys: Capsys) -> None:
    joints = ("cheek_L", "cheek_L/lip_L", "cheek_L/lip_R")
    saved(replace(pairs(), skeleton=replace(pairs().skeleton, joints=joints)), Path("single.usda"))
    line = ("--target", "aside.usda", "--threshold-mm", "100", "--symmetric", "-o", "a.usda", "--json")
    code, out, err = run(capsys, "fit-bones", "single.usda", *line)
    line = "1 joint of one side has no partner and moves as it likes: cheek_L"
    assert (code, err, json.loads(out)["warnings"]) == (0, f"facepipe: warning: {line}\n", [line])


def test_what_can_not_be_paired_is_one_line(folder: Path, capsys: Capsys) -> None:
    line = ("--target", "jawOpen", "--symmetric", "-o", "a.usda")
    assert "no pairs of joints, expected names with left and right, or L and R" in failed(
        capsys, "fit-bones", "rig.usda", *line
    )
    turned = pairs().skeleton.rest_transforms.copy()
    turned[1, :3, :3] = [[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]
    saved(replace(pairs(), skeleton=replace(pairs().skeleton, rest_transforms=turned)), Path("turned.usda"))
    assert "its axes at rest are no mirror image of" in failed(capsys, "fit-bones", "turned.usda", *line)
    Path("l.json").write_text('{"joints": {"lip_L": {"sx": [1.1, 1.2]}, "lip_R": {"sx": [0.8, 0.9]}}}')
    own = failed(capsys, "fit-bones", "pairs.usda", *line, "--limits", "l.json")
    assert own.startswith("limits -> root/lip_L -> sx: limits that are no mirror images")
