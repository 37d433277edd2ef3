"""What costs a few bytes of a plan or table is counted before a run takes time or memory for it."""

from __future__ import annotations

import glob
import inspect
import os
import sys
from pathlib import Path

import pytest
from conftest import PLAN, Runner

from facepipe.core.errors import InputError
from facepipe.farm.plan import Plan, Row, Step, each, plan_of, read_table

TREE = (
    "a.glb",
    "b.bin",
    ".hidden.glb",
    "heads/a.glb",
    "heads/old/a.glb",
    "heads/old/x/y/c.glb",
    ".dot/d.glb",
    "x[1].glb",
)


@pytest.mark.parametrize("key", ["seconds", "memory_mb", "priority"])
@pytest.mark.parametrize("value", [f"1{'0' * 400}", f"-1{'0' * 400}", "nan", "inf", "-inf", "1e300"])
def test_limits_of_a_step_are_numbers_that_options_may_be(run_plan: Runner, key: str, value: str) -> None:
    with pytest.raises(InputError, match=rf"steps\.game -> {key}: .*, expected a"):
        run_plan(f"{PLAN}{key} = {value}\n")


def steps(count: int, line: str) -> str:
    return "".join(f'[steps.s{number}]\nrun = "{line}"\nout = "s{number}/{{name}}"\n' for number in range(count))


def test_a_plan_has_steps_that_can_be_counted(run_plan: Runner) -> None:
    with pytest.raises(InputError, match="302 steps, expected at most 256"):
        run_plan(PLAN + steps(300, "copy {face}"))


def planned(rows: int, *made: Step) -> Plan:
    faces = [Row("a", {"name": "a"})] * rows
    return plan_of("plan", Path("show"), "built", faces, {step.name: step for step in made})


def test_faces_times_steps_and_what_they_need_are_counted() -> None:
    needs = [Step(name=f"s{number}", words=("copy", "{name}")) for number in range(100)]
    words = tuple(f"{{{one.name}}}" for one in needs)
    assert len(planned(10_000, *needs).steps) == 100
    for step in (Step(name="per-face", words=words * 2), Step(name="for-all", words=words, once=True)):
        with pytest.raises(InputError, match="100,000 faces are too many for 101 steps"):
            planned(100_000, *needs, step)


def test_text_of_all_lines_is_counted() -> None:
    with pytest.raises(InputError, match="100,000 faces are too many for 1 steps"):
        planned(100_000, Step(name="long", words=("x" * 30_000,)))


@pytest.mark.parametrize(("run", "out"), [("copy {face} {{a}}", "x/{name}"), ("copy {face}", "x/{{a}}")])
def test_a_value_that_is_named_again_and_again_makes_no_long_line(run_plan: Runner, run: str, out: str) -> None:
    rows = f'rows = [{{ name = "ada", face = "heads/ada.bin", a = "{"A" * 100_000}" }}]'
    many = "{a}" * 100_000  # ten gigabytes
    text = f'out = "built"\n[faces]\n{rows}\n[steps.s]\nrun = "{run}"\nout = "{out}"\n'.replace("{{a}}", many)
    assert "characters with its values" in run_plan(text).failures[0]


@pytest.mark.parametrize("line", ["copy {fac}", "copy {\\u001b[2J}", "copy {one}"])
def test_what_is_wrong_with_a_step_has_no_control_characters(run_plan: Runner, line: str) -> None:
    """They would reach the terminal: of columns, and of names in braces."""
    rows = 'rows = [{ name = "ada", "fa\\u001bce" = "heads/ada.bin", "o\\nne" = "x" }]'
    text = f'out = "built"\n[faces]\n{rows}\n[steps.s]\nrun = "{line}"\nout = "x/\\u001b[2J"\n'
    report = run_plan(f'{text}[steps.t]\nrun = "copy base.bin"\nout = "x/\\u001b[2J"\n')
    assert report.failures
    assert all(map(str.isprintable, report.failures)), report.failures


def test_words_of_a_line_are_counted_together(run_plan: Runner) -> None:
    rows = f'rows = [{{ name = "ada", face = "heads/ada.bin", a = "{"A" * 1000}" }}]'
    report = run_plan(PLAN.replace('glob = "heads/*.bin"', rows).replace("copy {face}", "copy {face}" + " {a}" * 1000))
    assert "with its values" in report.failures[0]


