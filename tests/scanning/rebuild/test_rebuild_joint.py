"""`facepipe rebuild --joint`: one neutral of several scans."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import expression_domes
import numpy as np
import pytest
import scan_domes
from command_line import done
from expression_domes import OWN, PERSON
from faces import with_head
from scan_domes import POSE

import facepipe
from facepipe.core.errors import FitError, InputError
from facepipe.geometry.closest_points import closest_places
from facepipe.importers.scan_landmarks import read_scan_landmarks, write_scan_landmarks
from facepipe.importers.scan_ply import write_ply
from facepipe.scanning.database import save_database
from facepipe.scanning.rebuild import (
    ExpressionScan,
    NeutralScan,
    Rebuild,
    Template,
    fit_together,
    read_project,
    register_scan,
    starting_shapes,
)
from facepipe.scanning.rebuild.fit_neutral import fit_neutral
from facepipe.scans import Scan, ScanLandmarks
from facepipe.stage import save_parts
from facepipe.verbs.whole_faces import whole_face

BUMP = np.array([-4.0, 30.0])  # on the brow, away from what jawOpen moves
PROJECT = """
template = "head.usda"
database = "faces.fpdb"
joint = true
[neutral]
scan = "anna.ply"
[expressions.open]
scan = "open.ply"
weights = { jawOpen = 0.8 }
"""
STAGES = ["alone/neutral", "alone/template", "alone/expressions/open", "neutral", "template", "expressions/open"]


def person(places: np.ndarray) -> np.ndarray:
    """(n, 3) someone with a bump that the database has not."""
    points = scan_domes.dome(places, PERSON)
    points[:, 2] += 4.0 * np.exp(-((places - BUMP) ** 2).sum(axis=1) / 40.0)
    return points


def scanned(jaw_open: float, *, hole: bool) -> tuple[Scan, ScanLandmarks]:
    """The person, perhaps with a hole where the bump is."""
    places, triangles = scan_domes.grid(61)
    marks = scan_domes.face().meshes[0].landmarks["multipie68"].indices

    def seen(places: np.ndarray) -> np.ndarray:
        return POSE.apply(person(places) + jaw_open * OWN["jawOpen"] * expression_domes.motion("jawOpen", places))

    if hole:
        middles = places[triangles].mean(axis=1)
        triangles = triangles[np.linalg.norm(middles - BUMP, axis=1) > 11.0]
        used, flat = np.unique(triangles, return_inverse=True)
        places, triangles = places[used], flat.reshape(-1, 3)
    scan = Scan(name="scan", points=seen(places), triangles=triangles.astype(np.int32))
    return scan, ScanLandmarks(points=seen(scan_domes.grid(expression_domes.SIDE)[0][marks]))


def test_what_the_neutrals_scan_lacks_is_taken_from_an_expression() -> None:
    template, database = Template.of(expression_domes.face(), "head.usda"), scan_domes.database()
    scan, landmarks = scanned(0.0, hole=True)
    first, _, alone = fit_neutral(template, scan, landmarks, database)
    shapes = starting_shapes(template, first.points)
    opened, marks = scanned(0.8, hole=False)
    given = ExpressionScan(scan=opened, landmarks=marks, weights={"jawOpen": 0.8})
    _, place, _ = register_scan(template, first, shapes, given)
    placed = replace(given, place=place)
    coefficients = np.array(alone.coefficients)
    fit, _, others, _ = fit_together(template, scan, first, coefficients, database, shapes, [placed])
    places, _ = scan_domes.grid(expression_domes.SIDE)
    near = np.linalg.norm(places - BUMP, axis=1) < 8.0
    fine, triangles = scan_domes.grid(121)

    def off(fit: NeutralScan) -> np.ndarray:
        """From the true surface: where a point lies along a bump that no landmark is on, no scan shows."""
        assert fit.place is not None
        home = POSE.undo(fit.place.undo(fit.points[: len(places)]))
        return np.asarray(closest_places(home, person(fine), triangles).distances)

    before, after = off(first), off(fit)
    assert before[near].mean() > 1.0
    assert after[near].mean() < 0.1 * before[near].mean()
    assert after[~near].mean() < 0.1
    (other,) = others
    assert other.weights[0] == pytest.approx(0.8 * OWN["jawOpen"], abs=0.1)
    assert np.allclose(other.place.rotation, POSE.rotation.T, atol=0.02)
    with pytest.raises(InputError, match="no expressions or no place of it, expected both"):
        fit_together(template, scan, first, coefficients, database, shapes, [])
    elsewhere = replace(place, translation=place.translation + 500.0)
    away = replace(given, place=elsewhere, scan=replace(opened, name="open.ply"))
    with pytest.raises(FitError, match=r"^open\.ply -> scan: 0 points of the face find a place on it"):
        fit_together(template, scan, first, coefficients, database, shapes, [away])


@pytest.fixture(scope="module")
def drawer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("joint")
    save_parts(expression_domes.face(), folder / "head.usda")
    save_database(scan_domes.database(), folder / "faces.fpdb")
    for name, (scan, landmarks) in {"anna": scanned(0.0, hole=True), "open": scanned(0.8, hole=False)}.items():
        write_ply(scan, folder / f"{name}.ply")
        write_scan_landmarks(landmarks, folder / f"{name}.landmarks.json")
    return folder


def rebuilt(capsys: pytest.CaptureFixture[str], project: Path, *more: object) -> dict[str, object]:
    out = done(capsys, "rebuild", project, "-o", project.with_suffix(".usda"), "--json", "--force", *more, quiet=False)
    return dict(json.loads(out))


def test_a_joint_rebuild_keeps_and_reuses_its_stages(drawer: Path, capsys: pytest.CaptureFixture[str]) -> None:
    project = drawer / "anna.toml"
    project.write_text(PROJECT)
    printed = rebuilt(capsys, project)
    assert printed["reused"] == []
    together = printed["stages"]["neutral"]["together"]  # type: ignore[index]
    assert together["moved_mean_mm"] > 0.0
    assert set(together["weights"]["open"]) == {"jawOpen"}
    first = project.with_suffix(".usda").read_bytes()
    assert rebuilt(capsys, project)["reused"] == [*STAGES, "shapes"]
    assert project.with_suffix(".usda").read_bytes() == first

    project.write_text(PROJECT.replace("joint = true", ""))
    assert "together" not in rebuilt(capsys, project)["stages"]["neutral"]  # type: ignore[index]
    assert rebuilt(capsys, project, "--joint")["reused"] == STAGES[:3]
    assert rebuilt(capsys, project, "--joint")["reused"] == [*STAGES, "shapes"]

    shown = facepipe.open(project.with_suffix("") / "neutral.usdc").parts()
    sculpted = np.array(shown.meshes[0].points)
    sculpted[400] += (0.0, 0.0, 3.0)
    own = with_head(shown, points=sculpted)
    save_parts(own, project.with_suffix("") / "corrections/neutral.usdc")
    printed = rebuilt(capsys, project, "--joint")
    assert (printed["corrected"], printed["reused"]) == (["neutral"], STAGES[:4])
    found = whole_face(facepipe.open(project.with_suffix(".usda")).parts(), "anna").points
    assert np.allclose(found[400], sculpted[400], atol=1e-4)


def test_landmarks_found_on_the_neutrals_scan_count_after_an_interruption_too(
    drawer: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("head.usda", "faces.fpdb", "anna.ply", "open.ply", "open.landmarks.json"):
        shutil.copyfile(drawer / name, tmp_path / name)
    (tmp_path / "anna.toml").write_text(PROJECT)
    project = read_project(tmp_path / "anna.toml")
    asked = []

    def landmarks_of(file: Path | None, scan: Scan) -> tuple[ScanLandmarks, tuple[str, ...]]:
        asked.append(Path(scan.name).name)
        return read_scan_landmarks(drawer / "anna.landmarks.json"), ()

    monkeypatch.setattr("facepipe.scanning.rebuild.rebuild.landmarks_of", landmarks_of)
    template = Template.of(expression_domes.face(), "head.usda")
    first = Rebuild(project, template)()
    assert asked == ["anna.ply"]
    (tmp_path / "anna/neutral.fpstage").unlink()
    second = Rebuild(project, template)()
    assert "alone/neutral" in second.reused
    assert "neutral" not in second.reused
    assert np.array_equal(second.neutral, first.neutral)


def test_of_the_fits_alone_only_the_neutral_can_be_corrected(
    drawer: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(drawer, tmp_path / "drawer")
    project = tmp_path / "drawer/own.toml"
    project.write_text(PROJECT)
    rebuilt(capsys, project)
    work = project.with_suffix("")
    for name in ("alone/neutral", "alone/expressions/open"):
        (work / "corrections" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(work / f"{name}.usdc", work / f"corrections/{name}.usdc")
    printed = rebuilt(capsys, project)
    assert printed["corrected"] == ["alone/neutral"]
    assert f"{work}/corrections/alone/expressions/open: corrects no result" in printed["warnings"]  # type: ignore[operator]


def test_without_expressions_there_is_nothing_to_fit_together(
    drawer: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project = drawer / "bare.toml"
    project.write_text(PROJECT.split("[expressions.open]")[0])
    assert set(rebuilt(capsys, project)["stages"]) == {"neutral"}  # type: ignore[call-overload]
    assert not (drawer / "bare/alone").exists()


@pytest.mark.slow
def test_all_scans_together_make_a_truer_neutral() -> None:
    """Of an actor that the database can't show, from a neutral and six expressions."""
    from ict_people import ict_database, ict_template, ours, read
    from scan_actors import COMPOSITES, Actor, ict
    from scan_simulator import simulate

    template = ict_template()
    database, actor = ict_database(template), Actor(101)
    scanned = simulate(actor.neutral, 101)
    scan, landmarks = read("neutral", scanned)
    first, _, alone = fit_neutral(template, scan, landmarks, database)
    shapes, placed = starting_shapes(template, first.points), []
    for number, name in enumerate(("smile", "closed_eyes", "pucker", "brows_up", "funnel", "sad")):
        one, marks = read(name, simulate(actor.composite(COMPOSITES[name]), 10100 + number))
        given = ExpressionScan(scan=one, landmarks=marks, weights=ours(COMPOSITES[name]))
        _, place, _ = register_scan(template, first, shapes, given)
        placed.append(replace(given, place=place))
    found, _, _, _ = fit_together(template, scan, first, np.array(alone.coefficients), database, shapes, placed)

    def off(points: np.ndarray, place: object) -> float:
        home = scanned.pose.undo(place.undo(points))  # type: ignore[attr-defined]
        return float(np.linalg.norm(home - actor.neutral, axis=1)[: ict().full_face].mean())

    before, after = off(first.points, first.place), off(found.points, found.place)
    print(f"alone {before:.3f} mm, together {after:.3f} mm")
    assert after < 0.96 * before
