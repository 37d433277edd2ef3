"""`facepipe register-scan`: one expression over the personal template."""

from __future__ import annotations

import json
from dataclasses import replace

import expression_domes
import numpy as np
import pytest
import scan_domes
from command_line import done, failed, run
from expression_domes import OWN, PERSON
from rebuild_stages import DOME, SEEN, Files

import facepipe
from facepipe.checks import validate
from facepipe.core.tokens import SCANNED
from facepipe.geometry.similarity import Similarity
from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_landmarks import read_scan_landmarks, write_scan_landmarks
from facepipe.importers.scan_ply import write_ply
from facepipe.performing import read_kept
from facepipe.scanning.rebuild import NeutralScan, Template
from facepipe.scanning.rebuild.declared import RegisterScansOptions
from facepipe.scanning.rebuild.register_scan_action import RegisterScanAction
from facepipe.scanning.rebuild.register_scans import expression_surface, placed_neutral
from facepipe.scans import Scan
from facepipe.verbs.whole_faces import whole_face, whole_points


def test_an_expression_is_a_shape_over_the_personal_template(stages: Files) -> None:
    places = scan_domes.grid(expression_domes.SIDE)[0]
    personal = facepipe.open(stages["personal.usda"])
    for name, weights in SEEN.items():
        face = facepipe.open(stages[f"{name}.usda"])
        assert face.shapes == (*personal.shapes, name)
        assert np.array_equal(whole_points(face.parts()), whole_points(personal.parts()))
        truth = sum(weight * OWN[shape] * expression_domes.motion(shape, places) for shape, weight in weights.items())
        off = np.linalg.norm(stages.delta(f"{name}.usda", name) - truth, axis=1)
        template = sum(weight * stages.delta("personal.usda", shape) for shape, weight in weights.items())
        assert off.mean() < 0.25 * np.linalg.norm(template - truth, axis=1).mean()
        assert off.mean() < 0.1
        for shape in OWN:
            assert np.array_equal(stages.delta(f"{name}.usda", shape), stages.delta("personal.usda", shape))
        assert validate(stages[f"{name}.usda"]) == ()


