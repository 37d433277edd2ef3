"""`facepipe database`: exit codes, what it prints, and files that stay as they were."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import done, failed, run
from database_faces import person

import facepipe
from facepipe.parts import Recipe
from facepipe.scanning.database import load_database, quality_from
from facepipe.stage import save_parts

GOOD = {"surface_mean_mm": 0.1, "surface_p95_mm": 0.4, "coverage": 0.9, "flipped_triangles": 0}
BAD = {**GOOD, "coverage": 0.3, "surface_mean_mm": 0.5}


@pytest.fixture
def faces(tmp_path: Path) -> list[Path]:
    paths = [tmp_path / f"p{seed}.usda" for seed in range(5)]
    for seed, path in enumerate(paths):
        save_parts(person(seed), path)
    return paths


@pytest.fixture
def database(faces: list[Path], capsys: pytest.CaptureFixture[str]) -> Path:
    path = faces[0].with_name("faces.fpdb")
    done(capsys, "database", "create", *faces[:3], "-o", path)
    return path


def rebuilt(path: Path, quality: dict[str, float] | None) -> Path:
    options: dict[str, object] = {} if quality is None else {"found": {"quality": quality}}
    save_parts(replace(person(8), recipe=Recipe(verb="rebuild", options=options, version="0.1.0")), path)
    return path


def test_create_add_and_info_report_the_same(
    faces: list[Path], database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = done(capsys, "database", "add", database, *faces[3:], "--json")
    added = json.loads(out)
    out = done(capsys, "database", "info", database, "--json")
    assert json.loads(out) == added
    assert added["version"] == 2
    assert [entry["name"] for entry in added["entries"]] == ["p0", "p1", "p2", "p3", "p4"]
    assert added["expressions"]["shapes"] == ["jawOpen", "mouthSmileLeft", "browInnerUp"]
    assert added["identity"]["variance_explained"][-1] == pytest.approx(1.0)
    assert [update["entries"] for update in added["history"]] == [["p0", "p1", "p2"], ["p3", "p4"]]
    text = done(capsys, "database", "info", database)
    assert "version 2, 5 faces of 45 points in 2 meshes" in text
    whole = tmp_path / "whole.fpdb"
    done(capsys, "database", "create", *faces, "-o", whole)
    spread = json.loads(run(capsys, "database", "info", whole, "--json")[1])["identity"]["deviations_mm"]
    assert added["identity"]["deviations_mm"] == pytest.approx(spread, rel=1e-6)


def test_add_writes_in_place_or_elsewhere(
    faces: list[Path], database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, other = database.read_bytes(), tmp_path / "other.fpdb"
    done(capsys, "database", "add", database, faces[3], "-o", other, "--names", "anna")
    assert database.read_bytes() == before
    assert load_database(other).entries[-1].name == "anna"
    assert run(capsys, "database", "add", database, faces[4], "-o", other)[0] == 2
    done(capsys, "database", "add", database, faces[3], "--names", "anna")
    assert database.read_bytes() == other.read_bytes()


def test_python_changes_in_place_or_elsewhere_too(faces: list[Path], database: Path, tmp_path: Path) -> None:
    before, other = database.read_bytes(), tmp_path / "other.fpdb"
    added = facepipe.database_add(database, faces[3:], out=other, names=["anna", "bob"])
    assert [entry.name for entry in added.entries] == ["p0", "p1", "p2", "anna", "bob"]
    assert database.read_bytes() == before
    facepipe.database_add(str(database), faces[3:], names=["anna", "bob"])
    assert database.read_bytes() == other.read_bytes()
    facepipe.database_remove(database, ["anna"])
    found = facepipe.database_info(database)
    assert (found.version, found.bytes) == (3, database.stat().st_size)
    with pytest.raises(facepipe.InputError, match=r"suffix '\.usda'"):
        facepipe.database_add(faces[0], faces[1:2])


def test_what_is_refused_leaves_the_file_as_it_was(
    faces: list[Path], database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "bad.json"
    report.write_text(json.dumps({"quality": BAD}), encoding="utf-8")
    lines = [
        (faces[3], faces[1]),
        (faces[3], tmp_path / "none.usda"),
        (faces[3], "--quality", report),
        (faces[3], faces[4], "--quality", report),
        (faces[3], "--quality", f"p9={report}"),
        (faces[3], "--names", "a,b"),
        (faces[3], "--min-coverage", "2"),
        (rebuilt(tmp_path / "bad.usda", BAD),),
        (rebuilt(tmp_path / "silent.usda", None),),
    ]
    for words in lines:
        failed(capsys, "database", "add", database, *words, folder=tmp_path)
    _, _, err = run(capsys, "database", "add", database, faces[3], "--quality", report)
    assert "p3: refused: mean surface distance 0.5 mm" in err
    assert "coverage 0.3, expected at least 0.6" in err


def test_the_gate_reads_recipes_and_reports(
    faces: list[Path], database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done(capsys, "database", "add", database, rebuilt(tmp_path / "good.usda", GOOD))
    assert load_database(database).entries[-1].quality == quality_from(GOOD, "good")
    report = tmp_path / "bad.json"
    report.write_text(json.dumps(BAD), encoding="utf-8")
    code, _, err = run(capsys, "database", "add", database, faces[3], "--quality", report, "--ignore-quality")
    assert code == 0
    assert "coverage 0.3" in err
    assert any("coverage 0.3" in line for line in load_database(database).history[-1].ignored)
    limits = ("--min-coverage", 0.2, "--max-surface-mean-mm", 0.6)
    done(capsys, "database", "add", database, faces[4], "--quality", report, *limits)
    assert load_database(database).history[-1].ignored == ()


def test_adds_at_once_lose_no_face(faces: list[Path], database: Path) -> None:
    words = [sys.executable, "-m", "facepipe", "database", "add", str(database)]
    both = [subprocess.Popen([*words, str(face)], stdout=subprocess.PIPE, stderr=subprocess.PIPE) for face in faces[3:]]
    ends = [(one.communicate()[1], one.returncode) for one in both]
    assert [code for _, code in ends] == [0, 0], ends
    found = load_database(database)
    assert {entry.name for entry in found.entries} == {"p0", "p1", "p2", "p3", "p4"}
    assert found.version == 3


def test_remove_takes_faces_out_in_place_or_elsewhere(
    faces: list[Path], database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, other = database.read_bytes(), tmp_path / "other.fpdb"
    done(capsys, "database", "remove", database, "p1", "-o", other)
    assert database.read_bytes() == before
    out = done(capsys, "database", "remove", database, "p1", "--json")
    assert [entry["name"] for entry in json.loads(out)["entries"]] == ["p0", "p2"]
    assert database.read_bytes() == other.read_bytes()
    for words in (("p1",), ("p0", "p0"), ("p0",), ()):
        err = failed(capsys, "database", "remove", database, *words, folder=tmp_path)
        assert err.startswith(f"{database}" if words else "NAME: none given")
    done(capsys, "database", "add", database, faces[1], faces[3])
    assert [entry.name for entry in load_database(database).entries] == ["p0", "p2", "p1", "p3"]
    _, text, _ = run(capsys, "database", "info", database)
    assert "version 2: remove 1" in text


def test_bad_lines_give_one_line(faces: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (
        ("create", faces[0], "-o", tmp_path / "x.fpdb"),
        ("create", faces[0], faces[0], "-o", tmp_path / "x.fpdb"),
        ("create", faces[0], faces[1], "-o", tmp_path / "x.npz"),
        ("create", faces[0], faces[1], "-o", faces[2], "--force"),
        ("create", faces[0], faces[1], "-o", tmp_path / "x.fpdb", "--tolerance-mm", "0"),
        ("info", faces[0]),
        ("info", tmp_path / "none.fpdb"),
        ("add", faces[0], faces[1]),
        ("what",),
        (),
    ):
        failed(capsys, "database", *words, folder=tmp_path)


@pytest.mark.parametrize("action", ["create", "add", "remove", "info"])
def test_each_action_has_help_with_an_example(capsys: pytest.CaptureFixture[str], action: str) -> None:
    out = done(capsys, "database", action, "--help")
    assert f"facepipe database {action}" in out.partition("example")[2]
