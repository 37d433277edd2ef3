"""The add-on's zip without Blender: what is in it, and what it says where there is nothing to make it of."""

from __future__ import annotations

import base64
import hashlib
import zipfile
from pathlib import Path

import pytest
from facepipe_blender import addon
from facepipe_blender.addon import Options, build, write_own_wheel

from facepipe.core.errors import InputError


def test_own_wheel_is_the_same_every_time_and_its_record_holds(tmp_path: Path) -> None:
    (tmp_path / "again").mkdir()
    wheel = write_own_wheel(tmp_path)
    assert wheel.read_bytes() == write_own_wheel(tmp_path / "again").read_bytes()
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        record = next(name for name in names if name.endswith("RECORD"))
        rows = [line.rsplit(",", 2) for line in archive.read(record).decode().splitlines()]
        assert {row[0] for row in rows} == {*names}
        for name, digest, size in rows:
            if name != record:
                data = archive.read(name)
                assert int(size) == len(data)
                encoded = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).decode().rstrip("=")
                assert digest == f"sha256={encoded}"
        entries = archive.read(record.replace("RECORD", "entry_points.txt")).decode().splitlines()
    assert {"onnx = facepipe_onnx", "vrm = facepipe_gltf.vrm", "gltf = facepipe_gltf.read"} <= {*entries}
    assert "facepipe_schemas/generatedSchema.usda" in names
    assert not [name for name in names if name.startswith("facepipe_blender/")]


def test_libraries_of_extras_and_of_blender_are_not_packed(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = ["numpy>=1.26", "trimesh>=4.0", 'torch; extra == "train"', 'numpy; extra == "dev"']
    monkeypatch.setattr(addon, "requires", lambda name: listed)
    assert addon._libraries() == ["trimesh>=4.0"]


def test_without_libraries_one_line_and_no_file(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        build(tmp_path / "facepipe.zip", Options(wheels=tmp_path))
    assert len(str(caught.value).splitlines()) == 1
    assert "pip can't get them" in str(caught.value)
    assert not list(tmp_path.iterdir())
