"""Recipes of faces with a neural rig: what they give back, and what a stage says of its rig."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import done, run
from neural_faces import applied, face
from neural_faces import saved_rig as saved

from facepipe.core.errors import InputError
from facepipe.neural import ApplyNeuralRig, save_neural_rig
from facepipe.performing import perform, read_kept


@pytest.mark.parametrize("bones", [True, False])
@pytest.mark.parametrize("name", ["neural.usda", "neural.usdc", "flat.usda"])
def test_a_recipe_gives_the_same_bytes_again(
    name: str, bones: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved(tmp_path, face(), bones=bones)
    (tmp_path / "out").mkdir()
    (tmp_path / "facepipe.toml").touch()
    out = tmp_path / "out" / name
    flat = ("--flatten",) * (name == "flat.usda")
    applied(tmp_path, capsys, "-o", out, "--offset-tolerance-mm", 0.02, *flat)
    first, kept = out.read_bytes(), read_kept(out, ApplyNeuralRig)
    expected = {"face": tmp_path / "head.usda", "rig": tmp_path / "head.fpnr", "offset_tolerance_mm": 0.02}
    assert kept.values == {**expected, "keep_shapes": True}
    assert kept.standalone == bool(flat)
    assert kept.warnings == ()
    out.unlink()
    perform(ApplyNeuralRig(**kept.values), out, flatten=kept.standalone)
    assert out.read_bytes() == first


def test_every_source_that_changes_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig, out = saved(tmp_path, face(), bones=True), tmp_path / "neural.usda"
    applied(tmp_path, capsys, "-o", out)
    save_neural_rig(replace(rig, linear=2.0 * rig.linear), tmp_path / "head.fpnr", {})
    assert read_kept(out, ApplyNeuralRig).warnings == ("head.fpnr changed since neural.usda was made",)
    (tmp_path / "head.usda").write_text((tmp_path / "head.usda").read_text() + "\n# a line\n")
    assert [line.split()[0] for line in read_kept(out, ApplyNeuralRig).warnings] == ["head.usda", "head.fpnr"]
    (tmp_path / "head.fpnr").unlink()
    with pytest.raises(InputError, match=r"source 2: .*head.fpnr: no such file, expected it there \(or RIG\)"):
        read_kept(out, ApplyNeuralRig)


@pytest.mark.parametrize("name", ["neural.usda", "flat.usda"])
def test_a_changed_rig_is_cooked_to_the_bytes_that_apply_writes(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig, out, flat = saved(tmp_path, face(), bones=True), tmp_path / name, ("--flatten",) * (name == "flat.usda")
    words = ("-o", out, "--offset-tolerance-mm", 0.02, *flat)
    applied(tmp_path, capsys, *words)
    first = out.read_bytes()
    done(capsys, "cook", out, "--dry-run")
    save_neural_rig(replace(rig, linear=2.0 * rig.linear), tmp_path / "head.fpnr", {})
    printed = done(capsys, "cook", out, "--json")
    assert json.loads(printed)["nodes"][0]["why"] == ["head.fpnr changed"]
    cooked = out.read_bytes()
    applied(tmp_path, capsys, *words, "--force")
    assert out.read_bytes() == cooked != first


def test_inspect_shows_the_rig_and_whether_it_is_what_was_applied(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig, out = saved(tmp_path, face(), bones=True), tmp_path / "neural.usda"
    applied(tmp_path, capsys, "-o", out)

    def inspected(path: Path) -> tuple[object, bool]:
        found = json.loads(run(capsys, "inspect", path, "--json")[1])["neural_rig"]
        shown = run(capsys, "inspect", path)[1]
        return found, found is not None and f"{found['file']}, {found['state']}" in shown

    assert inspected(out) == ({"file": "./head.fpnr", "state": "as applied"}, True)
    save_neural_rig(replace(rig, linear=2.0 * rig.linear), tmp_path / "head.fpnr", {})
    assert inspected(out) == ({"file": "./head.fpnr", "state": "changed since"}, True)
    (tmp_path / "head.fpnr").unlink()
    assert inspected(out) == ({"file": "./head.fpnr", "state": "lost"}, True)
    assert inspected(tmp_path / "head.usda") == (None, False)
    assert "neural rig" not in run(capsys, "inspect", tmp_path / "head.usda")[1]
