"""README and tour, run line by line as they stand; the table of commands and the project's facts."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from command_line import Capsys, done, failed, plain_actions
from pages import blocks
from places import REPOSITORY

import facepipe
from facepipe.cli import commands_of, demo_command
from facepipe.performing import read_kept
from facepipe.verbs.blend import BlendFaces

SHARED = REPOSITORY.parent / "shared"
README = (REPOSITORY / "README.md").read_text(encoding="utf-8")
TOUR, COMMANDS, BLEND, BONES = (
    (REPOSITORY / "docs" / f"{name}.md").read_text(encoding="utf-8") for name in ("tour", "commands", "blend", "bones")
)


def run_lines(folder: Path, *pages: str) -> set[str]:
    """The files that every console line of the first page, in order, and then the Python of all pages make."""
    folder.mkdir()
    (folder / "samples").symlink_to(REPOSITORY / "samples")
    lines = [line for block in blocks(pages[0], "console") for line in block.splitlines()]
    tools = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    commands = [[shutil.which("sh") or "sh", "-c", line] for line in lines]
    commands += [[sys.executable, "-c", block] for page in pages for block in blocks(page, "python")]
    for command in commands:
        done = subprocess.run(command, cwd=folder, env=tools, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{command[-1]}: {done.stdout}{done.stderr}"
        assert "Traceback" not in done.stderr
    return {path.name for path in folder.iterdir()}


@pytest.mark.slow
def test_the_readme_runs(tmp_path: Path) -> None:
    pytest.importorskip("wasmtime")
    made = run_lines(tmp_path / "project", README)
    assert {
        "smile.fpb",
        "person.png",
        "levels.usdc",
        "child.glb",
        "child.onnx",
        "points.npz",
        "hero_arkit.glb",
        "mixed.glb",
    } <= made


@pytest.mark.slow
def test_the_tour_runs(tmp_path: Path) -> None:
    """Every console line in order, then the Python of tour.md, blend.md and bones.md."""
    assert len("".join(blocks(TOUR, "console")).splitlines()) > 12
    folder = tmp_path / "project"
    made = run_lines(folder, TOUR, BLEND, BONES)
    assert {
        "head.usdc",
        "head.glb",
        "head.onnx",
        "points.npz",
        "smile.png",
        "head.landmarks.usda",
        "child.glb",
        "live.usda",
        "mixed.glb",
        "poses.usda",
        "jaw.fpb",
    } <= made
    kept = read_kept(folder / "live.usda", BlendFaces)  # made in Python as the page says, it can be edited
    assert [source.name for source in kept.values["sources"]] == ["head.usdc", "other.usdc"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "result"),
    [
        pytest.param("from_scan", "anna.glb", marks=pytest.mark.needs_torch),
        pytest.param("from_glb", "game.glb", marks=pytest.mark.gate),
        ("own_head", "hero_arkit.glb"),
    ],
)
def test_the_tutorials_run(tmp_path: Path, name: str, result: str) -> None:
    assert result in run_lines(tmp_path / "project", (REPOSITORY / "docs" / f"{name}.md").read_text(encoding="utf-8"))


@pytest.mark.needs_torch
@pytest.mark.gate
@pytest.mark.slow
def test_the_photo_fit_of_the_tour_runs(tmp_path: Path) -> None:
    """Its lines as they stand, on a real photo, with landmarks by the project's own network."""
    photo = SHARED / "data" / "photos" / "astronaut.png"
    if not photo.exists():
        pytest.skip("the shared data is not beside the project")
    shutil.copy(photo, tmp_path / "portrait.jpg")
    tools = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    (lines,) = (block.splitlines() for block in blocks(TOUR, "sh") if "fit-photo" in block)
    for line in ["facepipe sample -o head.usdc", *lines, "facepipe validate me.usdc"]:
        done = subprocess.run(line, shell=True, cwd=tmp_path, env=tools, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{line}: {done.stdout}{done.stderr}"
    assert {"report.html", "report.json"} <= {one.name for one in (tmp_path / "me").iterdir()}
    assert (tmp_path / "me.glb").stat().st_size > 0


@pytest.mark.slow
def test_the_demo_makes_everything(tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(demo_command, "_TEXTURES", 64)
    printed = done(capsys, "demo", "demo", quiet=False)
    assert {"head.usdc", "head.glb", "head.onnx", "points.npz", "sheet.png"} <= {
        one.name for one in (tmp_path / "demo").iterdir()
    }
    assert printed.count("no errors, no warnings") == 3, printed
    assert facepipe.open(tmp_path / "demo" / "head.usdc").parts().materials  # its textures are there too
    assert "--force" in failed(capsys, "demo", "demo", folder=tmp_path)


def test_the_table_lists_every_command() -> None:
    """But for small ones that docs/actions.md has."""
    listed = re.findall(r"^\| `facepipe ([\w-]+)", COMMANDS, re.MULTILINE)
    assert commands_of().keys() - plain_actions() <= {*listed} <= {*commands_of()}
    assert len({*listed}) == len(listed)


def test_the_readme_is_short() -> None:
    assert len(README.split()) < 900


def test_pictures_and_links_of_the_readme_are_there() -> None:
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (REPOSITORY / target).exists(), target


def test_the_citation_is_of_this_version() -> None:
    citation = (REPOSITORY / "CITATION.cff").read_text(encoding="utf-8")
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert f"\nversion: {project['version']}\n" in citation


def test_continuous_integration_runs_the_readmes_test_command() -> None:
    command = blocks(README, "sh")[1].strip().rpartition("&& .venv/bin/")[2]
    assert command in (REPOSITORY / ".ci" / "run").read_text()


@pytest.mark.parametrize("kind", ["dependencies", "dev", "docs"])
def test_every_dependency_is_justified_and_pinned(kind: str) -> None:
    text = (REPOSITORY / "pyproject.toml").read_text()
    project = tomllib.loads(text)["project"]
    for entry in project.get(kind) or project["optional-dependencies"][kind]:
        assert re.search(rf'"{re.escape(entry)}",\s+# \w', text), f"{entry} has no reason"
        assert re.search(r">=\d", entry), f"{entry} has no range"
