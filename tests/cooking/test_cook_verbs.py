"""Each verb that can be cooked: its result again from its recipe, to the bytes that its command writes."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import content
from cook_cases import CASES
from cook_chain import actions, cook

from facepipe.cli import main

Capsys = pytest.CaptureFixture[str]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", CASES)
def test_a_recipe_gives_the_bytes_of_its_command(name: str, folder: Path, capsys: Capsys) -> None:
    case = CASES[name]
    case.put(folder)
    line = [*case.line, "-o", "results/out.usda"]
    (folder / "results").mkdir()
    assert main(line) == case.code
    assert main([*case.line, "-o", "flat.usda", "--flatten"]) == case.code
    capsys.readouterr()
    before = content(folder)
    code, report, _ = cook(capsys, "results/out.usda", "flat.usda", "--force")
    assert (code, actions(report)) == (case.code, {"out.usda": "cooked", "flat.usda": "cooked"})
    assert content(folder) == before
    case.change()
    code, report, _ = cook(capsys, "results/out.usda", "flat.usda")
    assert (code, actions(report)) == (case.code, {"out.usda": "cooked", "flat.usda": "cooked"})
    cooked = content(folder)
    assert all(cooked[one] != before[one] for one in (folder / "results" / "out.usda", folder / "flat.usda"))
    assert main([*line, "--force"]) == case.code
    assert main([*case.line, "-o", "flat.usda", "--flatten", "--force"]) == case.code
    assert content(folder) == cooked
