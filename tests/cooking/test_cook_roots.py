"""What recipes of others may do in a cook: write below the roots of the stage that led to them, and run no code."""

from __future__ import annotations

import dataclasses
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
from command_line import content, exit_code, failed, run
from cook_chain import TABLE, actions, change, cook, layer
from faces import tiny_face
from pxr import Usd
from small_sources import made

import facepipe
from facepipe import cooking
from facepipe.cooking import CookOptions
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import Trust, trusting
from facepipe.parts import Recipe
from facepipe.scanning.rebuild.steps import WorkFolder
from facepipe.stage import save_parts

Capsys = pytest.CaptureFixture[str]
LINES = (
    ("blend", "lib/a.usda", "lib/b.usda", "-o", "lib/mix.usda"),
    ("sliders", "lib/mix.usda", "--from", "shots/table.toml", "-o", "shots/controls.usda"),
    ("sliders", "shots/controls.usda", "--from", "shots/table.toml", "-o", "shots/posed.usda"),
)
SHOT = ("controls.usda", "posed.usda")
_NOTE = "mix.usda is outside the roots and not up to date: taken as it is"
links = pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kept")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name in ("lib", "shots"):
            Path(name).mkdir()
        save_parts(made(1), "lib/a.usda")
        save_parts(made(2), "lib/b.usda")
        Path("shots/table.toml").write_text(TABLE)
        for line in LINES:
            assert exit_code(*line) == 0
    return folder


