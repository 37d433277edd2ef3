"""Each verb that can be cooked: its result again from its recipe, to the bytes that its command writes.

So does its --edit.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import content, exit_code
from cook_cases import CASES
from cook_chain import actions, cook

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
    (folder / "facepipe.toml").touch()  # files that the recipe names may lie above its folder
    assert exit_code(*line) == case.code
    assert exit_code(*case.line, "-o", "flat.usda", "--flatten") == case.code
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
    assert exit_code(*line, "--force") == case.code
    assert exit_code(*case.line, "-o", "flat.usda", "--flatten", "--force") == case.code
    assert content(folder) == cooked


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.edit])
def test_an_edit_gives_the_bytes_of_the_command_with_what_it_changes(name: str, folder: Path) -> None:
    case = CASES[name]
    case.put(folder)
    assert exit_code(*case.line, "-o", "out.usda") == case.code
    assert exit_code(*case.command, "--edit", "out.usda", *case.edit, "-o", "edited.usda") == case.code
    assert exit_code(*case.line, *case.edit, "-o", "other.usda") == case.code
    assert Path("edited.usda").read_bytes() == Path("other.usda").read_bytes()
    assert exit_code(*case.command, "--edit", "out.usda", *case.edit, "--force") == case.code
    assert Path("out.usda").read_bytes() == Path("other.usda").read_bytes()
