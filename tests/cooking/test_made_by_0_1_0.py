"""What version 0.1.0 made is cooked, kept and read as it was: recipes, a batch's ledger, a database, a neural rig.

The files were made by 0654c8d6, before rooms moved: the cases of `cook_cases` of then, and a batch and a database of
the two faces of a blend.
"""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from command_line import exit_code

from facepipe.scanning.database import load_database, save_database

MADE = zipfile.ZipFile(Path(__file__).with_name("made_by_0.1.0.zip"))
COOKED = sorted({name.partition("/")[0] for name in MADE.namelist()} - {"batch", "database"})
NUMBER = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")


def extracted(case: str, folder: Path) -> Path:
    MADE.extractall(folder, [name for name in MADE.namelist() if name.startswith(f"{case}/")])
    return folder / case


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("case", COOKED)
def test_a_recipe_is_up_to_date_and_cooks_to_the_same(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Text of the layer byte by byte, but numbers as far as other processors round them alike."""
    folder = extracted(case, tmp_path)
    out, before = folder / "out.usda", files(folder)
    assert exit_code("cook", out, "--dry-run") == 0
    assert files(folder) == before
    capsys.readouterr()
    assert exit_code("cook", out, "--force", "--json") == (1 if "missed" in case else 0)
    assert json.loads(capsys.readouterr().out)["nodes"][0]["action"] == "cooked"
    was, now = before["out.usda"].decode(), out.read_text()
    assert NUMBER.sub("#", now) == NUMBER.sub("#", was)
    numbers = [np.array(NUMBER.findall(text), np.float64) for text in (was, now)]
    np.testing.assert_allclose(numbers[1], numbers[0], rtol=1e-4, atol=1e-5)


def test_a_batch_keeps_what_its_ledger_has(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = extracted("batch", tmp_path)
    before = {name: data for name, data in files(folder).items() if name.startswith("out")}
    assert exit_code("batch", folder / "plan.toml", "--verify", "--json") == 0
    assert json.loads(capsys.readouterr().out)["counts"] == {"kept": 6}
    assert {name: data for name, data in files(folder).items() if name.startswith("out")} == before


def test_a_database_is_written_as_it_was(tmp_path: Path) -> None:
    path = extracted("database", tmp_path) / "people.fpdb"
    save_database(load_database(path), tmp_path / "again.fpdb")
    assert (tmp_path / "again.fpdb").read_bytes() == path.read_bytes()
