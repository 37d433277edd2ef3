"""The committed samples are good faces on the generator's topology."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from places import REPOSITORY

import facepipe
from facepipe.checks import validate
from facepipe.cli import main

FOLDER = REPOSITORY / "samples"
FILES = sorted(FOLDER.glob("*.usdz"))


def test_there_are_samples_of_different_people() -> None:
    points = [facepipe.open(file).evaluate() for file in FILES]
    assert len(points) >= 2
    assert np.abs(points[0] - points[1]).max() > 0.1


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_sample_validates(file: Path) -> None:
    assert [finding for finding in validate(file) if finding.severity != "info"] == []


def test_samples_are_what_the_generator_makes() -> None:
    spec = importlib.util.spec_from_file_location("generate_samples", FOLDER / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    generate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generate)
    for seed in generate.SEEDS:
        committed = facepipe.open(FOLDER / f"head{seed}.usdz")
        made = generate.small(generate.make(seed))
        assert [mesh.name for mesh in committed.meshes] == [mesh.name for mesh in made.meshes]
        for one, other in zip(committed.meshes, made.meshes, strict=True):
            np.testing.assert_array_equal(one.face_vertex_indices, other.face_vertex_indices)
            np.testing.assert_allclose(one.points, other.points, atol=1e-4)
        assert set(committed.shapes) == set(generate.SHAPES)


def _publish(*words: object) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, str(FOLDER / "pre_publish.py"), *map(str, words)]
    return subprocess.run(line, capture_output=True, text=True, check=False)


def test_a_face_is_published_up_to_date_or_not_at_all(tmp_path: Path) -> None:
    """The example of an asset build: it cooks what is stale, and hands on nothing that a check finds an error in."""
    heads = [tmp_path / name for name in ("head0.usdz", "head5.usdz")]
    for head in heads:
        shutil.copy(FOLDER / head.name, head)
    child, out = tmp_path / "child.usda", tmp_path / "published"
    out.mkdir()
    assert main(["blend", *map(str, heads), "-o", str(child)]) == 0
    first = child.read_bytes()
    shutil.copy(FOLDER / "head0.usdz", heads[1])
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
    head = shutil.copy(FOLDER / "head0.usdz", tmp_path)
    for words in ((head, tmp_path / "nowhere"), (tmp_path / "none.usda", tmp_path)):
        done = _publish(*words)
        assert (done.returncode, done.stderr.count("\n"), done.stdout) == (2, 1, ""), done.stderr
    assert _publish(head).returncode == 2
    assert [path.name for path in tmp_path.iterdir()] == ["head0.usdz"]