@pytest.fixture
def show(kept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder: shots/posed.usda of shots/controls.usda, of lib/mix.usda, of lib/a.usda and lib/b.usda."""
    shutil.copytree(kept, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _stale(show: Path) -> dict[Path, bytes]:
    """Change what the library's result is made of; all that is in the library then."""
    change("lib/a.usda")
    return content(show / "lib")


def test_a_result_outside_the_roots_is_listed_and_the_rest_is_cooked(show: Path, capsys: Capsys) -> None:
    before = _stale(show)
    code, report, err = cook(capsys, "shots/posed.usda")
    assert code == 1
    assert not report["good"]
    assert actions(report) == {"mix.usda": "outside the roots", "controls.usda": "cooked", "posed.usda": "cooked"}
    assert report["nodes"][0]["why"] == ["a.usda changed"]
    assert err == 2 * f"facepipe: warning: {_NOTE}\n"
    assert report["warnings"] == [f"shots/{name}: {_NOTE}" for name in SHOT]
    assert content(show / "lib") == before
    assert sorted(one.name for one in (show / "shots").iterdir()) == ["controls.usda", "posed.usda", "table.toml"]
    code, report, err = cook(capsys, "shots/posed.usda")
    assert (code, err) == (1, "")
    assert actions(report) == {"mix.usda": "outside the roots", **dict.fromkeys(SHOT, "up to date")}


def test_assets_elsewhere_that_are_up_to_date_are_no_fault(show: Path, capsys: Capsys) -> None:
    """The layout of a studio: a shot stands on a library by absolute paths and on its own results."""
    stage = Usd.Stage.CreateNew("shots/shot.usda")
    stage.GetRootLayer().subLayerPaths = [(show / "shots/posed.usda").as_posix(), (show / "lib/mix.usda").as_posix()]
    stage.Save()
    code, report, err = cook(capsys, "shots/shot.usda")
    assert (code, err, set(actions(report).values())) == (0, "", {"up to date"})
    Path("shots/table.toml").write_text(TABLE.replace("0.5", "0.25"))
    code, report, err = cook(capsys, "shots/shot.usda")
    assert (code, err) == (0, "")
    assert actions(report) == {"mix.usda": "up to date", "controls.usda": "cooked", "posed.usda": "cooked"}
    assert cook(capsys, "shots/shot.usda", "--dry-run")[0] == 0


@pytest.mark.parametrize("words", [("--dry-run",), ("--force",), ("--force", "--dry-run")])
def test_nothing_makes_a_cook_write_outside_the_roots(show: Path, capsys: Capsys, words: tuple[str, ...]) -> None:
    before = _stale(show)
    code, report, _ = cook(capsys, "shots/posed.usda", *words)
    assert (code, actions(report)["mix.usda"]) == (1, "outside the roots")
    assert content(show / "lib") == before


def test_lines_for_people_name_what_is_outside(show: Path, capsys: Capsys) -> None:
    _stale(show)
    assert exit_code("cook", "shots/posed.usda") == 1
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first == "lib/mix.usda: blend: outside the roots (a.usda changed)"
    assert last == "3 file(s) with recipes: 2 cooked, 1 outside the roots"


def _all_cooked(capsys: Capsys, *words: str) -> None:
    code, report, _ = cook(capsys, *words)
    assert (code, set(actions(report).values())) == (0, {"cooked"})


def test_roots_that_are_given_hold_both(show: Path, capsys: Capsys) -> None:
    _stale(show)
    _all_cooked(capsys, "shots/posed.usda", "--root", "lib", "--root", "shots")


def test_roots_of_the_environment_hold_both(show: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    _stale(show)
    monkeypatch.setenv("FACEPIPE_ROOTS", os.pathsep.join([str(show / "lib"), str(show / "shots")]))
    _all_cooked(capsys, "shots/posed.usda")


def test_a_marked_folder_around_both_is_the_root(show: Path, capsys: Capsys) -> None:
    _stale(show)
    Path("facepipe.toml").touch()
    _all_cooked(capsys, "shots/posed.usda")


def test_a_stage_outside_the_given_roots_is_not_written(show: Path, capsys: Capsys) -> None:
    _stale(show)
    before = content(show)
    code, report, _ = cook(capsys, "lib/mix.usda", "--root", "shots")
    assert (code, actions(report)) == (1, {"mix.usda": "outside the roots"})
    assert content(show) == before


def test_what_one_stage_may_write_is_written_though_another_leads_there_too(show: Path, capsys: Capsys) -> None:
    _stale(show)
    for words in (["shots/posed.usda", "lib/mix.usda"], ["lib/mix.usda", "shots/posed.usda"]):
        change("lib/a.usda", 5 + len(words[0]))
        _all_cooked(capsys, *words)


def test_a_root_may_be_a_link_to_a_folder(show: Path, capsys: Capsys) -> None:
    if sys.platform == "win32":
        pytest.skip("links need rights there")
    _stale(show)
    Path("link").symlink_to(show)
    _all_cooked(capsys, "link/shots/posed.usda", "--root", "link")
    change("lib/a.usda", 4)
    Path("facepipe.toml").touch()
    _all_cooked(capsys, "link/shots/../shots/posed.usda")


@links
def test_links_to_results_outside_do_not_make_them_writable(show: Path, capsys: Capsys) -> None:
    """A link to the file; a link to its folder; a folder of links, whose files would be written beside their locks."""
    before = _stale(show)
    for name in ("a.usda", "b.usda"):
        shutil.copy(f"lib/{name}", "shots")
    Path("shots/one.usda").symlink_to("../lib/mix.usda")
    Path("shots/lib").symlink_to("../lib")
    for path in ("shots/one.usda", "shots/lib/mix.usda"):
        code, report, _ = cook(capsys, path, "--root", "shots")
        assert (code, list(actions(report).values())) == (1, ["outside the roots"])
    shutil.copytree("lib", "shots/own")
    Path("lib/back.usda").symlink_to("../shots/own/mix.usda")
    before = content(show / "lib")
    assert list(actions(cook(capsys, "lib/back.usda", "--root", "shots")[1]).values()) == ["outside the roots"]
    assert content(show / "lib") == before


def test_layers_with_arguments_of_a_format_are_followed(show: Path, capsys: Capsys) -> None:
    layer("shots/shot.usda", "(subLayers = [@./posed.usda:SDF_FORMAT_ARGS:a=b@])")
    _stale(show)
    assert actions(cook(capsys, "shots/shot.usda", "--dry-run")[1])["mix.usda"] == "outside the roots"


def test_chains_of_files_may_be_longer_than_the_stack(tmp_path: Path, capsys: Capsys) -> None:
    count = sys.getrecursionlimit() + 100
    for number in range(count):
        text = f"(subLayers = [@./{number + 1}.usda@])"
        (tmp_path / f"{number}.usda").write_text(f"#usda 1.0\n{text}\n")
    last = tmp_path / f"{count}.usda"
    last.write_text("#usda 1.0\n")
    assert exit_code("cook", tmp_path / "0.usda") == 0
    last.unlink()
    capsys.readouterr()
    err = failed(capsys, "cook", tmp_path / "0.usda", folder=tmp_path)
    assert f"{count - 1}.usda: stands on {last}, which is gone" in err
    assert err.count("->") < 20


def test_roots_are_those_in_force_in_the_program(show: Path) -> None:
    _stale(show)
    with trusting(Trust(roots=(show / "shots",))):
        report = cooking.cook(["shots/posed.usda"], CookOptions(dry_run=True))
    assert [node.action for node in report.nodes] == ["outside the roots", "stale", "stale"]
    assert report.nodes[1].warnings == (_NOTE,)
    with trusting(Trust(roots=(show,))):
        assert cooking.cook(["shots/posed.usda"]).good


_PROJECT = 'template = "a.usda"\ndatabase = "faces.fpdb"\nwork = "{work}"\n[neutral]\nscan = "scan.ply"\n'


def test_a_host_can_confine_what_a_cook_reads(show: Path) -> None:
    with (
        trusting(Trust(roots=(show / "shots",), confined=True)),
        pytest.raises(InputError, match=r"mix\.usda: is outside the roots"),
    ):
        cooking.cook(["shots/posed.usda"])
    table = Path("table.toml")
    table.write_text(TABLE)
    assert exit_code("sliders", "shots/controls.usda", "--from", "table.toml", "-o", "lib/own.usda") == 0
    with (
        trusting(Trust(roots=(show / "shots", show / "lib"), confined=True)),
        pytest.raises(InputError, match=r"table\.toml is outside the roots"),
    ):
        cooking.cook(["lib/own.usda"], CookOptions(dry_run=True))


@pytest.fixture
def actor(folder: Path) -> Path:
    """The working folder: shot/anna.usda is rebuilt of anna.toml."""
    Path("shot").mkdir()
    for name in ("faces.fpdb", "scan.ply"):
        Path(name).write_bytes(b"")
    sources = ("../anna.toml", "../a.usda")
    options = {"project": sources[0], "joint": False}
    _put("shot/anna.usda", Recipe(verb="rebuild", sources=sources, digests=("sha256:0",) * 2, options=options))
    return folder


def _put(path: str, recipe: Recipe) -> None:
    recipe = dataclasses.replace(recipe, version=facepipe.__version__)
    save_parts(dataclasses.replace(tiny_face(), recipe=recipe), path)


@pytest.mark.parametrize("work", ["../out", "shot/../../out", "{outside}/out"])
def test_a_work_folder_lies_below_the_roots_of_the_project(actor: Path, capsys: Capsys, work: str) -> None:
    Path("anna.toml").write_text(_PROJECT.format(work=work.format(outside=actor.parent.as_posix())))
    err = failed(capsys, "rebuild", "anna.toml", "-o", "anna.usda", folder=actor.parent)
    assert err.startswith("anna.toml -> work: ")
    assert err.endswith(f"is outside the roots ({actor}), expected --root\n")


def test_and_in_a_cook_below_those_of_the_stage(actor: Path, capsys: Capsys) -> None:
    """The project lies outside them; with both as roots the cook comes to the template, which has no landmarks."""
    Path("anna.toml").write_text(_PROJECT.format(work="work"))
    err = failed(capsys, "cook", "shot/anna.usda")
    assert "shot/anna.usda -> recipe -> source 1: " in err
    assert f"anna.toml is outside the roots ({actor / 'shot'})" in err
    assert not Path("work").exists()
    assert "has no multipie68 landmarks" in failed(capsys, "cook", "shot/anna.usda", "--root", ".")
    Path("anna.toml").write_text(_PROJECT.format(work=f"{actor.parent.as_posix()}/work"))
    assert "anna.toml -> work: " in failed(capsys, "cook", "shot/anna.usda", "--root", ".")


@pytest.mark.parametrize("key", ["template", "database", "scan", "landmarks"])
@pytest.mark.parametrize("way", ["{outside}/x.json", "../x.json", "http://host/x.json"])
def test_so_does_all_that_a_project_names(actor: Path, capsys: Capsys, key: str, way: str) -> None:
    (actor.parent / "x.json").write_text("{}")
    named = way.format(outside=actor.parent.as_posix())
    text = _PROJECT.format(work="work") + 'landmarks = "a.usda"\n'
    lines = [f'{key} = "{named}"' if line.startswith(key) else line for line in text.splitlines()]
    Path("anna.toml").write_text("\n".join(lines))
    err = failed(capsys, "rebuild", "anna.toml", "-o", "anna.usda", folder=actor.parent)
    assert f"-> {key}: " in err
    assert ("is a URL" if "://" in way else "is outside the roots") in err


@links
def test_links_in_a_work_folder_lead_nowhere_else(tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "work/expressions").symlink_to(tmp_path / "out")
    (tmp_path / "work/neutral.fpstage").symlink_to(tmp_path / "out/new")
    folder = WorkFolder(tmp_path / "work")
    for name in ("expressions/smile", "neutral"):
        with pytest.raises(InputError, match="outside the roots"):
            folder.step(name, {}, lambda: ({}, {}))
    assert not any((tmp_path / "out").iterdir())
    (tmp_path / "out/mine.obj").write_text("v 0 0 0\n")
    (tmp_path / "work/corrections/neutral.obj").symlink_to(tmp_path / "out/mine.obj")
    with pytest.raises(InputError, match="outside the roots"):
        folder.correction("neutral")
    with pytest.raises(InputError, match="outside the roots"):
        folder.corrections()
    shutil.rmtree(tmp_path / "work/corrections")
    (tmp_path / "work/corrections").symlink_to(tmp_path / "out/new")
    with pytest.raises(InputError, match="outside the roots"):
        WorkFolder(tmp_path / "work")
    assert [one.name for one in (tmp_path / "out").iterdir()] == ["mine.obj"]


@pytest.fixture
def person(folder: Path) -> Path:
    """person.usda, whose recipe of a photo fit names net.pt2; over it shot.usda, without a recipe."""
    for name in ("front.png", "net.pt2", "net.onnx"):
        Path(name).write_bytes(b"")
    _fit("net.pt2")
    stage = Usd.Stage.CreateNew("shot.usda")
    stage.GetRootLayer().subLayerPaths = ["./person.usda"]
    stage.Save()
    return folder


def _fit(model: str) -> None:
    """person.usda, of a.usda, front.png and a model."""
    sources = ("./a.usda", "./front.png", "./net.pt2")
    options: dict[str, Any] = {
        "face": "./a.usda",
        "photos": ["./front.png"],
        "landmarks": [],
        "identity_model": "./net.pt2",
        "faces": [],
        "landmark_threshold": 8.0,
    }
    digests = ("sha256:0",) * 3
    _put("person.usda", Recipe(verb="fit-photo", sources=sources, digests=digests, options=options))
    Path("person.usda").write_text(Path("person.usda").read_text().replace("net.pt2", model))


_REFUSAL = "can run code as it is loaded, expected .onnx (or --trust-models)\n"


@pytest.mark.parametrize("words", [(), ("--dry-run",), ("--force",)])
def test_a_recipe_that_names_a_model_with_code_ends_the_cook(
    person: Path, capsys: Capsys, words: tuple[str, ...]
) -> None:
    said = failed(capsys, "cook", "shot.usda", *words)
    assert said == f"shot.usda -> person.usda -> recipe -> source 3: net.pt2 {_REFUSAL}"


def test_who_trusts_models_comes_to_the_photo(person: Path, capsys: Capsys) -> None:
    assert "front.png" in failed(capsys, "cook", "shot.usda", "--trust-models")
    assert cook(capsys, "shot.usda", "--trust-models", "--dry-run")[0] == 1


def test_so_does_editing_such_a_result(person: Path, capsys: Capsys) -> None:
    for more in ((), ("--iterations", "0")):
        said = failed(capsys, "fit-photo", "--edit", "person.usda", "--force", *more)
        assert said == f"person.usda -> recipe -> source 3: net.pt2 {_REFUSAL}"
    code, _, err = run(capsys, "fit-photo", "--edit", "person.usda", "--force", "--trust-models")
    assert (code, "front.png" in err) == (2, True)


@links
def test_a_link_to_a_model_with_code_is_one(person: Path, capsys: Capsys) -> None:
    Path("net.onnx").unlink()
    Path("net.onnx").symlink_to("net.pt2")
    _fit("net.onnx")
    assert failed(capsys, "cook", "person.usda") == f"person.usda -> recipe -> source 3: net.onnx {_REFUSAL}"
