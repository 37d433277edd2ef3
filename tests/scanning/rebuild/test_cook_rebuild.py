"""Rebuilt faces are cooked to the bytes of their commands; of the other stages in test_rebuild_stages.py."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import scan_domes
from command_line import content, done
from neutral_files import Files
from rebuild_project import PROJECT, rebuilt

from facepipe.cooking import cook
from facepipe.core.atomic import apart
from facepipe.core.reports import Bar, unwatched

Capsys = pytest.CaptureFixture[str]


@pytest.fixture
def files(fit_files: Files) -> Files:
    return fit_files


def _cooked(capsys: Capsys, *stages: Path, more: tuple[str, ...] = ()) -> list[str]:
    """What was done about each file."""
    out = done(capsys, "cook", *stages, *more, quiet=False)
    return [line.split(": ", 2)[2].split(" in ")[0].partition(" (")[0] for line in out.splitlines()[:-1]]


def test_a_neutral_and_what_was_refined_on_it(files: Files, capsys: Capsys) -> None:
    fine = files.folder / "fine.usda"
    refine = ("refine-neutral", files["out.usda"], files["scan.ply"], "-o", fine)
    done(capsys, *files.words("--unit", "cm", "--weights", "jawOpen=0.1"), quiet=False)
    done(capsys, *refine, quiet=False)
    before = content(files.folder)
    assert _cooked(capsys, fine) == ["up to date"] * 2
    assert _cooked(capsys, fine, more=("--force",)) == ["cooked"] * 2
    assert content(files.folder) == before
    files.put(*scan_domes.scan(8))
    assert _cooked(capsys, fine) == ["cooked"] * 2
    cooked = content(files.folder)
    assert cooked != before
    done(capsys, *files.words("--unit", "cm", "--weights", "jawOpen=0.1", "--force"), quiet=False)
    done(capsys, *refine, "--force", quiet=False)
    assert content(files.folder) == cooked


def test_an_actor_of_a_project(project: Path, capsys: Capsys) -> None:
    out = project.parent / "anna.usda"
    rebuilt(capsys, project)
    before = out.read_bytes()
    assert _cooked(capsys, out) == ["up to date"]
    assert _cooked(capsys, out, more=("--force",)) == ["cooked"]
    assert out.read_bytes() == before
    project.write_text(PROJECT.replace("weight_spread = 0", "weight_spread = 0.05"))
    assert _cooked(capsys, out) == ["cooked"]
    cooked = out.read_bytes()
    assert cooked != before
    rebuilt(capsys, project)
    assert out.read_bytes() == cooked


def test_a_template_that_a_project_names_now_is_cooked_first(project: Path, capsys: Capsys) -> None:
    """No recipe knows of it until the actor is cooked; then it is cooked, and the actor is of what it became."""
    head, middle, out = (project.parent / name for name in ("head.usda", "middle.usda", "anna.usda"))
    rebuilt(capsys, project)
    marks = project.parent / "marks.json"
    marks.write_text(json.dumps(scan_domes.face().meshes[0].landmarks["multipie68"].indices.tolist()))
    done(capsys, "landmarks", head, "--from", marks, "-o", middle, quiet=False)
    with head.open("a") as text:
        text.write("# changed\n")
    project.write_text(PROJECT.replace("head.usda", "middle.usda"))
    assert _cooked(capsys, out) == ["cooked"] * 3
    assert _cooked(capsys, out) == ["up to date"] * 2
    cooked = out.read_bytes()
    rebuilt(capsys, project)
    assert out.read_bytes() == cooked


def test_a_scan_that_changes_while_it_is_fitted_is_fitted_again(files: Files, capsys: Capsys) -> None:
    """The fit is of the scan as it was read, the recipe of the scan as it is: together they would look up to date."""
    done(capsys, *files.words("--unit", "cm"), quiet=False)
    files.put(*scan_domes.scan(8))
    fits = 0

    @contextmanager
    def watch(label: str, steps: int) -> Iterator[Bar]:
        nonlocal fits
        fits += label == "fit"
        if label == "fit" and fits == 1:
            with apart():  # as another process writes
                files.put(*scan_domes.scan(7))
        with unwatched(label, steps) as bar:
            yield bar

    (node,) = cook([files["out.usda"]], watch=watch).nodes
    assert (node.action, fits) == ("cooked", 2)
    cooked = content(files.folder)
    done(capsys, *files.words("--unit", "cm", "--force"), quiet=False)
    assert content(files.folder) == cooked
