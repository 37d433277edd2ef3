"""Deliveries: GLB, ONNX, metadata and report of one face, all of them or none."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from faces import tiny_face

from facepipe.core.atomic import collect
from facepipe.core.errors import InputError
from facepipe.hosting.deliver import deliver, outputs
from facepipe.stage import save_parts

_KILLED = """
import os, signal, sys
from pathlib import Path
from facepipe.hosting.deliver import deliver
def hook(event, arguments):
    if event == "os.rename" and os.fspath(arguments[1]) == os.path.realpath("face.onnx.json"):
        os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(hook)
deliver(Path("face.usda"), Path(), "face", overwrite=True)
"""


@pytest.fixture
def delivered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a delivery of a face that has grown since."""
    monkeypatch.chdir(tmp_path)
    parts = tiny_face()
    save_parts(parts, "face.usda")
    deliver(Path("face.usda"), Path(), "face")
    save_parts(replace(parts, meters_per_unit=2 * parts.meters_per_unit), "face.usda")
    return tmp_path


def _content(folder: Path) -> dict[str, bytes]:
    assert not [one.name for one in folder.iterdir() if one.name.startswith(".")]
    return {output.name: output.read_bytes() for output in outputs(folder, "face") if output.exists()}


def test_a_delivery_is_four_files_that_agree(delivered: Path) -> None:
    report = deliver(Path("face.usda"), Path(), "other")
    files = _content(delivered)
    assert sorted(files) == ["face.glb", "face.onnx", "face.onnx.json", "face.report.json"]
    assert [one.name for one in report.files] == ["other.glb", "other.onnx", "other.onnx.json", "other.report.json"]
    assert all(one.is_file() for one in report.files)
    content = json.loads(Path("other.report.json").read_text())
    assert content["files"] == [one.name for one in report.files]
    assert Path("other.glb").read_bytes() != files["face.glb"]
    with pytest.raises(InputError, match=r"face\.glb: exists"):
        deliver(Path("face.usda"), Path(), "face")


@pytest.mark.parametrize("name", ["face.glb", "face.onnx.json"])
def test_a_delivery_that_fails_leaves_the_old_one(delivered: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Where its first file can't be replaced, or a later one can't be put aside."""
    old = _content(delivered)

    def refuse(real: object) -> object:
        def rename(self: Path, target: Path) -> object:
            if (self if name != "face.glb" else target) == Path.cwd().resolve() / name:
                raise PermissionError(13, "Permission denied")
            return real(self, target)  # type: ignore[operator]

        return rename

    monkeypatch.setattr(Path, "rename", refuse(Path.rename))
    monkeypatch.setattr(Path, "replace", refuse(Path.replace))
    with pytest.raises(InputError, match="can't be written: Permission denied"):
        deliver(Path("face.usda"), Path(), "face", overwrite=True)
    assert _content(delivered) == old


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_a_delivery_killed_between_its_files_is_never_old_beside_new(delivered: Path) -> None:
    old = _content(delivered)
    assert subprocess.run([sys.executable, "-c", _KILLED], check=False).returncode == -signal.SIGKILL
    left = {output.name: output.read_bytes() for output in outputs(delivered, "face") if output.exists()}
    collect(delivered)
    new = _content(delivered)
    assert sorted(left) == ["face.glb", "face.onnx"]
    assert new.items() > left.items()
    assert all(new[name] != old[name] for name in new)
    deliver(Path("face.usda"), Path(), "face", overwrite=True)
    assert _content(delivered) == new
