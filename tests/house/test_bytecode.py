"""An installation of bytecode alone: nothing in the house reads its own source at run time."""

from __future__ import annotations

import compileall
import importlib
import shutil
from pathlib import Path

import fresh_process
import pytest
from fresh_process import End
from test_imports import OURS, lines

_PROGRAM = """
import sys
from facepipe.cli import main
_, root, ours, *sys.argv[1:] = sys.argv
try:
    code = main()
except SystemExit as end:
    code = end.code
files = {str(module.__file__) for name, module in sys.modules.items() if name.partition(".")[0] in ours.split()}
wrong = [file for file in files if not (file.startswith(root) and file.endswith(".pyc"))]
sys.exit(f"not from bytecode: {wrong}" if wrong else code)
"""


@pytest.fixture(scope="module")
def bytecode(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with our packages, compiled, and without their source."""
    root = tmp_path_factory.mktemp("bytecode")
    for name in OURS:
        package = Path(str(importlib.import_module(name).__file__)).parent
        shutil.copytree(package, root / name, ignore=shutil.ignore_patterns("__pycache__", "node_modules"))
    assert compileall.compile_dir(root, quiet=1, legacy=True)
    sources = [*root.rglob("*.py")]
    assert len(sources) > 300
    for file in sources:
        file.unlink()
    return root


def run(folder: Path, bytecode: Path, line: str) -> End:
    """A command line in a process that has those packages and no others of ours."""
    done = fresh_process.python(folder, bytecode, "-c", _PROGRAM, bytecode, " ".join(OURS), *line.split())
    assert (done.returncode, "not from bytecode" in done.stderr) == (0, False), done.stderr
    return done


def test_every_command_has_its_help(bytecode: Path, tmp_path: Path) -> None:
    texts = fresh_process.commands(tmp_path, bytecode, *(" ".join([*words, "--help"]) for words in lines()))
    assert {end.returncode for end in texts} == {0}
    assert all(len(end.stdout) > 300 for end in texts)
    assert "mix faces by region" in run(tmp_path, bytecode, "--help").stdout


def test_the_public_api_is_all_there(bytecode: Path, tmp_path: Path) -> None:
    """With what packages give on demand."""
    program = """if True:
        import facepipe, facepipe.rig, inspect
        for name in dir(facepipe):
            getattr(facepipe, name)
        print(facepipe.__file__, facepipe.rig.Person.__name__, *inspect.signature(facepipe.inspect).parameters)"""
    done = fresh_process.python(tmp_path, bytecode, "-c", program)
    assert done.stdout == f"{bytecode / 'facepipe' / '__init__.pyc'} Person face\n", done.stderr


def test_an_add_on_is_not_made_of_what_blender_cannot_run(bytecode: Path, tmp_path: Path) -> None:
    (done,) = fresh_process.commands(tmp_path, bytecode, "blender-addon -o facepipe.zip")
    assert done.stderr.startswith("facepipe: facepipe: is here as bytecode alone, expected its source")
    assert [*tmp_path.iterdir()] == []


@pytest.mark.gate
@pytest.mark.slow
def test_faces_are_made_blended_and_exported(bytecode: Path, tmp_path: Path) -> None:
    """By children of a batch too, which are started by the names of their modules."""
    for seed in (1, 2):
        run(tmp_path, bytecode, f"sample -o {seed}.usda --seed {seed} --textures 0")
    run(tmp_path, bytecode, "blend 1.usda 2.usda -o both.usda")
    run(tmp_path, bytecode, "batch --each *.usda -o {name}.glb --processes 1 --thumbnails 0 -- export {face}")
    assert all((tmp_path / f"{name}.glb").stat().st_size > 100_000 for name in ("1", "2", "both"))
    done = fresh_process.python(tmp_path, bytecode, "-m", "facepipe", "validate", "both.glb")
    assert done.returncode == 0, done.stdout + done.stderr
