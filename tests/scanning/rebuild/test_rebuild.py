"""`facepipe rebuild`: a project's scans to the actor's neutral and shapes, stage by stage."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import scan_domes
from command_line import done, failed, run
from rebuild_project import PERSON, PROJECT, motion, rebuilt
from solids import ball

import facepipe
from facepipe.checks import validate
from facepipe.importers.scan_ply import write_ply
from facepipe.kinds import found_of
from facepipe.scanning.rebuild.rebuild_action import _named_steps
from facepipe.scanning.rebuild.steps import KIND
from facepipe.scans import Scan
from facepipe.stage import save_parts
from facepipe.stage.recipes import file_recipe
from facepipe.verbs.array_file import read_arrays, write_arrays
from facepipe.verbs.whole_faces import whole_face


def test_a_project_becomes_the_actor(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = rebuilt(capsys, project)
    out = project.parent / "anna.usda"
    face = whole_face(facepipe.open(out).parts(), "anna")
    places, _ = scan_domes.grid(31)
    skin = len(places)
    truth = scan_domes.dome(places, PERSON)
    assert np.abs(face.points[:skin] - truth).mean() < 0.1
    template = whole_face(scan_domes.face(), "head").deltas["jawOpen"][:skin]
    before = np.linalg.norm(template - motion(places), axis=1).mean()
    after = np.linalg.norm(face.deltas["jawOpen"][:skin] - motion(places), axis=1).mean()
    assert after < 0.5 * before
    assert set(printed["stages"]) == {"neutral", "expressions/open", "shapes"}  # type: ignore[call-overload]
    assert printed["stages"]["shapes"]["unseen"] == ["smile"]  # type: ignore[index]
    assert validate(out) == ()
    recipe = file_recipe(out).recipe
    assert recipe is not None
    assert (recipe.verb, recipe.sources[0], len(recipe.sources)) == ("rebuild", "./anna.toml", 7)
    assert found_of(recipe)["quality"] == printed["quality"]


def test_edit_changes_what_is_given(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rebuilt(capsys, project)
    edited, joint = (project.parent / name for name in ("edited.usda", "joint.usda"))
    done(capsys, "rebuild", "--edit", project.parent / "anna.usda", "--joint", "-o", edited, quiet=False)
    done(capsys, "rebuild", project, "--joint", "-o", joint, quiet=False)
    assert edited.read_bytes() == joint.read_bytes() != (project.parent / "anna.usda").read_bytes()


def test_only_what_changed_is_done_again(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert rebuilt(capsys, project)["reused"] == []
    first = (project.parent / "anna.usda").read_bytes()
    stages = ["neutral", "template", "expressions/open", "shapes"]
    assert rebuilt(capsys, project)["reused"] == stages
    assert (project.parent / "anna.usda").read_bytes() == first
    project.write_text(PROJECT.replace("weight_spread = 0", "weight_spread = 0.05"))
    assert rebuilt(capsys, project)["reused"] == stages[:3]
    (project.parent / "open.landmarks.json").write_text((project.parent / "open.landmarks.json").read_text() + "\n")
    # landmarks written otherwise are the same places: what comes of them is the same, and so is what follows
    assert rebuilt(capsys, project)["reused"] == [*stages[:2], "shapes"]


def test_each_step_has_a_line_in_logs(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "rebuild", project, "-o", project.parent / "anna.usda", "--verbose")
    assert code == 0
    steps = [line.partition(" ms: rebuild: step ")[2] for line in err.splitlines() if ": rebuild: step " in line]
    assert steps == ["1 of 4: neutral", "2 of 4: template", "3 of 4: expressions/open", "4 of 4: shapes"]


def test_bars_that_can_name_steps_do() -> None:
    plain, named = mock.Mock(spec=["update"]), mock.Mock(spec=["update", "set_postfix_str"])
    for bar in (plain, named):
        _named_steps(bar, 4)("neutral")
        bar.update.assert_called_once_with()
    named.set_postfix_str.assert_called_once_with("neutral")


def test_expressions_follow_the_place_of_a_corrected_neutral(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The size of the neutral's scan is that of the expressions' too."""
    rebuilt(capsys, project)
    shutil.copyfile(project.parent / "anna/neutral.usdc", project.parent / "anna/corrections/neutral.usdc")
    rebuilt(capsys, project)
    project.write_text(PROJECT.replace('unit = "cm"', 'unit = "auto"'))
    assert rebuilt(capsys, project)["reused"] == ["template"]


