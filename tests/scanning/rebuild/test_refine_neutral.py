"""`facepipe refine-neutral`: a neutral, or a region of it, drawn closer to its scan."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scan_domes
from command_line import done, failed
from faces import with_head, with_meshes
from rebuild_project import opening
from scan_domes import POSE, dome, grid

import facepipe
from facepipe.checks import validate
from facepipe.core.errors import FitError, InputError
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.similarity import Similarity
from facepipe.importers.scan_landmarks import write_scan_landmarks
from facepipe.importers.scan_ply import write_ply
from facepipe.kinds import found_of
from facepipe.parts import FaceParts, Recipe
from facepipe.scanning.database import Quality
from facepipe.scanning.rebuild import RefineNeutralOptions, Template
from facepipe.scanning.rebuild.refine_neutral import flipped_before, refine_neutral
from facepipe.scanning.rebuild.template import region_weights, shown_before
from facepipe.scans import Scan, ScanLandmarks
from facepipe.stage import save_parts
from facepipe.stage.recipes import source_digest
from facepipe.verbs.whole_faces import whole_points

_PERSON = 9
_OWN = grid(31)[0]
_QUALITY = Quality(surface_mean_mm=0.1, surface_p95_mm=0.4, coverage=0.9, flipped_triangles=3)
_ABOUT_RIGHT = RefineNeutralOptions(drift_mm=2.0)


def _bumped(side: int) -> np.ndarray:
    """The person, with a bump along the normals that the neutral lacks."""
    places, triangles = grid(side)
    points = dome(places, _PERSON)
    up = 1.5 * np.maximum(1.0 - (np.linalg.norm(places - (-18.0, -5.0), axis=1) / 14.0) ** 2, 0.0) ** 2
    return np.asarray(points + up[:, None] * point_normals(points, triangles))


def _neutral() -> FaceParts:
    """The person as fitted, with a soft region around the bump, and what lies right and left of it."""
    parts = scan_domes.face(_PERSON)
    bump = np.clip((24.0 - np.linalg.norm(_OWN - (-18.0, -5.0), axis=1)) / 6.0, 0.0, 1.0)
    right = (1.0 - bump) * (_OWN[:, 0] > -30.0)
    regions = {"bump": bump, "right": right, "left": 1.0 - bump - right}
    regions = {name: mask.astype(np.float32) for name, mask in regions.items()}
    recipe = Recipe(verb="fit-neutral", options={"found": {"quality": _QUALITY.__dict__}})
    return replace(with_head(parts, regions=regions), recipe=recipe)


def _scan() -> tuple[Scan, ScanLandmarks]:
    """The bumped person; landmarks where they truly are."""
    marks = _bumped(31)[_neutral().meshes[0].landmarks["multipie68"].indices]
    _, triangles = grid(81)
    scan = Scan(name="scan", points=POSE.apply(_bumped(81)), triangles=triangles.astype(np.int32))
    return scan, ScanLandmarks(points=POSE.apply(marks))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_parts(_neutral(), tmp_path / "anna.usda")
    scan, landmarks = _scan()
    write_ply(scan, tmp_path / "anna.ply")
    write_scan_landmarks(landmarks, tmp_path / "anna.landmarks.json")
    return tmp_path


def _words(folder: Path, *more: object) -> tuple[object, ...]:
    return ("refine-neutral", folder / "anna.usda", folder / "anna.ply", "-o", folder / "out.usda", *more)


def test_a_region_goes_to_its_scan_and_all_else_stays(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = done(capsys, *_words(folder, "--region", "bump", "--json"))
    printed = json.loads(out)
    before, after = (facepipe.open(folder / name).parts() for name in ("anna.usda", "out.usda"))
    inside = before.meshes[0].regions["bump"] > 0
    old, new = before.meshes[0].points, after.meshes[0].points
    assert np.array_equal(old[~inside], new[~inside])
    assert np.array_equal(before.meshes[1].points, after.meshes[1].points)
    truth = 0.1 * _bumped(31)
    off = [10.0 * np.linalg.norm(one - truth, axis=1)[inside] for one in (old, new)]
    assert off[1].mean() < 0.4 * off[0].mean()
    assert printed["surface_mean_mm"] < 0.15 * printed["before_mean_mm"]
    assert printed["points"] == inside.sum()
    assert printed["moved_max_mm"] > 1.0
    assert (printed["regions"], printed["flipped_triangles"], printed["missed"]) == (["bump"], 0, [])
    assert validate(folder / "out.usda") == ()


def test_the_recipe_shows_what_was_refined(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = done(capsys, *_words(folder, "--region", "bump", "right", "--detail-mm", 7, "--json"))
    recipe = facepipe.open(folder / "out.usda").parts().recipe
    assert recipe is not None
    assert recipe.verb == "refine-neutral"
    assert recipe.sources == ("./anna.usda", "./anna.ply", "./anna.landmarks.json")
    assert recipe.digests == tuple(source_digest(folder / source) for source in recipe.sources)
    assert recipe.options["regions"] == ["bump", "right"]
    assert recipe.options["detail_mm"] == 7.0
    assert found_of(recipe)["quality"] == json.loads(out)["quality"]
    assert found_of(recipe)["quality"]["flipped_triangles"] == _QUALITY.flipped_triangles


def test_a_recipe_gives_what_an_earlier_step_found() -> None:
    found = {"quality": _QUALITY.__dict__, "weights": {"jawOpen": 0.4}}
    recipe = Recipe(verb="refine-neutral", options={"regions": ["bump"], "found": found})
    assert (flipped_before(recipe), shown_before(recipe)) == (_QUALITY.flipped_triangles, {"jawOpen": 0.4})
    assert (flipped_before(None), shown_before(None)) == (0, {})


def test_edit_changes_what_is_given(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done(capsys, *_words(folder, "--region", "bump", "right"))
    edit = ("refine-neutral", "--edit", folder / "out.usda", "--region", "bump", "--detail-mm", 7)
    done(capsys, *edit, "-o", folder / "edited.usda")
    done(capsys, *_words(folder, "--force", "--region", "bump", "--detail-mm", 7))
    assert (folder / "edited.usda").read_bytes() == (folder / "out.usda").read_bytes()


def test_the_same_call_writes_the_same_bytes(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written = []
    for _ in range(2):
        done(capsys, *_words(folder, "--force"))
        written.append((folder / "out.usda").read_bytes())
    assert written[0] == written[1]


def test_a_picture_and_a_text_show_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = done(capsys, *_words(folder, "--region", "right", "--picture", folder / "out.png"))
    assert "refined" in out
    assert "right: " in out
    assert (folder / "out.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--region", "nose"), "anna.usda -> region nose: no such region, expected one of bump, left, right"),
        (("--detail-mm", "0"), "option detail_mm: is 0.0, expected a number from 0.1 to 1000"),
        (("--landmarks", "few.json"), "few.json"),
    ],
)
def test_bad_input_gives_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], message: str
) -> None:
    assert message in failed(capsys, *_words(folder, *more), folder=folder)


def test_a_face_without_regions_says_so() -> None:
    parts = _neutral()
    bare = with_meshes(parts, regions={})
    assert np.array_equal(region_weights(bare, (), "anna"), np.ones(len(whole_points(parts))))
    with pytest.raises(InputError, match=r"anna -> region nose: no such region, expected a face with regions"):
        region_weights(bare, ("nose",), "anna")


def test_points_follow_as_far_as_their_regions_together() -> None:
    parts = _neutral()
    weights = region_weights(parts, ("bump", "right", "bump"), "anna")
    bump, right = (parts.meshes[0].regions[name] for name in ("bump", "right"))
    assert np.allclose(weights[: len(bump)], np.minimum(bump + right, 1.0))
    assert not weights[len(bump) :].any()


def test_where_the_scan_lies_is_found_and_changes_nothing() -> None:
    """Whether the place is given or found, for a scan that was moved and is in another unit."""
    template, (scan, landmarks) = Template.of(_neutral(), "anna"), _scan()
    points = template.points
    found, place, _ = refine_neutral(template, points, scan, landmarks, options=_ABOUT_RIGHT)
    at_home = replace(scan, points=POSE.undo(scan.points)), ScanLandmarks(points=POSE.undo(landmarks.points))
    again, _, _ = refine_neutral(template, points, *at_home, options=_ABOUT_RIGHT)
    assert np.abs(found - again).max() < 1e-6
    given, _, _ = refine_neutral(template, points, scan, landmarks, place, options=_ABOUT_RIGHT)
    assert np.array_equal(given, found)


def test_an_eyeball_goes_with_the_skin_where_it_may_follow() -> None:
    template, (scan, _) = Template.of(_neutral(), "anna"), _scan()
    raised = replace(scan, points=scan.points + POSE.scale * 0.5 * POSE.rotation[:, 2])
    place = _placed()
    everything, _, _ = refine_neutral(template, template.points, raised, ScanLandmarks(), place)
    eye = template.loose
    moved = everything[eye] - template.points[eye]
    assert np.linalg.norm(moved.mean(axis=0)) > 0.2
    spread = np.linalg.norm(everything[eye] - everything[eye].mean(axis=0), axis=1)
    assert np.allclose(spread, np.linalg.norm(template.points[eye] - template.points[eye].mean(axis=0), axis=1))
    skin = np.ones(len(template.points))
    skin[eye[0]] = 0.0
    without, _, _ = refine_neutral(template, template.points, raised, ScanLandmarks(), place, skin)
    assert np.array_equal(without[eye], template.points[eye])


def _placed() -> Similarity:
    """Where the scans of domes lie."""
    origin = POSE.undo(np.zeros((1, 3)))[0]
    return Similarity(rotation=POSE.rotation.T, translation=origin, scale=1.0 / POSE.scale)


def test_what_the_scan_shows_besides_stays_off_the_neutral(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The mouth of the scan is open; the recipe says so, or --weights."""
    weight, (scan, landmarks) = 0.5, _scan()
    rows = _neutral().meshes[0].landmarks["multipie68"].indices
    opened = replace(scan, points=scan.points + POSE.scale * weight * opening(grid(81)[0]) @ POSE.rotation.T)
    marks = landmarks.points + POSE.scale * weight * opening(_OWN[rows]) @ POSE.rotation.T
    write_ply(opened, folder / "anna.ply")
    write_scan_landmarks(ScanLandmarks(points=marks), folder / "anna.landmarks.json")
    off = []
    found = {"found": {"quality": _QUALITY.__dict__, "weights": {"jawOpen": weight}}}
    for options, more in ((found, ()), ({}, ("--weights", f"jawOpen={weight}")), ({}, ())):
        save_parts(replace(_neutral(), recipe=Recipe(verb="fit-neutral", options=options)), folder / "anna.usda")
        done(capsys, *_words(folder, "--force", *more))
        points = whole_points(facepipe.open(folder / "out.usda").parts())[: len(_OWN)]
        off.append(np.linalg.norm(points - _bumped(31), axis=1).mean())
    assert off[0] == pytest.approx(off[1], abs=1e-6)
    assert off[0] < 0.5 * off[2]


def test_a_scan_that_does_not_show_the_region_is_refused() -> None:
    template, (scan, landmarks) = Template.of(_neutral(), "anna"), _scan()
    shown = scan.triangles[(POSE.undo(scan.points)[scan.triangles][:, :, 0] > 10.0).all(axis=1)]
    weights = region_weights(template.parts, ("bump",), "anna")
    half = replace(scan, triangles=shown)
    with pytest.raises(FitError, match=f"^{scan.name} -> scan: .* points of the face find a place on it"):
        refine_neutral(template, template.points, half, landmarks, _placed(), weights)
    inside = np.zeros(len(template.points))
    inside[template.loose] = 1.0
    with pytest.raises(InputError, match="a scan can show no point that may follow"):
        refine_neutral(template, template.points, scan, landmarks, _placed(), inside)
