"""`facepipe cook`: what is stale is made again, in order, to the bytes that its commands write."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from command_line import content, done, exit_code, failed
from cook_chain import CHAIN, LINES, actions, change, cook, layer, make_chain, why
from faces import grid_mesh, tiny_face
from pages import blocks
from places import REPOSITORY, SUPPORT

import facepipe
from facepipe import cooking
from facepipe.core.errors import FacepipeError
from facepipe.core.locks import locked
from facepipe.parts import FaceParts
from facepipe.stage import save_parts

Capsys = pytest.CaptureFixture[str]


@pytest.fixture
def chain(folder: Path, capsys: Capsys) -> Path:
    make_chain(folder, capsys)
    return folder


def _times(folder: Path) -> dict[str, int]:
    return {file.name: file.stat().st_mtime_ns for file in folder.iterdir()}


def _by_hand(folder: Path, capsys: Capsys, *names: str) -> dict[str, bytes]:
    """What the commands write for the results called `names`, in order."""
    for line in LINES:
        if line[line.index("-o") + 1] in names:
            done(capsys, *line, "--force", quiet=False)
    return {name: (folder / name).read_bytes() for name in CHAIN}


def test_nothing_is_done_where_nothing_has_changed(chain: Path, capsys: Capsys) -> None:
    before, times = content(chain), _times(chain)
    code, report, err = cook(capsys, "shot.usda", "side.usda")
    assert (code, err, actions(report), why(report)) == (0, "", dict.fromkeys(CHAIN, "up to date"), {})
    assert (content(chain), _times(chain)) == (before, times)


def test_what_depends_on_a_changed_source_is_made_as_its_commands_make_it(chain: Path, capsys: Capsys) -> None:
    times = _times(chain)
    change("b.usda")
    code, report, _ = cook(capsys, "shot.usda", "side.usda")
    assert code == 0
    assert actions(report) == {**dict.fromkeys(CHAIN[:3], "cooked"), "side.usda": "up to date"}
    assert why(report) == {
        "mix.usda": ["b.usda changed"],
        "controls.usda": ["mix.usda was cooked and changed"],
        "posed.usda": ["controls.usda was cooked and changed"],
    }
    now = _times(chain)
    assert sorted(now) == sorted(times)
    assert {name for name in now if now[name] != times[name]} == {"b.usda", *CHAIN[:3]}
    cooked = {name: Path(name).read_bytes() for name in CHAIN}
    assert cooked == _by_hand(chain, capsys, *CHAIN[:3])
    assert cook(capsys, "shot.usda")[1]["nodes"][0]["action"] == "up to date"


def test_a_table_changes_what_follows_it_alone(chain: Path, capsys: Capsys) -> None:
    with Path("table.toml").open("a") as table:
        table.write('[slider.up]\nchannels = { "jaw:ty" = 0.25 }\n')
    _, report, _ = cook(capsys, "posed.usda")
    assert actions(report) == {"mix.usda": "up to date", "controls.usda": "cooked", "posed.usda": "cooked"}
    assert "up" in {slider.name for slider in facepipe.open("posed.usda").sliders}


def test_what_comes_out_as_before_stops_there(chain: Path, capsys: Capsys) -> None:
    """A source is tried and put back: the file made of it is cooked to its old bytes, and nothing above is."""
    before, old = content(chain), Path("b.usda").read_bytes()
    change("b.usda")
    assert actions(cook(capsys, "mix.usda")[1]) == {"mix.usda": "cooked"}
    Path("b.usda").write_bytes(old)
    times = _times(chain)
    _, report, _ = cook(capsys, "shot.usda")
    assert actions(report) == {"mix.usda": "cooked", "controls.usda": "up to date", "posed.usda": "up to date"}
    assert content(chain) == before
    assert {name for name, time in _times(chain).items() if time != times[name]} == {"mix.usda"}


def test_force_makes_everything_again_to_the_same_bytes(chain: Path, capsys: Capsys) -> None:
    before = content(chain)
    code, report, _ = cook(capsys, "shot.usda", "side.usda", "--force")
    assert (code, set(actions(report).values())) == (0, {"cooked"})
    assert content(chain) == before


def test_a_dry_run_writes_nothing_and_tells_what_a_cook_would_do(chain: Path, capsys: Capsys) -> None:
    change("b.usda")
    before, times = content(chain), _times(chain)
    code, report, _ = cook(capsys, "shot.usda", "side.usda", "--dry-run")
    assert code == 1
    assert actions(report) == {**dict.fromkeys(CHAIN[:3], "stale"), "side.usda": "up to date"}
    assert why(report)["posed.usda"] == ["controls.usda is to be cooked"]
    assert (content(chain), _times(chain)) == (before, times)
    assert cook(capsys, "shot.usda")[0] == 0
    assert cook(capsys, "shot.usda", "--dry-run")[0] == 0


_KILLED = """
import contextlib, os, signal, sys
from facepipe.cooking import cook
def kill(*_):
    os.kill(os.getpid(), signal.SIGKILL)
