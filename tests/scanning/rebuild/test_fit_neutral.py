"""`facepipe fit-neutral`: a person found on a scan, authored over the template; bad input gives one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import scan_domes
from command_line import done, failed, run
from database_faces import source
from import_data import shared
from neutral_files import PERSON, Files
from PIL import Image

import facepipe
from facepipe.checks import validate
from facepipe.declare import to_json
from facepipe.geometry.similarity import fit_similarity
from facepipe.kinds import found_of
from facepipe.performing import read_kept
from facepipe.scanning.database import create_database, save_database
from facepipe.scanning.rebuild import FitNeutral, FitNeutralOptions, Template
from facepipe.scanning.rebuild.fit_neutral import fit_neutral
from facepipe.scanning.rebuild.fit_neutral_action import FitNeutralAction
from facepipe.scans import Scan, ScanLandmarks
from facepipe.stage.recipes import source_digest
from facepipe.verbs.whole_faces import Topology, WholeFace, whole_points


@pytest.fixture
def files(fit_files: Files) -> Files:
    return fit_files


def truth() -> np.ndarray:
    return whole_points(scan_domes.face(PERSON))


def fitted(files: Files) -> np.ndarray:
    return whole_points(facepipe.open(files["out.usda"]).parts())


def test_the_class_of_0_1_0_still_fits() -> None:
    template, (scan, landmarks) = Template.of(scan_domes.face(), "head.usda"), scan_domes.scan(PERSON)
    options, steps = FitNeutralOptions(unit="cm"), list[int]()
    given = (template, scan, landmarks, scan_domes.database())
    former = FitNeutral(options=options)(*given, steps.append)
    neutral, place, report = fit_neutral(*given, options)
    assert (former.report.quality, former.place.scale) == (report.quality, place.scale)
    np.testing.assert_array_equal(former.points, neutral.points)
    assert not former.expression.any()
    assert steps


def test_a_person_is_found_on_a_scan(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    out = done(capsys, *files.words("--unit", "cm", "--json"), quiet=False)
    assert np.abs(fitted(files) - truth()).max() < 0.05
    printed = json.loads(out)
    assert printed["path"] == str(files["out.usda"])
    assert printed["fit"]["unit"] == "cm"
    assert printed["missed"] == []
    assert printed["residual_mean_mm"] <= printed["residual_max_mm"] < 0.1
    assert validate(files["out.usda"]) == ()
    face, template = facepipe.open(files["out.usda"]), facepipe.open(files["head.usda"])
    assert face.shapes == template.shapes
    assert face.skeleton.joints == template.skeleton.joints


def test_the_size_is_found_with_the_rest(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """Identity and size look alike on a dome: what is left of the person is right but for a similarity."""
    out = done(capsys, *files.words(), quiet=False)
    assert "10.01 mm (cm)" in out
    found = fitted(files)
    assert np.abs(fit_similarity(found, truth()).apply(found) - truth()).max() < 0.15


def test_the_recipe_shows_what_it_was_made_of(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    (files.folder / "fits").mkdir()
    out = files.folder / "fits" / "out.usda"
    words = files.words("--prior", 0.2, "--unit", "cm", "--json")
    text = done(capsys, *words[: words.index("-o")], "-o", out, *words[words.index("-o") + 2 :], quiet=False)
    recipe = facepipe.open(out).parts().recipe
    assert recipe is not None
    assert recipe.verb == "fit-neutral"
    assert recipe.sources == ("../head.usda", "../scan.ply", "../faces.fpdb", "../scan.landmarks.json")
    assert recipe.digests == tuple(source_digest(out.parent / one) for one in recipe.sources)
    assert {**to_json(FitNeutralOptions(unit="cm")), "prior": 0.2}.items() <= recipe.options.items()
    assert found_of(recipe)["quality"] == json.loads(text)["quality"]


def test_edit_changes_what_is_given(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """A scan that is given comes with its own landmarks; those of the other may be lost."""
    done(capsys, *files.words("--unit", "cm", "--weights", "jawOpen=0.1"), quiet=False)
    files.put(*scan_domes.scan(8), "other.ply")
    files["scan.landmarks.json"].unlink()
    edit = ("fit-neutral", files["other.ply"], "--edit", files["out.usda"], "--no-weights", "--prior", 0.2)
    done(capsys, *edit, "-o", files["edited.usda"], quiet=False)
    kept = read_kept(files["edited.usda"], FitNeutralAction).values
    assert (kept["scan"], kept["landmarks"]) == (files["other.ply"], files["other.landmarks.json"])
    assert (kept["unit"], kept["prior"], kept["weights"]) == ("cm", 0.2, {})
    done(capsys, *files.words("--unit", "cm", "--prior", 0.2, "--force", scan="other.ply"), quiet=False)
    assert files["edited.usda"].read_bytes() == files["out.usda"].read_bytes()


def test_the_same_scan_gives_the_same_bytes(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    made = []
    for _ in range(2):
        done(capsys, *files.words("--force"), quiet=False)
        made.append(files["out.usda"].read_bytes())
    assert made[0] == made[1]


def test_a_picture_is_drawn_beside_it(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """Two rows of scan, face and distance; the last has colours of the heat map, the others have not."""
    out = done(capsys, *files.words("--picture", files["out.png"]), quiet=False)
    assert str(files["out.png"]) in out
    pixels = np.asarray(Image.open(files["out.png"]).convert("RGB")).astype(int)
    colored = (pixels[..., 2] - pixels[..., 1] > 25).mean(axis=0)  # violet: the low end of the heat map
    third = len(colored) // 3
    assert colored[2 * third :].mean() > 0.05
    assert colored[: 2 * third].mean() < 0.01


def test_flattened_it_stands_alone(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    done(capsys, *files.words("--unit", "cm", "--flatten"), quiet=False)
    files["head.usda"].unlink()
    assert np.abs(fitted(files) - truth()).max() < 0.05


def test_a_cloud_does_nearly_as_well(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    scan, landmarks = scan_domes.scan(PERSON, side=121)
    files.put(Scan(name="cloud", points=scan.points), landmarks, "cloud.ply")
    done(capsys, *files.words("--unit", "cm", scan="cloud.ply"), quiet=False)
    assert np.linalg.norm(fitted(files) - truth(), axis=1).mean() < 0.2


def test_a_scan_of_half_the_face_is_reported(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """The file is written, and the exit code says that a limit was missed."""
    scan, landmarks = scan_domes.scan(PERSON)
    at_home = scan_domes.POSE.undo(scan.points)
    half = scan.triangles[(at_home[scan.triangles][:, :, 0] < 0.0).all(axis=1)]
    files.put(replace(scan, triangles=half), landmarks)
    code, out, err = run(capsys, *files.words("--unit", "cm", "--json"))
    assert code == 1
    assert "coverage 0." in err
    printed = json.loads(out)
    assert 0.3 < printed["quality"]["coverage"] < 0.6
    assert len(printed["missed"]) == 1
    assert np.linalg.norm(fitted(files) - truth(), axis=1).mean() < 0.5  # the model knows the other half


def test_a_landmark_on_the_wrong_place_is_reported(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    scan, landmarks = scan_domes.scan(PERSON)
    points = landmarks.points.copy()
    points[33] += 2.5
    files.put(scan, ScanLandmarks(points=points))
    _, _, err = run(capsys, *files.words("--unit", "cm"))
    assert "1 landmarks ignored as outliers: landmark 33" in err
    assert np.abs(fitted(files) - truth()).max() < 0.3


def test_landmarks_on_other_parts_of_the_face_are_reported(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """The nose's on the chin, an eye's on the mouth, the mouth's on a brow, and the size is not known."""
    scan, landmarks = scan_domes.scan(PERSON)
    points = landmarks.points.copy()
    points[[30, 36, 48]] = points[[8, 54, 20]]
    files.put(scan, ScanLandmarks(points=points))
    code, _, err = run(capsys, *files.words())
    assert code == 0
    assert "3 landmarks ignored as outliers: landmark 30, landmark 36, landmark 48" in err
    assert "taken as cm" in err
    assert np.abs(fitted(files) - truth()).max() < 0.3


