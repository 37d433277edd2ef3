"""The example of an asset build in samples/."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from command_line import exit_code
from places import REPOSITORY
from small_head import make

from facepipe.checks import validate
from facepipe.stage import save_parts

FOLDER = REPOSITORY / "samples"


def _publish(*words: object) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, str(FOLDER / "pre_publish.py"), *map(str, words)]
    return subprocess.run(line, capture_output=True, text=True, check=False)


def test_a_face_is_published_up_to_date_or_not_at_all(tmp_path: Path) -> None:
    """The example of an asset build: it cooks what is stale, and hands on nothing that a check finds an error in."""
    heads = [tmp_path / f"head{seed}.usdz" for seed in (0, 5)]
    for seed, head in zip((0, 5), heads, strict=True):
        save_parts(make(seed), head)
    child, out = tmp_path / "child.usda", tmp_path / "published"
    out.mkdir()
    assert exit_code("blend", *heads, "-o", child) == 0
    first = child.read_bytes()
    shutil.copy(heads[0], heads[1])
    done = _publish(child, out)
    assert done.returncode == 0, done.stderr
    assert "child.usda: cooked; head5.usdz changed" in done.stdout
    assert child.read_bytes() != first
    published = {path.name: path.read_bytes() for path in out.iterdir()}
    assert sorted(published) == ["child.glb", "child.onnx", "child.onnx.json"]
    found = [one for name in ("child.glb", "child.onnx") for one in validate(out / name)]
    assert [one for one in found if one.severity == "error"] == []
    child.write_text(child.read_text().replace('upAxis = "Y"', 'upAxis = "X"'))
    assert _publish(child, out).returncode == 1
    heads[0].unlink()
    assert _publish(child, out).returncode == 2
    assert {path.name: path.read_bytes() for path in out.iterdir()} == published


def test_a_publish_that_cannot_begin_is_told_in_one_line(tmp_path: Path) -> None:
    head = tmp_path / "head0.usdz"
    save_parts(make(0), head)
    for words in ((head, tmp_path / "nowhere"), (tmp_path / "none.usda", tmp_path)):
        done = _publish(*words)
        assert (done.returncode, done.stderr.count("\n"), done.stdout) == (2, 1, ""), done.stderr
    assert _publish(head).returncode == 2
    assert [path.name for path in tmp_path.iterdir()] == ["head0.usdz"]