class Bar:
    update = kill
@contextlib.contextmanager
def watch(label, steps):
    yield Bar()
def on_node(node):
    if node.action == "cooked":
        kill()
cook(["shot.usda"], **{"between": {"on_node": on_node}, "within": {"watch": watch}}[sys.argv[1]])
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
@pytest.mark.parametrize(
    ("moment", "fresh"), [pytest.param("between", ["mix.usda"], marks=pytest.mark.slow), ("within", [])]
)
def test_killed_and_begun_again_gives_the_same_bytes(
    chain: Path, capsys: Capsys, tmp_path: Path, moment: str, fresh: list[str]
) -> None:
    """Killed after a file, or while one is made, with its lock held."""
    change("b.usda")
    whole = tmp_path / "whole"
    shutil.copytree(chain, whole, ignore=shutil.ignore_patterns("whole"))
    killed = subprocess.run([sys.executable, "-c", _KILLED, moment], cwd=chain, check=False)
    assert killed.returncode == -9
    assert [name for name in CHAIN if Path(name).read_bytes() != (whole / name).read_bytes()] == fresh
    _, report, _ = cook(capsys, "shot.usda")
    assert actions(report) == {name: "up to date" if name in fresh else "cooked" for name in CHAIN[:3]}
    assert cook(capsys, str(whole / "shot.usda"))[0] == 0
    assert {name: Path(name).read_bytes() for name in CHAIN} == {name: (whole / name).read_bytes() for name in CHAIN}
    assert not list(chain.glob(".*.lock"))


def test_a_moved_folder_is_up_to_date_and_cooks_to_the_same_bytes(chain: Path, capsys: Capsys, tmp_path: Path) -> None:
    moved = tmp_path / "else" / "where"
    shutil.copytree(chain, moved, ignore=shutil.ignore_patterns("else"))
    before = content(moved)
    code, report, _ = cook(capsys, str(moved / "shot.usda"), str(moved / "side.usda"))
    assert (code, set(actions(report).values())) == (0, {"up to date"})
    cook(capsys, str(moved / "shot.usda"), str(moved / "side.usda"), "--force")
    assert content(moved) == before
    assert str(tmp_path).encode() not in b"".join(before.values())


def test_a_lost_layer_is_made_again_from_its_recipe_above(chain: Path, capsys: Capsys) -> None:
    """A result that stands on a layer at another place than its recipe's source is put right."""
    text = Path("controls.usda").read_text()
    before = content(chain)
    Path("controls.usda").write_text(text.replace("@./mix.usda@", "@./gone/mix.usda@"))
    code, report, _ = cook(capsys, "controls.usda")
    assert code == 0
    assert why(report) == {"controls.usda": ["mix.usda, which it stands on, is lost"]}
    assert content(chain) == before


def test_edits_in_a_layer_above_stay(chain: Path, capsys: Capsys) -> None:
    before = Path("shot.usda").read_bytes()
    change("b.usda")
    assert cook(capsys, "shot.usda")[0] == 0
    assert Path("shot.usda").read_bytes() == before


@pytest.mark.skipif(sys.platform == "win32", reason="links need a right")
def test_a_link_leads_to_the_file_that_is_cooked(chain: Path, capsys: Capsys) -> None:
    Path("latest.usda").symlink_to("mix.usda")
    change("b.usda")
    assert actions(cook(capsys, "latest.usda")[1]) == {"mix.usda": "cooked"}
    assert Path("latest.usda").is_symlink()
    assert actions(cook(capsys, "mix.usda")[1]) == {"mix.usda": "up to date"}


