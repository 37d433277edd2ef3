"""Hosted CI does what the contributing page says, on what the metadata promises."""

from __future__ import annotations

import re
import tomllib

from pages import blocks
from places import REPOSITORY

WORKFLOW = (REPOSITORY / ".github/workflows/ci.yml").read_text(encoding="utf-8")
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_its_checks_are_those_of_contributors() -> None:
    page = (REPOSITORY / "CONTRIBUTING.md").read_text(encoding="utf-8")
    checks = next(block for block in blocks(page, "sh") if "ruff" in block).splitlines()
    run = re.findall(r"- run: (.+)", WORKFLOW)
    assert [line for line in checks if line not in run] == []


def test_it_runs_on_every_python_and_system_that_the_metadata_names() -> None:
    named = [one.rpartition(" :: ")[2] for one in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", one)]
    matrix = re.search(r"python: \[(.+)\]", WORKFLOW)
    assert matrix is not None
    assert re.findall(r'"([\d.]+)"', matrix[1]) == named
    assert PROJECT["requires-python"] == f">={named[0]}"
    systems = {one.rpartition(" :: ")[2] for one in PROJECT["classifiers"] if one.startswith("Operating System")}
    assert systems == {"Linux", "MacOS", "Windows"}
    assert "os: [ubuntu-latest, windows-latest, macos-latest]" in WORKFLOW


def test_its_actions_are_pinned_by_commit() -> None:
    used = re.findall(r"uses: *(\S+)(.*)", WORKFLOW)
    assert used
    assert [one for one, note in used if not re.fullmatch(r"[\w./-]+@[0-9a-f]{40}", one) or "# v" not in note] == []


def test_continuous_integration_begins_with_the_commands_of_readme() -> None:
    script = (REPOSITORY / ".ci" / "run").read_text(encoding="utf-8")
    program = re.search(r"\| awk -v number=\"\$1\" '(.+?)'\)", script)
    assert program is not None
    readme = (REPOSITORY / "README.md").read_text(encoding="utf-8").partition("## Install\n")[2].partition("\n## ")[0]
    lines = [line for block in blocks(readme, "sh") for line in block.splitlines()]
    assert [line.startswith("python3 -m venv .venv && .venv/bin/pip install -e ") for line in lines] == [True, True]
    assert ('"."' in lines[0] or " -e . " in lines[0], "[dev]" in lines[1], "pytest -n auto" in lines[1]) == (True,) * 3
    assert (
        script.index("readme 1 demo")
        < script.index("readme 2 whole")
        < script.index('[dev,train,scan,server]" -c .ci/torch.txt\n')
    )


def test_everything_runs_each_night_and_leaves_out_no_slow_test() -> None:
    night = WORKFLOW.partition("\n  full:\n")[2]
    assert "schedule:\n    - cron:" in WORKFLOW
    assert "if: github.event_name == 'schedule'" in night
    assert night.rstrip().endswith("- run: .ci/full")
    script = (REPOSITORY / ".ci" / "run").read_text(encoding="utf-8")
    chosen = re.findall(r'-m "([^"]*(?:slow|gate)[^"]*)"', script)
    assert chosen == ["(needs_torch or needs_scan) and not slow or gate", "slow and not gate"]
    assert '"slow and not gate" --nothing-left-out' in script


def test_licences_of_all_that_ships_are_in_the_wheel() -> None:
    texts = {file for pattern in PROJECT["license-files"] for file in REPOSITORY.glob(pattern)}
    names = re.compile(r"LICEN[SC]E|licences")
    rooms = [REPOSITORY / name for name in ("facepipe", "exporters", "schemas")]
    shipped = {one for room in rooms for one in room.rglob("*") if one.is_file() and names.search(one.as_posix())}
    shipped = {one for one in shipped if not {"node_modules", "dist"} & {*one.parts}}
    assert texts == shipped | {REPOSITORY / "LICENSE"}
