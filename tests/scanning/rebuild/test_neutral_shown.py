"""Neutrals from scans that show more than a neutral: shapes that are named are taken off again."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import expression_domes
import numpy as np
import pytest
import scan_domes
from command_line import done, failed
from expression_domes import OWN, PERSON, SIDE

import facepipe
from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_landmarks import read_scan_landmarks
from facepipe.kinds import found_of
from facepipe.scanning.database import save_database
from facepipe.scanning.rebuild import (
    ExpressionScan,
    Rebuild,
    Rebuilt,
    Template,
    read_project,
    register_scan,
)
from facepipe.scanning.rebuild.register_scans import placed_neutral
from facepipe.scanning.rebuild.scan_fit import scan_distances
from facepipe.scans import ScanLandmarks
from facepipe.stage import save_parts
from facepipe.verbs.whole_faces import whole_face, whole_points

SHOWN = 0.8  # of the person's own brows, which the neutral's scan has up
GIVEN = SHOWN * OWN["browUp"]  # the same by the template's shape
DOME = SIDE**2
PROJECT = f"""
template = "head.usda"
database = "faces.fpdb"
[neutral]
scan = "anna.ply"
weights = {{ browUp = {GIVEN} }}
[expressions.open]
scan = "open.ply"
weights = {{ jawOpen = 1 }}
[options.neutral]
unit = "cm"
"""


@pytest.fixture(scope="session")
def drawer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shown")
    save_parts(expression_domes.face(), folder / "head.usda")
    save_database(scan_domes.database(), folder / "faces.fpdb")
    expression_domes.put(folder / "anna.ply", {"browUp": SHOWN})
    expression_domes.put(folder / "open.ply", {"jawOpen": 1.0})
    (folder / "anna.toml").write_text(PROJECT)
    return folder


def truth() -> np.ndarray:
    return scan_domes.dome(scan_domes.grid(SIDE)[0], PERSON)


def lifted() -> np.ndarray:
    """(n, 3) of the person's brows as the scan shows them."""
    return GIVEN * expression_domes.template_motion("browUp")


def fitted(drawer: Path, out: Path, capsys: pytest.CaptureFixture[str], *more: object) -> tuple[np.ndarray, dict]:
    files = ("--template", drawer / "head.usda", "--database", drawer / "faces.fpdb", "-o", out)
    text = done(capsys, "fit-neutral", drawer / "anna.ply", *files, "--unit", "cm", "--json", *more, quiet=False)
    return whole_points(facepipe.open(out).parts())[:DOME], json.loads(text)