def test_it_says_which_points_the_scan_showed(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """Half a scan; the eyeball is not matched."""
    scan = read_scan(files["open.ply"])
    at_home = scan_domes.POSE.undo(scan.points)
    half = scan.triangles[(at_home[scan.triangles][:, :, 0] < 0.0).all(axis=1)]
    write_ply(Scan(name="open", points=scan.points, triangles=half), files["open.ply"])
    code, _, err = run(capsys, *files.register("open", "--force"))
    assert code == 1
    assert "coverage" in err
    face = facepipe.open(files["open.usda"])
    scanned = face.primvar(SCANNED)
    x = whole_points(face.parts())[:DOME, 0]
    inside = np.abs(scan_domes.grid(expression_domes.SIDE)[0]).max(axis=1) < 44.0  # away from the scan's border
    assert set(np.unique(scanned)) == {0.0, 1.0}
    assert scanned[DOME:].max() == 0.0
    assert scanned[:DOME][x > 4.0].max() == 0.0
    assert scanned[:DOME][(x < -4.0) & inside].min() == 1.0


def test_weights_are_held_by_their_sigma() -> None:
    head = scan_domes.face()
    template, own = Template.of(head, "head"), whole_face(head, "head")
    neutral = NeutralScan(points=own.points)
    weights, options = {"jawOpen": 0.5, "smile": 1.0}, RegisterScansOptions(weight_sigma=0.2)
    surface = expression_surface(template, neutral, own.deltas, weights, options)
    np.testing.assert_allclose(surface.precision, [25.0, 25.0])
    np.testing.assert_array_equal(surface.expected, [0.5, 1.0])


def test_with_the_neutrals_scan_sizes_are_one(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """The neutral's place on its scan is exact, and the expression's scan has its size to the bit."""
    face = facepipe.open(files["personal.usda"])
    template = Template.of(face.parts(), "personal.usda")
    scan, landmarks = read_scan(files["anna.ply"]), read_scan_landmarks(files["anna.landmarks.json"])
    place = placed_neutral(template, template.points, scan, landmarks).place
    assert isinstance(place, Similarity)
    moved = place.apply(scan_domes.POSE.apply(template.points))
    assert np.abs(moved - template.points).max() < 0.01
    words = files.register("open", "--neutral-scan", files["anna.ply"], "--force", "--json")
    held, free = (json.loads(run(capsys, *one)[1]) for one in (words, files.register("open", "--force", "--json")))
    assert held["fit"]["mm_per_unit"] == place.scale
    assert free["fit"]["mm_per_unit"] != place.scale


def test_painted_markers_are_followed_with_the_neutrals_scan(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """Motion along a surface that landmarks don't show: few landmarks, then markers too."""
    names = ("anna", "open")
    places = np.array([(x, y) for x in (-20.0, 0.0, 20.0) for y in (-30.0, -18.0, 0.0)])
    for name in names:
        own = SEEN.get(name, {})
        delta = sum((weight * OWN[one] * expression_domes.motion(one, places) for one, weight in own.items()), 0.0)
        where = scan_domes.POSE.apply(scan_domes.dome(places, PERSON) + delta)
        known = read_scan_landmarks(files[f"{name}.landmarks.json"])
        points = known.points.copy()
        if name == "open":
            points[:17] = points[31:] = np.nan  # chin and mouth are unknown
        markers = {f"m{number}": one for number, one in enumerate(where)}
        write_scan_landmarks(replace(known, points=points, markers=markers), files[f"{name}.landmarks.json"])
    code, _, err = run(capsys, *files.register("open", "--force"))
    assert "markers are ignored without --neutral-scan" in err
    truth = 0.8 * OWN["jawOpen"] * expression_domes.template_motion("jawOpen")
    without = np.linalg.norm(files.delta("open.usda", "open") - truth, axis=1).mean()
    code, _, err = run(capsys, *files.register("open", "--force", "--neutral-scan", files["anna.ply"]))
    assert code == 0
    assert "markers are ignored" not in err
    assert np.linalg.norm(files.delta("open.usda", "open") - truth, axis=1).mean() < 0.5 * without


def test_a_picture_is_drawn_beside_it(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    from PIL import Image

    out = done(capsys, *files.register("open", "--force", "--picture", files["open.png"]))
    assert str(files["open.png"]) in out
    assert np.asarray(Image.open(files["open.png"]).convert("L")).std() > 10


@pytest.mark.parametrize(
    ("more", "text"),
    [
        (("--composite", "grin"), "--composite grin: no composite of that name, expected --weights"),
        ((), "no composite of that name"),
        (("--composite", "smile", "--weights", "jawOpen=1"), "--composite smile: given with --weights, expected one"),
        (("--composite", "smile"), "composite smile -> mouthSmile_L: no such shape"),
    ],
)
def test_composites_are_names_of_the_table(
    files: Files, more: tuple[str, ...], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("register-scan", files["open.ply"], "--personal", files["personal.usda"], "-o", files["new.usda"])
    assert text in failed(capsys, *words, *more, folder=files.folder)


def test_a_scan_named_as_a_composite_shows_it(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    for end in (".ply", ".landmarks.json"):
        files[f"jaw_open{end}"].write_bytes(files[f"open{end}"].read_bytes())
    words = ("register-scan", files["jaw_open.ply"], "--personal", files["personal.usda"], "-o", files["new.usda"])
    done(capsys, *words)
    found, known = (files.delta(*one) for one in (("new.usda", "jaw_open"), ("open.usda", "open")))
    assert np.array_equal(found, known)


def test_edit_changes_what_is_given(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    edit = ("register-scan", "--edit", files["open.usda"], "--neutral-scan", files["anna.ply"], "--variation", 0.5)
    done(capsys, *edit, "-o", files["edited.usda"])
    kept = read_kept(files["edited.usda"], RegisterScanAction).values
    assert (kept["neutral_landmarks"], kept["weights"]) == (files["anna.landmarks.json"], SEEN["open"])
    done(capsys, *files.register("open", "--neutral-scan", files["anna.ply"], "--variation", 0.5, "--force"))
    assert files["edited.usda"].read_bytes() == files["open.usda"].read_bytes()
    err = failed(capsys, *edit, "--composite", "smile", "-o", files["smile.usda"], folder=files.folder)
    assert "composite smile -> mouthSmile_L: no such shape" in err
