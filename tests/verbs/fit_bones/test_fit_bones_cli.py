"""`facepipe fit-bones`: what it makes, prints and refuses."""

from __future__ import annotations

import errno
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bone_faces import pose, save_obj, save_sources, saved, sculpt, small
from command_line import Capsys, done, exit_code, failed, run
from PIL import Image

import facepipe
from facepipe.core import atomic
from facepipe.parts import BoneLimits
from facepipe.performing import recipe_to
from facepipe.rig import build
from facepipe.verbs.fit_bones import FitBones, FitBonesToTargets, read_limits, read_targets


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder: rig.usda with a clip, a goal within its reach, limits."""
    monkeypatch.chdir(save_sources(tmp_path))
    return tmp_path


def test_the_result_is_that_of_python(folder: Path, capsys: Capsys) -> None:
    words = ["goal.usda", "talk"]
    flags = [word for name in words for word in ("--target", name)]
    out = done(
        capsys, "fit-bones", "rig.usda", *flags, "-o", "a.usda", "--limits", "limits.json", "--region", "mouth=2"
    )
    face = facepipe.open("rig.usda")
    settings = {"limits": read_limits(Path("limits.json")), "regions": {"mouth": 2.0}}
    recipe = recipe_to(FitBonesToTargets(rig=Path("rig.usda"), targets=tuple(words), **settings), "b.usda")
    with face.deriving("b.usda") as result:
        report = FitBones(**settings)(result, read_targets(face, words), recipe=recipe)
    assert Path("a.usda").read_bytes() == Path("b.usda").read_bytes()
    assert "@./rig.usda@" in Path("a.usda").read_text()
    assert out.startswith("a.usda: 2 targets, 3 of 3 joints, 45 points in ")
    assert list(report.targets) == ["goal", "talk_2"]
    assert [line.split()[0] for line in out.splitlines()[2:4]] == ["goal", "talk_2"]


def test_the_recipe_names_sources_targets_and_options(folder: Path, capsys: Capsys) -> None:
    Path("sub").mkdir()
    words = ("--target", "goal.usda", "--target", "jawOpen=0.5", "--threshold-mm", "50", "--mask", "mouth")
    done(capsys, "fit-bones", "rig.usda", *words, "--limits", "limits.json", "--initial", "talk", "-o", "sub/a.usda")
    recipe = facepipe.open("sub/a.usda").parts().recipe
    assert recipe is not None
    assert (recipe.verb, recipe.sources) == ("fit-bones", ("../rig.usda", "../goal.usda"))
    assert all(digest.startswith("sha256:") for digest in recipe.digests)
    assert recipe.options["targets"] == ["../goal.usda", "jawOpen=0.5"]
    assert recipe.options["limits"] == {"joints": [["*", {"s": [0.5, 2], "t": [-1, 1]}]], "lock": [], "units": "stage"}
    assert (recipe.options["mask"], recipe.options["initial"]) == (["mouth"], "talk")
    assert recipe.options["threshold_mm"] == 50.0


def test_json_has_every_figure_and_a_missed_target_is_reported_and_authored(folder: Path, capsys: Capsys) -> None:
    line = ("rig.usda", "--target", "shapes", "-o", "a.usda", "--max-iterations", "3", "--rounds", "0", "--json")
    code, out, err = run(capsys, "fit-bones", *line)
    report = json.loads(out)
    assert code == 1
    assert list(report["targets"]) == ["jawOpen", "mouthSmileLeft"]
    assert err.splitlines() == [f"facepipe: warning: {one}" for one in report["warnings"]]
    for name, one in report["targets"].items():
        assert not one["reached"]
        assert {"mean_mm", "rms_mm", "p95_mm", "max_mm", "points"} == set(one["distances"])
        assert set(one["regions"]) == {"mouth", "neck"}
        assert f"{name}: {one['distances']['max_mm']:.4g} mm off at most, threshold 0.1 mm" in report["warnings"]
    assert [animation.name for animation in facepipe.open("a.usda").animations] == ["talk", "jawOpen", "mouthSmileLeft"]
    out = done(capsys, "fit-bones", *line[:-1], "--force", "--residual")
    assert [row.split()[-1] for row in out.splitlines()[2:4]] != ["missed", "missed"]


def test_obj_in_the_units_of_the_face_and_weights(folder: Path, capsys: Capsys) -> None:
    rig = build(small())
    save_obj(sculpt(small(), rig.evaluate(coefficients=pose(rig, 1)), ["Head"]), Path("goal.obj"))
    code, out, err = run(capsys, "fit-bones", "rig.usda", "--target", "goal.obj", "-o", "a.usda", "--json")
    assert code == 0
    assert json.loads(out)["targets"]["goal"]["distances"]["points"] == 36
    assert err == "facepipe: warning: goal.obj: lacks meshes, which don't count: Teeth\n"


@pytest.mark.parametrize("words", [("goal.usda",), ("talk",), ("goal.usda", "jawOpen=0.1")])
def test_payloads_hold_what_the_stage_holds(words: tuple[str, ...], folder: Path, capsys: Capsys) -> None:
    flags = [part for word in words for part in ("--target", word)]
    out = done(
        capsys, "fit-bones", "rig.usda", *flags, "-o", "a.usda", "--coefficients", "a.fpb", "--threshold-mm", "50"
    )
    assert out.splitlines()[-1] == f"a.fpb: {Path('a.fpb').stat().st_size} bytes"
    face = facepipe.open("a.usda")
    assert exit_code("apply-bones", "rig.usda", "a.fpb", "-o", "points.npz") == 0
    capsys.readouterr()
    points = np.load("points.npz")["points"]
    names = ["talk_2"] if words == ("talk",) else [animation.name for animation in face.animations][1:]
    frames = [
        face.evaluate(joint_transforms=face.sample(name, frame)[0])
        for name in names
        for frame in range(5 if words == ("talk",) else 1)
    ]
    np.testing.assert_allclose(points.reshape(len(frames), -1, 3), frames, atol=1e-5)
    warm = run(
        capsys,
        "fit-bones",
        "rig.usda",
        *flags[:2],
        "-o",
        "b.usda",
        "--initial",
        "a.fpb",
        "--threshold-mm",
        "50",
        "--json",
    )
    assert warm[0] == 0
    if words == ("goal.usda",):
        assert json.loads(warm[1])["targets"]["goal"]["steps"] == 0


def test_pictures_of_the_targets_that_are_missed_most(folder: Path, capsys: Capsys) -> None:
    line = ("rig.usda", "-o", "a.usda", "--rounds", "0", "--heatmap", "a.png")
    done(capsys, "fit-bones", *line, "--target", "talk")
    with Image.open("a.png") as one:
        assert one.size == (800, 800)
    code, out, _ = run(capsys, "fit-bones", *line, "--target", "shapes", "--force")
    assert (code, out.splitlines()[-1]) == (1, "a.png")
    with Image.open("a.png") as sheet:
        assert sheet.width > 1600


def test_flattened_results_stand_alone(folder: Path, capsys: Capsys) -> None:
    done(capsys, "fit-bones", "rig.usda", "--target", "goal.usda", "-o", "a.usda", "--flatten", "--residual")
    assert "rig.usda@" not in Path("a.usda").read_text()
    Path("rig.usda").unlink()
    assert [animation.name for animation in facepipe.open("a.usda").animations] == ["talk", "goal"]


MISTAKES = {
    "nothing": ((), "RIG: none given, expected face stage with joints and skin weights (or --edit RESULT)"),
    "no target": (("rig.usda", "-o", "a.usda"), "--target: none given, expected what to reach (or --edit RESULT)"),
    "no output": (("rig.usda", "--target", "jawOpen"), "OUT: no output file, expected -o OUT"),
    "unknown target": (("rig.usda", "--target", "frown", "-o", "a.usda"), "target frown: no such blendshape"),
    "no rig": (("none.usda", "--target", "jawOpen", "-o", "a.usda"), "none.usda: no such file"),
    "unskinned rig": (("goal.usda", "--target", "goal.usda", "-o", "a.usda"), "goal.usda -> </Face>: has no joints"),
    "over the rig": (("rig.usda", "--target", "jawOpen", "-o", "rig.usda", "--force"), "rig.usda: is an input"),
    "over a target": (("rig.usda", "--target", "goal.usda", "-o", "goal.usda", "--force"), "goal.usda: is an input"),
    "over limits": (
        (
            "rig.usda",
            "--target",
            "jawOpen",
            "-o",
            "a.usda",
            "--limits",
            "limits.json",
            "--coefficients",
            "limits.json",
            "--force",
        ),
        "limits.json: is an input",
    ),
    "not usd": (("rig.usda", "--target", "jawOpen", "-o", "a.txt"), "a.txt: suffix '.txt', expected one of"),
    "not fpb": (
        ("rig.usda", "--target", "jawOpen", "-o", "a.usda", "--coefficients", "a.bin"),
        "a.bin: suffix '.bin', expected .fpb",
    ),
    "crossed limits": (
        ("rig.usda", "--target", "jawOpen", "-o", "a.usda", "--limits", "l.json"),
        "l.json -> joints -> jaw -> tx: lower limit 2 above the upper 1",
    ),
    "no limits": (("rig.usda", "--target", "jawOpen", "-o", "a.usda", "--limits", "n.json"), "n.json: can't be read"),
    "region": (
        ("rig.usda", "--target", "jawOpen", "-o", "a.usda", "--region", "nose=1"),
        "region nose: no such region",
    ),
    "region number": (
        ("rig.usda", "--target", "jawOpen", "-o", "a.usda", "--region", "mouth"),
        "--region mouth: expected NAME=NUMBER",
    ),
    "mask": (("rig.usda", "--target", "jawOpen", "-o", "a.usda", "--mask", "nose"), "mask nose: no such region"),
    "initial": (("rig.usda", "--target", "jawOpen", "-o", "a.usda", "--initial", "sad"), "initial sad: no such anim"),
    "initial file": (("rig.usda", "--target", "jawOpen", "-o", "a.usda", "--initial", "n.fpb"), "n.fpb: can't be read"),
    "threshold": (
        ("rig.usda", "--target", "jawOpen", "-o", "a.usda", "--threshold-mm", "0"),
        "option threshold_mm: is 0.0, expected a number from",
    ),
    "clip and pose": (
        ("rig.usda", "--target", "talk", "--target", "jawOpen", "-o", "a.usda", "--coefficients", "a.fpb"),
        "a.fpb: holds one clip or several poses, expected a single --target with times",
    ),
    "picture": (("rig.usda", "--target", "jawOpen", "-o", "a.usda", "--heatmap", "a.jpg"), "a.jpg: suffix '.jpg'"),
}


@pytest.mark.parametrize("kind", MISTAKES)
def test_mistakes_are_one_line_and_write_nothing(kind: str, folder: Path, capsys: Capsys) -> None:
    Path("l.json").write_text('{"joints": {"jaw": {"tx": [2, 1]}}}')
    words, message = MISTAKES[kind]
    line = failed(capsys, "fit-bones", *words)
    assert line.removeprefix("facepipe fit-bones: ").startswith(message)


def test_limits_of_the_rig_that_cross_are_named(folder: Path, capsys: Capsys) -> None:
    lower, upper = np.full((3, 9), 0.5), np.full((3, 9), 2.0)
    upper[1, 4] = 0.25
    saved(replace(small(), bone_limits=BoneLimits(lower=lower, upper=upper)), Path("limited.usda"))
    line = failed(capsys, "fit-bones", "limited.usda", "--target", "jawOpen", "-o", "a.usda")
    assert "bone limits -> root/jaw -> ry: lower limit 0.5 above the upper 0.25" in line


@pytest.mark.parametrize(("option", "suffix"), [("--coefficients", ".fpb"), ("--heatmap", ".png")])
def test_where_one_file_cannot_be_written_none_is(
    folder: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch, option: str, suffix: str
) -> None:
    name, finish = f"b{suffix}", atomic._finish_file

    def full(temporary: Path, target: Path) -> None:
        if target.name == name:
            raise OSError(errno.ENOSPC, "no space left")
        finish(temporary, target)

    monkeypatch.setattr(atomic, "_finish_file", full)
    message = failed(capsys, "fit-bones", "rig.usda", "--target", "goal.usda", "-o", "a.usda", option, name)
    assert message.startswith(f"{name}: can't be written")