def test_landmarks_that_are_said_to_be_rough_bend_less(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    scan, landmarks = scan_domes.scan(PERSON)
    rough = landmarks.points + 0.15 * np.random.default_rng(3).standard_normal((68, 3))  # cm
    errors = []
    for sigmas in (np.full(68, np.nan), np.full(68, 1.5)):
        files.put(scan, ScanLandmarks(points=rough, sigma_mm=sigmas))
        done(capsys, *files.words("--unit", "cm", "--force"), quiet=False)
        errors.append(np.linalg.norm(fitted(files) - truth(), axis=1).mean())
    assert errors[1] < 0.5 * errors[0]


def _other_topology(files: Files) -> None:
    save_database(create_database([source(seed) for seed in range(3)]).database, files["faces.fpdb"])


def _mirrored(files: Files) -> None:
    scan, landmarks = scan_domes.scan(PERSON)
    flip = np.array([-1.0, 1.0, 1.0])
    turned = replace(scan, points=scan.points * flip, triangles=scan.triangles[:, ::-1])
    files.put(turned, ScanLandmarks(points=landmarks.points * flip))


def _few_landmarks(files: Files) -> None:
    scan, landmarks = scan_domes.scan(PERSON)
    points = landmarks.points.copy()
    points[5:] = np.nan
    files.put(scan, ScanLandmarks(points=points))


def _no_number(files: Files) -> None:
    lines = ["ply", "format ascii 1.0", "element vertex 4", *(f"property float {axis}" for axis in "xyz"), "end_header"]
    files["scan.ply"].write_text("\n".join([*lines, "0 0 0", "1 0 0", "0 nan 0", "0 0 1", ""]), encoding="ascii")


def _damaged_landmarks(files: Files) -> None:
    files["scan.landmarks.json"].write_text('{"points": [[0, 0, NaN]]}', encoding="utf-8")


def _apart(files: Files) -> None:
    scan, landmarks = scan_domes.scan(PERSON)
    files.put(replace(scan, points=scan.points + 500.0), landmarks)


@pytest.mark.parametrize(
    ("spoil", "more", "text"),
    [
        (_other_topology, (), "other meshes or faces than the database has"),
        (_mirrored, (), "fit a mirrored face"),
        (_few_landmarks, (), "5 of 68 are known, expected 6 or more"),
        (_no_number, (), "scan.ply"),
        (_damaged_landmarks, (), "scan.landmarks.json"),
        (_apart, (), "points of the face find a place on it"),
        (lambda files: files["scan.ply"].unlink(), (), "scan.ply"),
        (lambda files: files["faces.fpdb"].unlink(), (), "faces.fpdb"),
        (lambda files: files["head.usda"].unlink(), (), "head.usda"),
        (lambda files: None, ("--unit", "mm"), "was given in mm, but has the size of a face in cm"),
        (lambda files: None, ("--landmarks", "none.json"), "none.json"),
        (lambda files: None, ("--prior", "0"), "option prior"),
        (lambda files: None, ("--picture", "sheet.jpg"), "expected .png"),
    ],
)
def test_bad_input_gives_one_line_and_nothing_written(
    spoil: Callable[[Files], None],
    more: tuple[str, ...],
    text: str,
    files: Files,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(files.folder)
    spoil(files)
    assert text in failed(capsys, *files.words(*more))


def test_inputs_are_not_overwritten(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    content = files["head.usda"].read_bytes()
    words = files.words("--force")
    for name in ("head.usda", "scan.ply", "faces.fpdb"):
        changed = tuple(files[name] if word == files["out.usda"] else word for word in words)
        assert run(capsys, *changed)[0] == 2
    files["out.usda"].write_text("mine", encoding="utf-8")
    assert run(capsys, *files.words())[0] == 2
    assert files["out.usda"].read_text(encoding="utf-8") == "mine"
    assert files["head.usda"].read_bytes() == content


@pytest.mark.slow
def test_a_real_template_takes_the_shape_of_a_person(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """ICT-FaceKit, a person of the models that the database knows some of; truth up to the size, which is not known."""
    from scan_actors import Actor, database_faces
    from scan_simulator import simulate

    npz = shared("ict_facekit/ict_facekit.npz")
    files = Files(tmp_path)
    done(capsys, "import", "ict", npz, files["head.usdc"])
    topology = Topology.of(facepipe.open(files["head.usdc"]).parts())
    people = [
        WholeFace(name=f"p{number}", topology=topology, points=points, digest=f"sha256:{number}")
        for number, points in enumerate(database_faces(24))
    ]
    save_database(create_database([partial(replace, one) for one in people]).database, files["faces.fpdb"])
    actor = Actor(101, warp=0.5)
    seen = simulate(actor.neutral, 101)
    files.put(
        Scan(name="scan", points=seen.points, triangles=seen.triangles.astype(np.int32)),
        ScanLandmarks(points=seen.landmarks),
    )
    words = ["--template", files["head.usdc"], "--database", files["faces.fpdb"], "-o", files["out.usda"]]
    code, _, err = run(capsys, "fit-neutral", files["scan.ply"], *words)
    assert code in (0, 1), err
    assert validate(files["out.usda"]) == ()
    found, face = fitted(files), slice(0, 9409)
    off = np.linalg.norm(fit_similarity(found[face], actor.neutral[face]).apply(found) - actor.neutral, axis=1)
    print(f"mean {off[face].mean():.3f} mm, largest {off.max():.3f} mm")
    assert off[face].mean() < 0.9
    assert off.max() < 8.0
