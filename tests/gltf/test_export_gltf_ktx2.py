"""Pictures as KTX2: the Basis transcoder that comes with three.js is the judge."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import gltf_reader
import numpy as np
import pytest
from baked_face import small_person
from command_line import failed
from facepipe_gltf import Options, export, ktx2
from facepipe_gltf import validate as check
from faces import painted_face, tiny_face
from gltf_export import Parts
from node import HERE, node_packages, run_node
from PIL import Image

from facepipe.core.errors import InputError
from facepipe.core.reports import ExportReport
from facepipe.parts import FaceParts
from facepipe.stage import save_parts


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    node_packages()
    monkeypatch.setenv("NODE_PATH", str(HERE / "node_modules"))


def exported(parts: FaceParts, path: Path, **options: Any) -> tuple[gltf_reader.Gltf, ExportReport]:
    report = export(Parts(parts), path, Options(**options))
    return gltf_reader.read(report.path), report


def decoded(file: gltf_reader.Gltf) -> list[tuple[dict[str, Any], np.ndarray]]:
    """What each image says of itself, and its (h, w, 4) pixels."""
    images = [base64.b64encode(file.image(i)).decode() for i in range(len(file.list("images")))]
    answers = run_node("ktx2_pixels.mjs", [], json.dumps(images))
    return [
        (one, np.frombuffer(base64.b64decode(one["pixels"]), np.uint8).reshape(one["height"], one["width"], 4))
        for one in answers
    ]


def plain(file: gltf_reader.Gltf, number: int) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(file.image(number))).convert("RGBA"))


def test_a_person_looks_as_before(tmp_path: Path) -> None:
    """Colours and data within a few of 255, normals within a few degrees, alpha as it was; sRGB where it is."""
    before, _ = exported(small_person(5), tmp_path / "png.glb", texture_format="kept")
    after, report = exported(small_person(5), tmp_path / "ktx2.glb", texture_format="ktx2")
    names = [image["name"] for image in before.list("images")]
    assert [image["name"] for image in after.list("images")] == names
    assert {image["mimeType"] for image in after.list("images")} == {"image/ktx2"}
    for texture in after.list("textures"):
        assert "source" not in texture
        assert list(texture["extensions"]) == ["KHR_texture_basisu"]
    assert "KHR_texture_basisu" in after.json["extensionsRequired"]
    assert check(report.path, khronos=False) == ()
    assert f"{len(names)} pictures as KTX2" in report.chosen[-1]
    for number, (name, (facts, pixels)) in enumerate(zip(names, decoded(after), strict=True)):
        given = plain(before, number)
        assert pixels.shape == given.shape, name
        assert facts["levels"] == np.log2(max(given.shape)) + 1, name
        assert facts["uastc"] == name.endswith("normal"), name
        data = any(part in name for part in ("normal", "orm", "mask", "coat", "occlusion"))
        assert facts["srgb"] != data, name
        if facts["uastc"]:
            one, other = (pixels[..., :3] / 127.5 - 1.0, given[..., :3] / 127.5 - 1.0)
            cosines = (one * other).sum(axis=2) / np.linalg.norm(one, axis=2) / np.linalg.norm(other, axis=2)
            assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean() < 1.0, name
        else:
            seen = given[..., 3] > 0  # colours of clear texels show in no picture
            assert np.abs(pixels[seen].astype(int) - given[seen])[:, :3].mean() < 4.0, name
            assert np.abs(pixels[..., 3].astype(int) - given[..., 3]).mean() < 4.0, name


@pytest.mark.parametrize(
    ("image", "kind", "shape", "colour"),
    [
        (Image.new("RGB", (1, 1), (200, 30, 30)), "PNG", (4, 4), (200, 30, 30)),
        (Image.new("RGB", (30, 6), (200, 30, 30)), "PNG", (8, 32), (200, 30, 30)),
        (Image.new("CMYK", (8, 8), (0, 200, 200, 50)), "JPEG", (8, 8), (205, 44, 44)),
        (Image.fromarray(np.full((8, 8), 40000, np.uint16)), "PNG", (8, 8), (156, 156, 156)),
    ],
    ids=["one pixel", "odd sides", "CMYK", "16 bits"],
)
def test_pictures_of_any_kind(
    image: Image.Image, kind: str, shape: tuple[int, int], colour: tuple[int, int, int], tmp_path: Path
) -> None:
    file, _ = exported(painted_face(image, kind), tmp_path / "face.gltf", texture_format="ktx2")
    ((_, pixels),) = decoded(file)
    assert pixels.shape[:2] == shape
    assert np.abs(pixels[..., :3].astype(int) - colour).max() <= 8


def test_a_picture_that_is_too_large_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ktx2, "_MOST", 63)
    with pytest.raises(
        InputError, match=r"skin: 8 x 8 pixels, expected 63 at most \(--texture-size makes it smaller\)"
    ):
        exported(painted_face(Image.new("RGB", (8, 8))), tmp_path / "face.glb", texture_format="ktx2")
    assert not list(tmp_path.iterdir())


def test_a_face_without_pictures(tmp_path: Path) -> None:
    file, report = exported(tiny_face(), tmp_path / "face.glb", texture_format="ktx2")
    assert "extensionsRequired" not in file.json
    assert report.chosen == ()


@pytest.mark.parametrize("engine", ["blender", "godot", "unreal", "generic"])
def test_engines_that_cannot_read_it(engine: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "reads no KHR_texture_basisu" in refused(tmp_path, capsys, "--engine", engine)


def test_what_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("NODE_PATH", str(tmp_path))
    monkeypatch.setattr(ktx2, "_PROGRAM", ktx2._PROGRAM.replace('"ktx2-encoder"', '"no-such-package"'))
    assert "npm install --global ktx2-encoder" in refused(tmp_path, capsys)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "needs node" in refused(tmp_path, capsys)


def refused(folder: Path, capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """What is said of an export that must write nothing."""
    stage = folder / "face.usda"
    if not stage.exists():
        save_parts(painted_face(Image.new("RGB", (8, 8))), stage)
    out = folder / "face.glb"
    return failed(capsys, "export", stage, "-o", out, "--texture-format", "ktx2", *words, folder=folder)