def test_standalone_files_stay_standalone(folder: Path, capsys: Capsys) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "-o", "flat.usda", "--flatten")
    done(capsys, "blend", "a.usda", "b.usda", "-o", "packed.usdz")
    before = content(folder)
    _, report, _ = cook(capsys, "flat.usda", "packed.usdz", "--force")
    assert set(actions(report).values()) == {"cooked"}
    assert content(folder) == before


# --- bad input


def test_files_that_depend_on_each_other_are_named(folder: Path, capsys: Capsys) -> None:
    assert exit_code("blend", "a.usda", "b.usda", "-o", "c.usda") == 0
    assert exit_code("blend", "c.usda", "other.usda", "-o", "d.usda") == 0
    text = Path("c.usda").read_text()
    Path("c.usda").write_text(text.replace('"./b.usda"', '"./d.usda"'))
    capsys.readouterr()
    line = failed(capsys, "cook", "d.usda")
    assert line == "d.usda -> c.usda -> d.usda: depends on itself, expected sources that do not\n"


def test_a_source_that_is_gone_is_named_with_its_trail(chain: Path, capsys: Capsys) -> None:
    Path("b.usda").unlink()
    line = failed(capsys, "cook", "shot.usda")
    assert line.startswith("shot.usda -> posed.usda -> controls.usda -> mix.usda -> source 2: b.usda: no such file")


def test_a_layer_that_is_gone_is_named_where_no_recipe_makes_it(chain: Path, capsys: Capsys) -> None:
    Path("posed.usda").unlink()
    assert failed(capsys, "cook", "shot.usda") == "shot.usda: stands on posed.usda, which is gone, expected it there\n"


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('"blend"', '"stir"', "mix.usda -> recipe: is of 'stir', expected one of animate, apply-bones, bake-photo, "),
        ('recipe:version = "0.1.0"', 'recipe:version = "9.0.0"', "made by facepipe 9.0.0, expected"),
        ('["./a.usda", "./b.usda"]', '["./a.usda"]', "1 sources and 2 digests"),
    ],
)
def test_recipes_that_cannot_be_read_are_refused(
    chain: Path, capsys: Capsys, old: str, new: str, expected: str
) -> None:
    text = Path("mix.usda").read_text()
    assert old in text
    Path("mix.usda").write_text(text.replace(old, new))
    assert expected in failed(capsys, "cook", "shot.usda")


def test_another_topology_stops_the_cook_and_leaves_what_was_there(chain: Path, capsys: Capsys) -> None:
    save_parts(FaceParts(name="Tiny", meshes=(grid_mesh(size=5),)), Path("b.usda"))
    line = failed(capsys, "cook", "shot.usda")
    assert line.startswith("mix.usda -> b.usda")


@pytest.mark.parametrize(
    ("name", "expected"), [("none.usda", "no such file"), ("face.obj", "suffix '.obj'"), (".", "is no regular file")]
)
def test_what_is_no_stage_is_refused(folder: Path, capsys: Capsys, name: str, expected: str) -> None:
    Path("face.obj").write_text("v 0 0 0\n")
    assert expected in failed(capsys, "cook", name)


@pytest.mark.parametrize("name", ["broken.usda", "above.usda"])
def test_a_damaged_source_is_told_in_one_line(chain: Path, capsys: Capsys, name: str) -> None:
    """Damaged itself, or the layer below it; by a cook and by a command that reads its digest first."""
    Path("broken.usda").write_text("#usda 1.0\n(\n")
    layer("above.usda", '(subLayers = [@./broken.usda@]\n defaultPrim = "Tiny")')
    assert "can't be read as USD" in failed(capsys, "cook", name)
    assert failed(capsys, "sliders", name, "--set", "open=1", "-o", "out.usda").startswith(f"{name}: ")


def test_a_layer_with_unsaved_changes_is_refused(chain: Path) -> None:
    face = facepipe.open("b.usda")
    face.stage.GetRootLayer().comment = "not saved"
    before = content(chain)
    with pytest.raises(FacepipeError, match="changes that are not saved"):
        cooking.cook(["shot.usda"])
    assert content(chain) == before


def test_json_tells_what_was_done_before_an_error(chain: Path, capsys: Capsys) -> None:
    change("b.usda")
    Path("table.toml").write_text("[slider.drop")
    code, report, err = cook(capsys, "shot.usda")
    assert (code, report["good"], actions(report)) == (2, False, {"mix.usda": "cooked"})
    assert err == f"facepipe: {report['error']}\n"
    Path("b.usda").unlink()
    code, report, err = cook(capsys, "shot.usda")
    assert (code, report["good"], report["nodes"]) == (2, False, [])
    assert err == f"facepipe: {report['error']}\n"


