"""EXT_meshopt_compression: without loss, checked before it is written, and read by three.js."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import failed
from facepipe_gltf import Options, document, export
from facepipe_gltf import node_packages as programs
from facepipe_gltf import validate as check
from faces import tiny_face
from gltf_export import Parts, random_weights
from import_data import shared
from node import HERE, node_packages, run_node, three_load, validate

from facepipe.core.errors import ExportError
from facepipe.core.reports import ExportReport
from facepipe.importers import load
from facepipe.parts import FaceParts
from facepipe.stage import save_parts


@pytest.fixture(autouse=True)
def packages(monkeypatch: pytest.MonkeyPatch) -> None:
    node_packages()
    monkeypatch.setenv("NODE_PATH", str(HERE / "node_modules"))


def pair(parts: FaceParts, folder: Path, **options: Any) -> tuple[ExportReport, ExportReport]:
    """Exports without compression and with it."""
    plain = export(Parts(parts), folder / "plain.glb", Options(dense=True, **options))
    return plain, export(Parts(parts), folder / "small.glb", Options(meshopt=True, **options))


def same_in_three(parts: FaceParts, plain: Path, small: Path) -> None:
    names = random_weights(parts, np.random.default_rng(4))
    ours, theirs = (three_load(path, names, {})["meshes"] for path in (plain, small))
    assert ours == theirs
    assert any(their["targets"] for their in theirs)


@pytest.mark.parametrize("quantize", [False, True])
def test_three_reads_what_it_reads_of_the_plain_file(quantize: bool, tmp_path: Path) -> None:
    plain, small = pair(tiny_face(), tmp_path, quantize=quantize)
    same_in_three(tiny_face(), plain.path, small.path)
    assert small.error_mm == plain.error_mm


@pytest.mark.slow
def test_babylon_reads_what_it_reads_of_the_plain_file(tmp_path: Path) -> None:
    weights = [{"Head": {"jawOpen": one, "mouthSmileLeft": 1.0}, "Teeth": {"jawOpen": one}} for one in (0.0, 0.7)]
    poses = [{"weights": weight, "joints": {}} for weight in weights]
    reports = pair(tiny_face(), tmp_path, quantize=True)
    outs = [report.path.with_suffix(".bin") for report in reports]
    asked = [{"path": str(one.path), "out": str(out), "poses": poses} for one, out in zip(reports, outs, strict=True)]
    run_node("babylon_poses.mjs", [], json.dumps(asked))
    plain, small = (np.fromfile(out, "<f4").reshape(2, -1) for out in outs)
    assert np.array_equal(plain, small)
    assert np.abs(plain[1] - plain[0]).max() > 1e-3


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_files_are_valid_and_the_same_each_time(suffix: str, tmp_path: Path) -> None:
    options = Options(meshopt=True, quantize=True, engine="babylon")
    paths = [tmp_path / f"{name}{suffix}" for name in ("a", "b")]
    for path in paths:
        export(Parts(tiny_face()), path, options)
    issues = validate(paths[:1])[paths[0]]["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0)
    assert check(paths[0], khronos=False) == ()
    if suffix == ".glb":
        assert paths[0].read_bytes() == paths[1].read_bytes()


def test_a_face_without_meshes_has_nothing_to_compress(tmp_path: Path) -> None:
    plain, small = pair(FaceParts(), tmp_path)
    assert small.path.read_bytes() == plain.path.read_bytes()


@pytest.mark.parametrize("engine", ["blender", "godot", "unreal", "generic"])
def test_engines_that_cannot_read_it(engine: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "EXT_meshopt_compression" in export_refused(["--meshopt", "--engine", engine], tmp_path, capsys)


def test_what_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(document, "_PROGRAM", document._PROGRAM.replace("meshoptimizer/", "no-such-package/"))
    assert "npm install --global meshoptimizer" in export_refused(["--meshopt"], tmp_path, capsys)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "needs node" in export_refused(["--meshopt"], tmp_path, capsys)


def export_refused(words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """What is said of an export that must write nothing."""
    stage = folder / "face.usda"
    save_parts(tiny_face(), stage)
    return failed(capsys, "export", stage, "-o", folder / "face.glb", *words, folder=folder)


def test_it_is_read_back_as_the_plain_file_is(tmp_path: Path) -> None:
    plain, small = pair(tiny_face(), tmp_path, quantize=True, animations=True)
    ours, theirs = (load("gltf", one.path).parts for one in (plain, small))
    for mesh, other in zip(ours.meshes, theirs.meshes, strict=True):
        assert np.array_equal(mesh.points, other.points)
        assert np.array_equal(mesh.face_vertex_indices, other.face_vertex_indices)
        for shape, its in zip(mesh.blendshapes, other.blendshapes, strict=True):
            assert np.array_equal(shape.offsets, its.offsets)


def test_a_coder_that_loses_something_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    honest = programs.answer_of

    def lossy(*asked: Any) -> bytes:
        return honest(*asked)[:-1] + b"\x7f"

    monkeypatch.setattr(programs, "answer_of", lossy)
    with pytest.raises(ExportError, match="when decoded again"):
        export(Parts(tiny_face()), tmp_path / "face.glb", Options(meshopt=True))
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_real_head(tmp_path: Path) -> None:
    parts = load("ict", shared("ict_facekit/ict_facekit.npz")).parts
    plain, small = pair(parts, tmp_path, quantize=True)
    same_in_three(parts, plain.path, small.path)
    assert small.bytes < 1.7e6