def tree(folder: Path) -> None:
    for name in TREE:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def faces(folder: Path, pattern: str) -> list[str]:
    return [row.values["face"] for row in read_table("faces", folder, {"glob": pattern})]


@pytest.mark.parametrize(
    "pattern",
    [
        "*.glb", "**/*.glb", "**/**/*.glb", "heads/**/a.glb", "heads/**/**/a.*", "**/old/**/*.glb", "**/x/y/*",
        "*/*/*.glb", "heads/a.glb", "./heads/*.glb", "heads//*.glb", "*/./a.glb", ".*", ".dot/*.glb", "x[[]1].glb",
        "?.bin", "[ab].*", "**/[!a].glb",
    ],
)  # fmt: skip
def test_globs_find_what_pythons_find(tmp_path: Path, pattern: str) -> None:
    tree(tmp_path)
    found = {os.path.normpath(one) for one in glob.glob(pattern, root_dir=tmp_path, recursive=True)}  # noqa: PTH207
    assert {os.path.normpath(one) for one in faces(tmp_path, pattern)} == found


@pytest.mark.parametrize("pattern", ["", "/", "none/", "heads/*/../*", "*" * 5000, "**/" * 1400, "a\0*", "[", "*/\0"])
def test_odd_patterns_are_a_line(tmp_path: Path, pattern: str) -> None:
    tree(tmp_path)
    with pytest.raises(InputError, match=r"^faces\.glob: "):
        faces(tmp_path, pattern)


def test_ways_through_a_pattern_are_no_more_than_folders(tmp_path: Path) -> None:
    """Forty folders in each other have more ways for twelve ** than a disk has files."""
    deep = tmp_path.joinpath(*"a" * 40)
    deep.mkdir(parents=True)
    (deep / "x.glb").touch()
    assert len(faces(tmp_path, f"{'**/' * 12}*.glb")) == 1
    assert len(faces(tmp_path, f"{'**/a/' * 12}**/*.glb")) == 1


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_folders_in_each_other_and_links_to_them_end(tmp_path: Path) -> None:
    tmp_path.joinpath(*"d" * 300).mkdir(parents=True)
    for name in "abc":
        (tmp_path / name).symlink_to(".")
    (tmp_path / "x.glb").touch()
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(len(inspect.stack()) + 200)
    try:
        assert faces(tmp_path, "**/*.glb") == ["x.glb"]
    finally:
        sys.setrecursionlimit(limit)


@pytest.mark.parametrize(
    "text",
    ["a\n" + "b\n" * 1_000_002, "a,b,c,d\n" + "1,2,3,4\n" * 760_000, ",".join(f"c{number}" for number in range(4097))],
)
def test_a_table_of_text_is_counted(tmp_path: Path, text: str) -> None:
    (tmp_path / "faces.csv").write_text(text)
    with pytest.raises(InputError, match="expected at most"):
        read_table("faces", tmp_path, {"csv": "faces.csv"})


def test_a_range_has_a_million_faces_at_most(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at most 1,000,000 numbers"):
        read_table("faces", tmp_path, {"range": {"seed": [1, 1_000_001]}})


def test_a_step_over_all_faces_has_a_long_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is bounded for each face is not for the one line that has them all."""
    from facepipe.farm.plan import line_of, tasks_of

    monkeypatch.chdir(tmp_path)
    rows = [Row(f"face{number}", {"name": f"face{number}"}) for number in range(5000)]
    made = {
        "one": Step(name="one", words=("x",), out="{name}"),
        "all": Step(name="all", words=("{one}", "--last"), once=True),
    }
    plan = plan_of("plan", tmp_path, str(tmp_path / "built"), rows, made)
    task = next(one for one in tasks_of(plan) if one.row is None)
    words = line_of(plan, task, {"one": [f"built/face{number}" for number in range(5000)]})
    assert len(words) == 5001
    with pytest.raises(InputError, match="no file is called like"):
        each("none*", ("copy", "{face}"), "x")