# --- other processes, other layers


def test_a_file_that_another_process_cooks_is_waited_for_and_not_cooked_twice(chain: Path) -> None:
    change("b.usda")
    second: list[cooking.CookReport] = []
    with locked("mix.usda"):
        thread = threading.Thread(target=lambda: second.append(cooking.cook(["mix.usda"])))
        thread.start()
        assert exit_code("blend", "--edit", "mix.usda", "--force") == 0
    thread.join()
    assert [(node.action, node.why) for node in second[0].nodes] == [("up to date", ("another process cooked it",))]


def test_a_stage_that_is_open_sees_files_changed_on_disk(chain: Path) -> None:
    """A host holds layers in memory while other processes write their files."""
    held = facepipe.open("b.usda")
    script = "import cook_chain; cook_chain.change('b.usda')"
    folders = [str(SUPPORT), *sys.path]
    subprocess.run(
        [sys.executable, "-c", script], check=True, env={**os.environ, "PYTHONPATH": os.pathsep.join(folders)}
    )
    cooking.cook(["mix.usda"])
    cooked = Path("mix.usda").read_bytes()
    del held
    assert exit_code("blend", "a.usda", "b.usda", "-o", "mix.usda", "--force", *LINES[0][5:]) == 0
    assert Path("mix.usda").read_bytes() == cooked


def test_recipes_below_references_are_found(chain: Path, capsys: Capsys) -> None:
    below = [
        f'def "{name}" (prepend {arc} = @{file}@) {{}}'
        for name, arc, file in (("Anna", "references", "./posed.usda"), ("Ben", "payload", "side.usda"))
    ]
    layer("set.usda", "\n".join(below))
    change("a.usda")
    _, report, _ = cook(capsys, "set.usda")
    assert actions(report) == dict.fromkeys(CHAIN, "cooked")


def test_faces_without_recipes_need_no_cook(folder: Path, capsys: Capsys) -> None:
    save_parts(tiny_face(), folder / "plain.usda")
    done(capsys, "sample", "-o", "head.usda", "--textures", "0")
    code, report, _ = cook(capsys, "plain.usda", "head.usda", "--force")
    assert (code, report["nodes"], report["good"]) == (0, [], True)


def test_checks_are_a_gate(chain: Path, capsys: Capsys) -> None:
    code, report, _ = cook(capsys, "side.usda", "--validate")
    assert (code, list(report["findings"])) == (0, ["side.usda"])
    change("a.usda")
    deleted = 'over "Tiny" (delete apiSchemas = ["FacepipeFaceAPI"]) {}'
    layer("bad.usda", f'(subLayers = [@./side.usda@]\n defaultPrim = "Tiny")\n{deleted}')
    code, report, _ = cook(capsys, "bad.usda", "--validate")
    assert (code, actions(report)) == (1, {"side.usda": "cooked"})
    assert any(one["severity"] == "error" for one in report["findings"]["bad.usda"])


def test_the_text_tells_of_each_file_and_why(chain: Path, capsys: Capsys) -> None:
    change("b.usda")
    assert exit_code("cook", "shot.usda", "--dry-run") == 1
    assert capsys.readouterr().out == (
        "mix.usda: blend: stale (b.usda changed)\n"
        "controls.usda: sliders: stale (mix.usda is to be cooked)\n"
        "posed.usda: sliders: stale (controls.usda is to be cooked)\n"
        "3 file(s) with recipes: 3 to be cooked\n"
    )


def test_the_report_holds_what_the_command_reports(chain: Path, capsys: Capsys) -> None:
    _, report, _ = cook(capsys, "posed.usda", "--force")
    printed = json.loads(done(capsys, *LINES[2], "--force", "--json"))
    assert report["nodes"][-1]["report"]["values"] == printed["values"]


def test_the_python_of_the_page_runs(folder: Path, capsys: Capsys) -> None:
    page = (REPOSITORY / "docs" / "cook.md").read_text(encoding="utf-8")
    done(capsys, "blend", "a.usda", "b.usda", "-o", "child.usdc")
    exec("".join(blocks(page, "python")), {})
    assert capsys.readouterr().out == "child.usdc blend up to date ()\n"
