"""Processes that commands start run none of the code that lies in the working folder."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import exit_code
from faces import painted_face, tiny_face
from PIL import Image
from started import StartedPastTheHelperError, started

from facepipe.cli import view_command
from facepipe.core.errors import InputError
from facepipe.core.policy import children
from facepipe.stage import save_parts

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="its programs are scripts of a shell")

MODULES = ("json", "numpy", "pip", "sitecustomize", "usercustomize", "facepipe", "webbrowser", "pxr")
PROGRAMS = ("node", "node.exe", "python3", "python", "xdg-open", "www-browser", "sh", "uname", "ldconfig", "ssh")


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A working folder full of code, in an environment that looks there: some of it has run where `ran` is."""
    folder, ran = tmp_path / "sent", tmp_path / "ran"
    folder.mkdir()
    for name in MODULES:
        (folder / f"{name}.py").write_text(f"open({str(ran)!r}, 'a').write({name!r})\n")
    for name in PROGRAMS:
        (folder / name).write_text(f"#!/bin/sh\necho {name} >> {ran}\n")
        (folder / name).chmod(0o755)
    (folder / "first.js").write_text(f"require('fs').appendFileSync({str(ran)!r}, 'first.js')\n")
    for package in ("gltf-validator", "meshoptimizer"):
        (folder / "node_modules" / package).mkdir(parents=True)
        shutil.copy(folder / "first.js", folder / "node_modules" / package / "index.js")
    for package in (folder / "ktx2-encoder", folder / "node_modules" / "ktx2-encoder"):
        package.mkdir()
        (package / "package.json").write_text('{"exports": {".": {"node": {"import": "./index.mjs"}}}}')
        code = f"import {{ appendFileSync }} from 'fs'; appendFileSync({str(ran)!r}, 'ktx2');"
        (package / "index.mjs").write_text(f"{code} export const encodeToKTX2 = () => new Uint8Array(1);\n")
    save_parts(tiny_face(), folder / "a.usda")
    monkeypatch.chdir(folder)
    for name in ("PATH", "PYTHONPATH", "PXR_PLUGINPATH_NAME", "NODE_PATH", "LD_LIBRARY_PATH"):
        monkeypatch.setenv(name, os.pathsep.join(["", ".", "../sent", *filter(None, [os.environ.get(name)])]))
    monkeypatch.setenv("NODE_OPTIONS", "--require ./first.js")
    monkeypatch.setenv("PYTHONSTARTUP", "json.py")
    monkeypatch.setenv("PYTHONUSERBASE", ".")
    monkeypatch.setenv("PYTHONPYCACHEPREFIX", "__pycache__")
    started.clear()
    yield folder
    assert not ran.exists(), ran.read_text()


def test_workers_of_a_batch(trap: Path) -> None:
    (trap / "show.toml").write_text(
        '[faces]\nglob = "*.usda"\n[steps.game]\nrun = "export {face}"\nout = "game/{name}.glb"\n'
    )
    assert exit_code("batch", "show.toml", "--processes", "1", "--thumbnails", "0") == 0
    assert (trap / "out/game/a.glb").is_file()
    assert started == [sys.executable]


def test_validator_and_compression_by_node(trap: Path) -> None:
    assert exit_code("export", "a.usda", "-o", "a.glb") == 0
    assert exit_code("validate", "a.glb") in (0, 1)
    assert exit_code("export", "a.usda", "-o", "b.glb", "--meshopt") in (0, 2)
    save_parts(painted_face(Image.new("RGB", (8, 8))), trap / "painted.usda")
    assert exit_code("export", "painted.usda", "-o", "c.glb", "--texture-format", "ktx2") in (0, 2)
    assert len(started) == (0 if children.find_program("node") is None else 3)
    assert all(Path(program).is_absolute() for program in started)


def test_pip_for_the_add_on_of_blender(trap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (trap / "wheels").mkdir()
    assert exit_code("blender-addon", "-o", "addon.zip", "--wheels", "wheels") == 2
    assert "pip can't get them" in capsys.readouterr().err
    assert started == [sys.executable]


def test_the_browser(trap: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mine = trap.parent / "mine"
    mine.mkdir()
    (mine / "chosen").write_text(f'#!/bin/sh\necho "$1" > {trap.parent / "opened"}\n')
    (mine / "chosen").chmod(0o755)
    monkeypatch.setenv("PATH", os.pathsep.join((os.environ["PATH"], str(mine))))
    monkeypatch.setenv("BROWSER", "chosen")
    view_command._open("http://127.0.0.1:1/").wait(60)
    assert (trap.parent / "opened").read_text().strip() == "http://127.0.0.1:1/"


def test_code_of_the_folder_would_run_without_the_helper(trap: Path, tmp_path: Path) -> None:
    """The trap works: what it stands for is found by a process as it is usually started."""
    for words in ([sys.executable, "-m", "pip", "--version"], ["node"]):
        subprocess.run(words, check=False, env={**os.environ, "PYTHONHOME": ""}, capture_output=True)
        assert (tmp_path / "ran").exists(), words
        (tmp_path / "ran").unlink()


def test_a_process_that_is_started_elsewhere_is_noticed(tmp_path: Path) -> None:
    code = compile("import os\nos.system('true')\n", children.__file__.replace("children", "elsewhere"), "exec")
    with pytest.raises(StartedPastTheHelperError):
        exec(code)


def test_variables_of_children(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    kept = {"AWS_SECRET_ACCESS_KEY": "k", "HTTPS_PROXY": "p", "CUDA_VISIBLE_DEVICES": "0", "FACEPIPE_ROOTS": "r"}
    for name, value in {**kept, "PYTHONHOME": "/x", "PYTHONSTARTUP": "/y", "NODE_OPTIONS": "-r z"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", str(tmp_path), "lib", "."]))
    monkeypatch.setenv("NODE_PATH", "node_modules")
    found = children.environment({"OMP_NUM_THREADS": "1"})
    assert found.items() >= {**kept, "OMP_NUM_THREADS": "1", "PYTHONSAFEPATH": "1", "PYTHONPATH": str(tmp_path)}.items()
    assert not {"PYTHONHOME", "PYTHONSTARTUP", "NODE_OPTIONS", "NODE_PATH"} & found.keys()


def test_programs_are_absolute(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "python3")
    with pytest.raises(InputError, match="expected an absolute path"):
        children.python("pip")
    with pytest.raises(InputError, match="is no absolute path"):
        children.start(["node"])
    with pytest.raises(InputError, match="is no absolute path"):
        children.run(["./node"], seconds=1)