@pytest.mark.parametrize(
    "lost", ["points", *(pytest.param(name, marks=pytest.mark.slow) for name in ("place", "report"))]
)
def test_results_that_someone_else_wrote_are_made_anew(
    project: Path, capsys: pytest.CaptureFixture[str], lost: str
) -> None:
    """Of the right key and with a sound sum, yet not what the stage keeps."""
    text = project.read_text()
    project.write_text(text[: text.index("[expressions.open")] + text[text.index("[options") :])
    rebuilt(capsys, project)
    made, path = (project.parent / "anna.usda").read_bytes(), project.parent / "anna" / "neutral.fpstage"
    arrays, content = read_arrays(path, KIND)
    content["content"].pop(lost, None)
    write_arrays(path, KIND, content, {name: one for name, one in arrays.items() if name != lost})
    assert "neutral" not in rebuilt(capsys, project)["reused"]
    assert (project.parent / "anna.usda").read_bytes() == made


def test_layers_below_the_template_count(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base = project.parent / "base.usda"
    (project.parent / "head.usda").rename(base)
    with facepipe.open(base).deriving(project.parent / "head.usda"):
        pass
    rebuilt(capsys, project)
    assert len(rebuilt(capsys, project)["reused"]) == 4  # type: ignore[arg-type]
    base.write_text(base.read_text() + "# another\n")
    assert rebuilt(capsys, project)["reused"] == []


def test_a_neutral_is_refined_where_the_project_says_so(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rebuilt(capsys, project)
    first = whole_face(facepipe.open(project.parent / "anna.usda").parts(), "anna").points
    project.write_text(f"{PROJECT}[options.refinement]\nregions = ['all']\ndetail_mm = 6\n")
    printed = rebuilt(capsys, project)
    assert printed["reused"] == ["neutral"]
    refined = printed["stages"]["refined"]  # type: ignore[index]
    assert refined["surface_mean_mm"] <= refined["before_mean_mm"]
    assert printed["quality"]["surface_mean_mm"] == refined["quality"]["surface_mean_mm"]  # type: ignore[index]
    second = whole_face(facepipe.open(project.parent / "anna.usda").parts(), "anna").points
    assert np.abs(second - first).max() == pytest.approx(refined["moved_max_mm"], abs=0.01)
    assert 0.0 < np.abs(second - first).max() < 0.5
    text = done(capsys, "rebuild", project, "-o", project.parent / "anna.usda", "--force", quiet=False)
    assert "neutral refined at 961 points" in text
    assert "reused: neutral, refined, template, expressions/open, shapes" in text
    project.write_text(f"{PROJECT}[options.refinement]\nregions = ['nose']\n")
    err = failed(capsys, "rebuild", project, "-o", project.parent / "anna.usda", "--force", folder=project.parent)
    assert "anna.toml -> options.refinement -> region nose: no such region, expected one of all" in err


def test_a_corrected_refined_neutral_is_taken_as_it_is(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    project.write_text(f"{PROJECT}[options.refinement]\n")
    rebuilt(capsys, project)
    work = project.parent / "anna"
    shutil.copyfile(work / "neutral.usdc", work / "corrections/refined.usdc")
    printed = rebuilt(capsys, project)
    assert printed["corrected"] == ["refined"]
    shown = whole_face(facepipe.open(work / "neutral.usdc").parts(), "neutral").points
    found = whole_face(facepipe.open(project.parent / "anna.usda").parts(), "anna").points
    assert np.allclose(found, shown, atol=1e-4)


def test_corrected_meshes_take_the_place_of_results(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rebuilt(capsys, project)
    work = project.parent / "anna"
    shown = facepipe.open(work / "neutral.usdc").parts()
    head = shown.meshes[0]
    sculpted = np.array(head.points)
    sculpted[400] += (0.0, 0.0, 3.0)
    save_parts(
        replace(shown, meshes=(replace(head, points=sculpted), *shown.meshes[1:])), work / "corrections/neutral.usdc"
    )
    printed = rebuilt(capsys, project)
    assert printed["corrected"] == ["neutral"]
    assert printed["reused"] == ["neutral"]
    found = whole_face(facepipe.open(project.parent / "anna.usda").parts(), "anna").points
    assert np.allclose(found[400], sculpted[400], atol=1e-4)

    (work / "corrections/shapes").mkdir()
    shape = replace(shown, meshes=(replace(head, points=sculpted - (0.0, 1.0, 0.0)), *shown.meshes[1:]))
    save_parts(shape, work / "corrections/shapes/smile.usdc")
    save_parts(shape, work / "corrections/shapes/frown.usdc")
    printed = rebuilt(capsys, project)
    assert printed["corrected"] == ["neutral", "shapes/smile"]
    assert f"{work}/corrections/shapes/frown: corrects no result" in printed["warnings"]  # type: ignore[operator]
    delta = whole_face(facepipe.open(project.parent / "anna.usda").parts(), "anna").deltas["smile"]
    assert np.allclose(delta[: len(sculpted)], [0.0, -1.0, 0.0], atol=1e-4)


def test_a_correction_of_another_topology_is_refused(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rebuilt(capsys, project)
    kept = (project.parent / "anna.usda").read_bytes()
    shown = facepipe.open(project.parent / "anna/neutral.usdc").parts()
    save_parts(replace(shown, meshes=shown.meshes[:1]), project.parent / "anna/corrections/neutral.usdc")
    code, _, err = run(capsys, "rebuild", project, "-o", project.parent / "anna.usda", "--force")
    assert code == 2
    assert "corrections/neutral.usdc: no mesh 'Eye', expected the meshes of" in err
    assert (project.parent / "anna.usda").read_bytes() == kept


def test_an_expression_that_fails_keeps_the_stages_before(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = (project.parent / "open.landmarks.json").read_text()
    (project.parent / "open.landmarks.json").write_text('{"scheme": "multipie68", "points": []}')
    code, _, err = run(capsys, "rebuild", project, "-o", project.parent / "anna.usda")
    assert code == 2
    assert err.count("\n") == 1
    assert not (project.parent / "anna.usda").exists()
    (project.parent / "open.landmarks.json").write_text(good)
    assert rebuilt(capsys, project)["reused"] == ["neutral", "template"]


@pytest.mark.parametrize("name", ["neutral", "open"])
def test_a_scan_of_something_else_is_named(project: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    points, triangles = ball(24, 5.0)
    write_ply(Scan(name=name, points=points, triangles=triangles.astype(np.int32)), project.parent / f"{name}.ply")
    code, _, err = run(capsys, "rebuild", project, "-o", project.parent / "anna.usda")
    assert (code, err.count("\n")) == (2, 1)
    assert f"{name}.ply -> scan: 0 points of the face find a place on it" in err
    assert not (project.parent / "anna.usda").exists()


def test_a_neutral_alone_gives_the_shapes_of_the_template(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    project.write_text(PROJECT.split("[expressions.open]")[0])
    printed = rebuilt(capsys, project)
    assert set(printed["stages"]) == {"neutral"}  # type: ignore[call-overload]
    face = whole_face(facepipe.open(project.parent / "anna.usda").parts(), "anna")
    assert set(face.deltas) == {"jawOpen", "smile"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        pytest.param(
            "jawOpen = 1",
            "jawShut = 1",
            "expressions -> open -> weights -> jawShut: no such shape, expected one of jawOpen",
            id="shape",
        ),
        pytest.param(
            "[options.split]",
            "[options.refinement]\nregions = ['nose']\n[options.split]",
            "region nose: no such region",
            id="region",
        ),
        pytest.param(
            'unit = "cm"',
            'unit = "mm"',
            "neutral.ply: was given in mm, but has the size of a face in cm",
            id="unit",
        ),
    ],
)
def test_bad_projects_are_reported_before_the_first_fit(
    project: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, message: str
) -> None:
    project.write_text(PROJECT.replace(old, new))
    code, _, err = run(capsys, "rebuild", project, "-o", project.parent / "anna.usda")
    assert (code, err.count("\n")) == (2, 1)
    assert message in err
    assert not (project.parent / "anna.usda").exists()
    assert not list(project.parent.rglob("*.fpstage"))
