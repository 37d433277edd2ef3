"""Project files and work folders of rebuilds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rebuild_project import HEAD

from facepipe.core.errors import InputError
from facepipe.scanning.rebuild import DEFAULT_COMPOSITES, read_project, resolved
from facepipe.scanning.rebuild.project import Refinement
from facepipe.scanning.rebuild.steps import WorkFolder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("head.usda", "faces.fpdb", "neutral.ply", "smile.ply", "wink.ply", "smile.landmarks.json"):
        (tmp_path / name).write_text("")
    return tmp_path


def _project(folder: Path, text: str) -> Path:
    path = folder / "anna.toml"
    path.write_text(text)
    return path


def test_a_project_names_its_files_and_fills_in_what_it_leaves_out(folder: Path) -> None:
    text = '[expressions.smile]\nscan = "smile.ply"\n[expressions.wink]\nscan = "wink.ply"\nweights = { blink = 1 }\n'
    project = read_project(_project(folder, HEAD + text + "[options.neutral]\nunit = 'mm'\n"))
    smile, wink = project.expressions
    assert project.work == folder / "anna"
    assert (smile.landmarks, wink.landmarks) == (folder / "smile.landmarks.json", None)
    assert smile.weights == DEFAULT_COMPOSITES["smile"]
    assert wink.weights == {"blink": 1.0}
    assert project.options.neutral.unit == "mm"
    assert project.options.split.noise == 0.6
    assert project.neutral.weights == {}
    shown = read_project(_project(folder, HEAD + "weights = { eyeBlink_L = 1 }\n"))
    assert shown.neutral.weights == {"eyeBlink_L": 1.0}


def test_a_table_of_refinement_asks_for_it(folder: Path) -> None:
    assert read_project(_project(folder, HEAD)).options.refinement is None
    everywhere = read_project(_project(folder, HEAD + "[options.refinement]\n")).options.refinement
    assert everywhere == Refinement()
    text = "[options.refinement]\nregions = ['nose', 'mouth']\ndetail_mm = 8\n"
    some = read_project(_project(folder, HEAD + text)).options.refinement
    assert some == Refinement(regions=("nose", "mouth"), detail_mm=8.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + "[options]\nrefinement = 3\n", "anna.toml -> options -> refinement: 3, expected an object or null"),
        (
            HEAD + "[options.refinement]\nregions = 'nose'\n",
            "anna.toml -> options -> refinement -> regions: 'nose', expected a list of which each is a text",
        ),
        (
            HEAD + "[options.refinement]\nregion = ['nose']\n",
            "anna.toml -> options -> refinement: option 'region' is unknown, did you mean 'regions'?",
        ),
        ("template = 1\n", "anna.toml -> template: 1, expected a text"),
        (HEAD.partition("[neutral]")[0], "anna.toml: no 'neutral', expected one"),
        (HEAD.replace("head", "tail"), "anna.toml -> template: {folder}/tail.usda: no such file"),
        (HEAD + "landmark = 1\n", "anna.toml -> neutral: option 'landmark' is unknown, did you mean 'landmarks'?"),
        (HEAD + "weights = { blink = 0 }\n", "anna.toml -> neutral -> weights -> blink: 0, expected a number above 0"),
        (HEAD + "weights = {}\n", "anna.toml -> neutral -> weights: {{}}, expected a weight for each shape"),
        (HEAD + "[expressions]\nsmile = 3\n", "anna.toml -> expressions -> smile: 3, expected an object"),
        (
            HEAD + "[expressions.wink]\nscan = 'wink.ply'\n",
            "anna.toml -> expressions -> wink: no weights, expected some, or one of the names that have them: jaw_open",
        ),
        (
            HEAD + "[expressions.wink]\nscan = 'wink.ply'\nweights = { eyeBlink_L = nan }\n",
            "anna.toml -> expressions -> wink -> weights -> eyeBlink_L: nan, expected a finite number",
        ),
        (HEAD + "[options.neutral]\nprior = -1\n", "anna.toml -> options -> neutral -> option prior: is -1, expected"),
        (
            HEAD + "[options.all]\n",
            "anna.toml -> options: option 'all' is unknown, expected some of neutral, refinement,",
        ),
        ("[[[", "anna.toml: is not TOML ("),
    ],
)
def test_mistakes_give_one_line(folder: Path, text: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        read_project(_project(folder, text))
    assert str(error.value).startswith(f"{folder}/" + message.format(folder=folder))
    assert "\n" not in str(error.value)


def test_shapes_of_composites_are_found_however_their_sides_are_written() -> None:
    assert resolved({"smile_L": 1.0, "browInnerUp_R": 0.5}, ("smileLeft", "browInnerUp"), "x") == {
        "smileLeft": 1.0,
        "browInnerUp": 0.5,
    }
    assert resolved({"smileLeft": 1.0}, ("smile_L",), "x") == {"smile_L": 1.0}
    with pytest.raises(InputError, match="x -> jawOpen: no such shape, expected one of smile_L"):
        resolved({"jawOpen": 1.0}, ("smile_L",), "x")


def test_the_default_composites_close_lips_of_open_jaws_only() -> None:
    for weights in DEFAULT_COMPOSITES.values():
        assert all(0.0 < weight <= 1.0 for weight in weights.values())
        assert "mouthClose" not in weights or "jawOpen" in weights


def test_a_stage_is_computed_once_for_the_same_inputs(tmp_path: Path) -> None:
    calls: list[int] = []

    def compute() -> tuple[dict[str, np.ndarray], dict[str, int]]:
        calls.append(1)
        return {"points": np.arange(6.0).reshape(2, 3)}, {"calls": len(calls)}

    first = WorkFolder(tmp_path / "work").step("expressions/a", {"x": 1}, compute)
    again = WorkFolder(tmp_path / "work").step("expressions/a", {"x": 1}, compute)
    assert (first[2], *again[1:]) == (False, {"calls": 1}, True)
    assert np.array_equal(again[0]["points"], np.arange(6.0).reshape(2, 3))
    assert WorkFolder(tmp_path / "work").step("expressions/a", {"x": 2}, compute)[1] == {"calls": 2}


def test_what_a_killed_run_left_beside_a_result_goes_where_that_is_taken_again(tmp_path: Path) -> None:
    folder, left = WorkFolder(tmp_path), tmp_path / ".facepipe-0123456789abcdef"
    folder.step("a", {}, lambda: ({"points": np.ones((1, 3))}, {}))
    left.mkdir()
    (left / ".facepipe-lock").write_text("")
    assert folder.step("a", {}, lambda: ({}, {}))[2]
    assert not left.exists()


def test_a_failing_stage_leaves_what_was_there(tmp_path: Path) -> None:
    folder = WorkFolder(tmp_path)
    folder.step("a", {"x": 1}, lambda: ({"points": np.ones((1, 3))}, {}))
    kept = (tmp_path / "a.fpstage").read_bytes()

    def fails() -> tuple[dict[str, np.ndarray], dict[str, int]]:
        raise InputError("scan", "is gone")

    with pytest.raises(InputError):
        folder.step("a", {"x": 2}, fails)
    assert (tmp_path / "a.fpstage").read_bytes() == kept


@pytest.mark.parametrize("damage", [b"", b"nonsense", None])
def test_a_damaged_result_is_made_anew(tmp_path: Path, damage: bytes | None) -> None:
    folder, path = WorkFolder(tmp_path), tmp_path / "a.fpstage"
    folder.step("a", {}, lambda: ({"points": np.ones((1, 3))}, {}))
    path.write_bytes(path.read_bytes()[:-3] if damage is None else damage)
    assert not folder.step("a", {}, lambda: ({"points": np.ones((1, 3))}, {}))[2]
    assert folder.step("a", {}, lambda: ({"points": np.zeros((1, 3))}, {}))[2]


def test_two_corrections_of_one_result_are_refused(tmp_path: Path) -> None:
    folder = WorkFolder(tmp_path)
    (tmp_path / "corrections" / "neutral.obj").write_text("")
    assert folder.correction("neutral") == tmp_path / "corrections" / "neutral.obj"
    (tmp_path / "corrections" / "neutral.usdc").write_text("")
    with pytest.raises(InputError, match=r"neutral\.usdc, neutral\.obj, expected one correction of neutral"):
        folder.correction("neutral")


def test_joint_is_true_or_false(folder: Path) -> None:
    assert not read_project(_project(folder, HEAD)).joint
    assert read_project(_project(folder, f"joint = true\n{HEAD}")).joint
    with pytest.raises(InputError, match=r"anna.toml -> joint: 1, expected true or false"):
        read_project(_project(folder, f"joint = 1\n{HEAD}"))