def test_what_is_named_is_not_in_the_neutral(drawer: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    without, printed = fitted(drawer, tmp_path / "without.usda", capsys)
    assert printed["weights"] == {}
    named, printed = fitted(drawer, tmp_path / "named.usda", capsys, "--weights", f"browUp={GIVEN}")
    brows = np.linalg.norm(lifted(), axis=1) > 1.0
    errors = [np.linalg.norm(one - truth(), axis=1)[brows].mean() for one in (named, without)]
    assert errors[0] < 0.25 * errors[1]
    assert printed["weights"]["browUp"] == pytest.approx(GIVEN, abs=0.1)
    recipe = facepipe.open(tmp_path / "named.usda").parts().recipe
    assert recipe is not None
    assert recipe.options["weights"] == {"browUp": GIVEN}
    assert found_of(recipe)["weights"] == printed["weights"]


def test_the_picture_shows_what_the_scan_does(
    drawer: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[SimpleNamespace] = []

    def draw(path: Path, **shown: Any) -> None:
        path.write_bytes(b"")
        drawn.append(SimpleNamespace(**shown))

    monkeypatch.setattr("facepipe.scanning.rebuild.scan_fit.draw_face_on_scan", draw)
    more = ("--weights", f"browUp={GIVEN}", "--picture", tmp_path / "sheet.png")
    neutral, _ = fitted(drawer, tmp_path / "named.usda", capsys, *more)
    (shown,) = drawn
    assert shown.neutral is not None
    assert np.abs(shown.neutral[:DOME] - neutral).max() < 1e-3
    assert np.abs(shown.points[:DOME] - neutral - lifted()).max() < 0.5
    assert np.nanmean(scan_distances(shown.template, shown.points, shown.scan, shown.place)) < 0.05


def test_bad_weights_give_one_line(drawer: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = ("--template", drawer / "head.usda", "--database", drawer / "faces.fpdb", "-o", tmp_path / "out.usda")
    for word, text in (("eyeBlink=1", "no such shape, expected one of"), ("browUp=3", "above 0, up to 2"), ("x", "x")):
        assert text in failed(capsys, "fit-neutral", drawer / "anna.ply", *files, "--weights", word, folder=tmp_path)


def test_markers_lie_where_the_scan_shows_them(drawer: Path) -> None:
    """Markers on lifted brows would be taken for those of skin above."""
    template = Template.of(expression_domes.face(), "head")
    places = np.array([(x, y) for x in (-20.0, 0.0, 20.0) for y in (20.0, 26.0, 32.0)])
    dome = scan_domes.dome(places, PERSON)
    up = GIVEN * expression_domes.motion("browUp", places)
    marks = read_scan_landmarks(drawer / "anna.landmarks.json").points
    seen = {f"m{i}": one for i, one in enumerate(scan_domes.POSE.apply(dome + up))}
    scan, known = read_scan(drawer / "anna.ply"), ScanLandmarks(points=marks, markers=seen)
    whole = _whole(template, truth())
    opened, landmarks = expression_domes.scan({"jawOpen": 1.0})
    points = landmarks.points.copy()
    points[17:27] = np.nan  # brows are known by markers alone
    own = {f"m{i}": one for i, one in enumerate(scan_domes.POSE.apply(dome))}
    given = ExpressionScan(scan=opened, landmarks=ScanLandmarks(points=points, markers=own), weights={"jawOpen": 1.3})
    deltas = whole_face(expression_domes.face(), "head").deltas
    brows, errors = np.linalg.norm(lifted(), axis=1) > 1.0, []
    for expression in (_lift(template), None):
        neutral = placed_neutral(template, whole, scan, known, expression)
        composite, _, _ = register_scan(template, neutral, deltas, given)
        found = composite.points[:DOME]
        errors.append(np.linalg.norm(found - truth(), axis=1)[brows].mean())
    assert errors[0] < 0.5 * errors[1]


def rebuilt(folder: Path) -> Rebuilt:
    project = read_project(folder / "anna.toml")
    template = Template.of(facepipe.open(folder / "head.usda").parts(), "head.usda")
    with mock.patch("facepipe.scanning.rebuild.rebuild.landmarks_of", side_effect=AssertionError):
        return Rebuild(project, template)()


def check_brows(found: Rebuilt) -> None:
    """They are where they are, and where the scan shows them."""
    brows = np.linalg.norm(lifted(), axis=1) > 1.0
    assert np.linalg.norm(found.neutral[:DOME] - truth(), axis=1)[brows].mean() < 0.2
    assert np.linalg.norm(found.shown[:DOME] - truth() - lifted(), axis=1)[brows].mean() < 0.2


def test_a_project_takes_off_what_its_neutrals_scan_shows(drawer: Path, tmp_path: Path) -> None:
    """Corrected neutrals keep what the scan shows besides."""
    shutil.copytree(drawer, tmp_path, dirs_exist_ok=True)
    first = rebuilt(tmp_path)
    check_brows(first)
    assert first.reports["neutral"]["weights"]["browUp"] == pytest.approx(GIVEN, abs=0.1)
    assert rebuilt(tmp_path).reused == ("neutral", "template", "expressions/open", "shapes")
    parts = facepipe.open(tmp_path / "anna" / "neutral.usdc").parts()
    save_parts(parts, tmp_path / "anna" / "corrections" / "neutral.usdc")
    again = rebuilt(tmp_path)
    assert again.corrected == ("neutral",)
    assert np.abs(again.shown - first.shown).max() < 1e-3
    (tmp_path / "anna.toml").write_text(PROJECT.replace(f"browUp = {GIVEN}", "browUp = 0.5"))
    assert "neutral" not in rebuilt(tmp_path).reused


def test_a_refined_neutral_is_without_it_too(drawer: Path, tmp_path: Path) -> None:
    shutil.copytree(drawer, tmp_path, dirs_exist_ok=True)
    (tmp_path / "anna.toml").write_text(PROJECT + "[options.refinement]\n")
    found = rebuilt(tmp_path)
    assert "refined" in found.reports
    check_brows(found)


def test_fitted_together_and_refined_it_is_known_by_its_shapes(drawer: Path, tmp_path: Path) -> None:
    shutil.copytree(drawer, tmp_path, dirs_exist_ok=True)
    (tmp_path / "anna.toml").write_text("joint = true\n" + PROJECT + "[options.refinement]\n")
    found = rebuilt(tmp_path)
    weights = found.reports["neutral"]["weights"]
    assert set(weights) == {"browUp"}
    assert weights["browUp"] == pytest.approx(GIVEN, abs=0.1)
    check_brows(found)


def _whole(template: Template, dome: np.ndarray) -> np.ndarray:
    points = template.points.copy()
    points[:DOME] = dome
    return points


def _lift(template: Template) -> np.ndarray:
    delta = np.zeros_like(template.points)
    delta[:DOME] = lifted()
    return delta


def test_register_scan_takes_the_neutrals_weights(
    drawer: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fitted(drawer, tmp_path / "anna.usda", capsys, "--weights", f"browUp={GIVEN}")
    personal = ("personal-template", tmp_path / "anna.usda", "--template", drawer / "head.usda")
    done(capsys, *personal, "-o", tmp_path / "personal.usda", quiet=False)
    words = ("register-scan", drawer / "open.ply", "--personal", tmp_path / "personal.usda", "--weights", "jawOpen=1")
    shown = ("--neutral-weights", f"browUp={GIVEN}")
    err = failed(capsys, *words, "-o", tmp_path / "open.usda", *shown, folder=tmp_path)
    assert "--neutral-weights: expected --neutral-scan beside it" in err
    more = ("--neutral-scan", drawer / "anna.ply", *shown, "--json")
    out = done(capsys, *words, "-o", tmp_path / "open.usda", *more, quiet=False)
    assert json.loads(out)["fit"]["mm_per_unit"] == pytest.approx(10.0, rel=0.01)
    recipe = facepipe.open(tmp_path / "open.usda").parts().recipe
    assert recipe is not None
    assert recipe.options["neutral_weights"] == {"browUp": GIVEN}


def test_distances_are_those_of_the_skins_rows_and_none_elsewhere() -> None:
    template, (scan, _) = Template.of(scan_domes.face(), "head"), scan_domes.scan(PERSON)
    by_row = np.arange(len(template.rows)) + 1.0
    with mock.patch("facepipe.scanning.rebuild.scan_fit.row_distances", return_value=by_row):
        distances = scan_distances(template, template.points, scan, scan_domes.POSE)
    expected = np.full(len(template.points), np.nan)
    expected[template.rows] = by_row
    np.testing.assert_array_equal(distances, expected)
