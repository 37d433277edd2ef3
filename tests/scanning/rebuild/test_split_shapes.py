"""`facepipe split-shapes`: a person whose own shapes are known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import done, run
from expression_domes import OWN
from import_data import shared
from rebuild_stages import Files

import facepipe
from facepipe.checks import validate
from facepipe.geometry.example_rigging.split import Split
from facepipe.importers.scan_landmarks import write_scan_landmarks
from facepipe.importers.scan_ply import write_ply
from facepipe.scanning.rebuild.split_expressions import _report
from facepipe.scans import Scan, ScanLandmarks
from facepipe.verbs.author_neutral import AuthorNeutral
from facepipe.verbs.whole_faces import whole_face, whole_points


def test_shapes_become_the_persons_own(stages: Files) -> None:
    for shape, gain in OWN.items():
        truth = gain * stages.delta("personal.usda", shape)
        before, after = (
            np.linalg.norm(stages.delta(name, shape) - truth, axis=1).mean() for name in ("personal.usda", "actor.usda")
        )
        assert after < 0.5 * before
    assert validate(stages["actor.usda"]) == ()
    personal, actor = (facepipe.open(stages[name]) for name in ("personal.usda", "actor.usda"))
    assert actor.shapes == personal.shapes
    assert np.array_equal(whole_points(actor.parts()), whole_points(personal.parts()))


def test_the_table_has_a_row_for_each_shape(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """One expression alone: what it does not show stays to the bit, and that is no failure."""
    words = ("split-shapes", files["open.usda"], "--personal", files["personal.usda"], "-o", files["actor.usda"])
    out = done(capsys, *words, quiet=False)
    jaw = next(line.split() for line in out.splitlines() if line.startswith("jawOpen"))
    assert float(jaw[1]) > 0.5
    assert 1.1 < float(jaw[2]) < 1.45
    assert jaw[4] == "open"
    scan = next(line.split() for line in out.splitlines() if line.startswith("open "))
    printed = json.loads(done(capsys, *words, "--json", "--force", quiet=False))
    left = [printed[key]["open"] for key in ("residual_mean_mm", "residual_p95_mm")]
    assert scan == ["open", *(f"{mm:.2f}" for mm in left), "jawOpen", f"{printed['weights']['open']['jawOpen']:.2f}"]
    assert "1 shapes of scans, 1 separated; 1 as the personal template has them" in out
    assert np.array_equal(files.delta("actor.usda", "browUp"), files.delta("personal.usda", "browUp"))
    assert printed["shapes"]["jawOpen"]["gain"] == pytest.approx(float(jaw[2]), abs=0.006)
    assert printed["unseen"] == ["browUp"]


def test_shapes_that_no_weights_separate_name_each_other() -> None:
    numbers = {key: np.ones(3) for key in ("observed", "gains", "changes")}
    split = Split(
        deltas=np.zeros((3, 1, 3)), weights=np.array([[0.5, 0.0, 0.5]]), **numbers, residual_means=np.zeros(1),
        residual_p95=np.zeros(1), rank=1, together=((0, 2),), warnings=(),
    )  # fmt: skip
    shapes = _report(split, ("open", "smile", "drop"), ("scan",)).shapes
    assert {name: one.alike for name, one in shapes.items()} == {"open": ("drop",), "smile": (), "drop": ("open",)}


def test_a_correction_by_hand_is_split(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """An artist who makes the whole expression smaller gets a smaller shape."""
    sizes = []
    for factor in (1.0, 0.8):
        face = facepipe.open(files["open.usda"])
        own = whole_face(face.parts(), "open")
        with face.deriving(files["corrected.usda"]) as derived:
            recipe = face.parts().recipe
            AuthorNeutral(shapes={"open": factor * own.deltas["open"]})(derived, own.points, recipe=recipe)
        words = ("split-shapes", files["corrected.usda"], "--personal", files["personal.usda"])
        done(capsys, *words, "-o", files["actor.usda"], "--force", "--weight-spread", 0, quiet=False)
        sizes.append(np.linalg.norm(files.delta("actor.usda", "jawOpen"), axis=1).mean())
    assert 0.78 < sizes[1] / sizes[0] < 0.9


def test_what_shapes_leave_is_reported(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """Two expressions of the same weights that move in opposite ways: written, and exit code 1."""
    face = facepipe.open(files["open.usda"])
    own, recipe = whole_face(face.parts(), "open"), face.parts().recipe
    assert recipe is not None
    with face.deriving(files["odd.usda"]) as derived:
        other = replace(recipe, options={**recipe.options, "name": "odd"})
        AuthorNeutral(shapes={"odd": -2.0 * own.deltas["open"]})(derived, own.points, recipe=other)
    words = ("split-shapes", files["open.usda"], files["odd.usda"], "--personal", files["personal.usda"])
    code, _, err = run(capsys, *words, "-o", files["actor.usda"])
    assert code == 1
    assert "odd: shapes leave" in err
    assert files["actor.usda"].exists()


def test_a_personal_template_that_changed_is_reported(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    text = files["personal.usda"].read_text(encoding="utf-8")
    files["personal.usda"].write_text(text + "\n# touched\n", encoding="utf-8")
    code, _, err = run(capsys, *files.split())
    assert code == 0
    assert "personal.usda is not what open.usda was registered with" in err


@pytest.mark.slow
def test_a_real_template_gets_the_shapes_of_an_actor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """ICT-FaceKit, an actor whose expressions are known, three simulated scans, from command to command."""
    from scan_actors import COMPOSITES, Actor, ict
    from scan_simulator import simulate

    npz, files, actor = shared("ict_facekit/ict_facekit.npz"), Files(tmp_path), Actor(101)
    done(capsys, "import", "ict", npz, files["head.usdc"])
    with facepipe.open(files["head.usdc"]).deriving(files["anna.usdc"]) as derived:
        AuthorNeutral()(derived, actor.neutral)
    words = (files["anna.usdc"], "--template", files["head.usdc"], "-o", files["personal.usdc"])
    done(capsys, "personal-template", *words)
    for number, name in enumerate(("jaw_open", "smile", "laugh")):
        seen = simulate(actor.composite(COMPOSITES[name]), 100 * 101 + number)
        scan = Scan(name=name, points=seen.points, triangles=seen.triangles.astype(np.int32))
        write_ply(scan, files[f"{name}.ply"])
        write_scan_landmarks(ScanLandmarks(points=seen.landmarks), files[f"{name}.landmarks.json"])
        words = (files[f"{name}.ply"], "--personal", files["personal.usdc"], "-o", files[f"{name}.usdc"])
        code, _, err = run(capsys, "register-scan", *words)
        assert code in (0, 1), err
    registered = [files[f"{name}.usdc"] for name in ("jaw_open", "smile", "laugh")]
    files_of = ("--personal", files["personal.usdc"], "-o", files["actor.usdc"])
    out = done(capsys, "split-shapes", *registered, *files_of, quiet=False)
    print(out)
    assert validate(files["actor.usdc"]) == ()
    off: dict[str, list[float]] = {"personal.usdc": [], "actor.usdc": []}
    for name in ("jawOpen", "mouthSmile_L", "mouthSmile_R", "cheekSquint_L", "cheekSquint_R"):
        truth = actor.shape(name)[: ict().full_face]
        moved = np.linalg.norm(truth, axis=1) > 0.05 * np.linalg.norm(truth, axis=1).max()
        ours = name.replace("_L", "Left").replace("_R", "Right")
        for file, means in off.items():
            delta = whole_face(facepipe.open(files[file]).parts(), file).deltas[ours][: ict().full_face]
            means.append(float(np.linalg.norm(delta - truth, axis=1)[moved].mean()))
    print(off)
    assert np.mean(off["actor.usdc"]) < 0.65 * np.mean(off["personal.usdc"])
