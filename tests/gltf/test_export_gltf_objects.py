"""The document as pygltflib's objects: the same bytes unless a caller changes it, and what a caller changes arrives."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import small_head as sample
from facepipe_gltf import Options, export
from facepipe_gltf import read as gltf
from facepipe_gltf.raw import RawDocument
from faces import tiny_face
from gltf_export import Parts, written
from import_data import shared

from facepipe.core.errors import ExportError
from facepipe.importers import ict
from facepipe.parts import FaceParts

__all__ = ["written"]

Gltf = pygltflib.GLTF2


def saved(parts: FaceParts, path: Path, on_document: Callable[[Gltf], object] | None = None, **options: Any) -> Path:
    path.parent.mkdir(exist_ok=True)
    export(Parts(parts), path, Options(**options), on_document=on_document)
    return path


@pytest.mark.parametrize("options", [{"animations": True}, {"quantize": True}, {"mode": "morph", "dense": True}])
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_a_document_that_is_left_alone_has_the_same_bytes(suffix: str, options: dict[str, Any], tmp_path: Path) -> None:
    parts = sample.make()
    plain = saved(parts, tmp_path / "a" / f"face{suffix}", **options)
    given = saved(parts, tmp_path / "b" / f"face{suffix}", lambda document: None, **options)
    assert plain.read_bytes() == given.read_bytes()
    assert [one.name for one in sorted(plain.parent.iterdir())] == [one.name for one in sorted(given.parent.iterdir())]


def test_the_objects_are_those_that_pygltflib_reads(tmp_path: Path) -> None:
    """But for the defaults that it fills in where the file states nothing."""
    found: list[Gltf] = []
    path = saved(sample.make(), tmp_path / "face.glb", found.append, animations=True)

    def check(own: Any, theirs: Any) -> int:
        if own is None:
            return 0
        assert type(own) is type(theirs)
        if isinstance(own, list):
            assert len(own) == len(theirs)
            return sum(map(check, own, theirs))
        if type(own).__module__ != "pygltflib":
            assert own == theirs
            return 1
        return sum(check(value, getattr(theirs, name)) for name, value in vars(own).items())

    assert check(found[0], Gltf().load(path)) > 1000


def marked(document: Gltf) -> None:
    """Changes of each kind, as a plug-in makes them."""
    document.asset.extras["studio"] = {"shot": 12, "takes": []}
    document.extensionsUsed.append("KHR_materials_unlit")
    document.materials[0].extensions = {
        "KHR_materials_unlit": {}
    }  # in the place of others, with which it makes no sense
    document.nodes[0].name = "RENAMED"
    lens = pygltflib.Perspective(yfov=0.5, znear=0.01)
    document.cameras.append(pygltflib.Camera(type="perspective", perspective=lens))
    document.nodes.append(pygltflib.Node(name="camera", camera=0, translation=[0.0, 0.25, 1.0]))
    document.scenes[0].nodes.append(len(document.nodes) - 1)
    if document.buffers[0].uri is not None:  # the validator warns of data: URIs in a .glb
        data = "AADAPwAAAMAAAIA+"  # of the floats 1.5, -2, 0.25
        document.buffers.append(pygltflib.Buffer(uri=pygltflib.DATA_URI_HEADER + data, byteLength=12))
        document.bufferViews.append(pygltflib.BufferView(buffer=1, byteLength=12))
        view = len(document.bufferViews) - 1
        document.accessors.append(pygltflib.Accessor(bufferView=view, componentType=5126, count=3, type="SCALAR"))


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_changes_arrive_and_the_buffer_stays_whole(suffix: str, tmp_path: Path, written: list[Path]) -> None:
    parts = sample.make()
    plain = RawDocument(saved(parts, tmp_path / "a" / f"face{suffix}"))
    path = saved(parts, tmp_path / "b" / f"face{suffix}", marked)
    written.append(path)  # judged by the Khronos validator
    found = RawDocument(path)
    assert found.binary == plain.binary
    assert found.json["asset"]["extras"] == {"studio": {"shot": 12, "takes": []}}
    first, *others = plain.json["materials"]
    assert found.json["materials"] == [first | {"extensions": {"KHR_materials_unlit": {}}}, *others]
    assert [one["name"] for one in found.json["nodes"]] == [
        "RENAMED", *(one["name"] for one in plain.json["nodes"][1:]), "camera"
    ]  # fmt: skip
    count = len(plain.json["accessors"])
    for index in range(count):
        assert (found.accessor(index) == plain.accessor(index)).all()
    if suffix == ".gltf":
        assert found.accessor(count).ravel().tolist() == [1.5, -2.0, 0.25]


def test_a_renamed_mesh_is_what_an_import_reads(tmp_path: Path) -> None:
    """Not the name in facepipe's own record, which goes along in the file."""

    def rename(document: Gltf) -> None:
        for one in (document.nodes[0], document.meshes[0]):
            one.name = "Renamed"

    path = saved(tiny_face(), tmp_path / "face.glb", rename)
    assert [mesh.name for mesh in gltf.read(path, gltf.Options()).parts.meshes] == ["Renamed", "Teeth"]


def test_a_document_is_changed_once_for_each_file(tmp_path: Path) -> None:
    """What one call changes is not in the next one's document."""
    from facepipe_gltf import save, write

    document = write(tiny_face(), Options())
    before = json.dumps(document.json)
    for name in ("a.glb", "b.glb"):
        save(document, tmp_path / name, on_document=lambda one: one.extras.update(a=len(one.extras)))
    assert json.dumps(document.json) == before
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


def set_first(kind: str, **values: Any) -> Callable[[Gltf], None]:
    """Sets fields of the first object of a kind."""
    return lambda document: [setattr(getattr(document, kind)[0], key, one) for key, one in values.items()] and None


@pytest.mark.parametrize(("change", "message"), [
    (set_first("nodes", translation=[np.nan, 0, 0]), "Out of range float"),
    (set_first("nodes", translation=np.zeros(3)), "ndarray"),
    (set_first("nodes", scale=[np.float32(1)] * 3), "float32"),
    (set_first("nodes", name="\ud800"), "surrogates"),
    (set_first("nodes", mesh=7), "/nodes/0/mesh: 7, expected 0 to 1"),
    (set_first("nodes", children=[0]), "its own ancestor"),
    (set_first("accessors", count=10**9), "/accessors/0"),
    (set_first("accessors", min=[0.0, 0.0, 0.0]), "/accessors/0/min"),
    (set_first("skins", joints=[]), "joint 2"),
    (set_first("meshes", weights=[0.0]), "1 weights, expected"),
    (set_first("buffers", byteLength=4), "first buffer"),
    (lambda document: document.set_binary_blob(b"mine"), "first buffer"),
    (lambda document: document.buffers.clear(), "first buffer"),
    (lambda document: setattr(document, "buffers", {"a": 1}), "first buffer"),
    (lambda document: setattr(document, "asset", None), "expected 2.0"),
    (lambda document: setattr(document, "meshes", None), "no mesh"),
    (lambda document: document.extras.update(own=document.extras), "Circular"),
    (lambda document: document.extensionsRequired.append("ACME_hair"), "ACME_hair, expected none but"),
])  # fmt: skip
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_a_broken_document_is_one_line_and_nothing_is_written(
    suffix: str, change: Callable[[Gltf], object], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ExportError, match=message) as raised:
        saved(tiny_face(), tmp_path / f"face{suffix}", change)
    assert str(raised.value).startswith(f"face{suffix} -> on_document")
    assert "\n" not in str(raised.value)
    assert not list(tmp_path.iterdir())


def test_errors_of_the_caller_are_its_own(tmp_path: Path) -> None:
    def fail(document: Gltf) -> None:
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        saved(tiny_face(), tmp_path / "face.glb", fail)
    assert not list(tmp_path.iterdir())


def test_a_real_head_with_a_change_is_the_same_face(tmp_path: Path, written: list[Path]) -> None:
    parts = ict.read(shared("ict_facekit/ict_facekit.npz"), ict.Options()).parts
    plain = saved(parts, tmp_path / "plain.glb")
    path = saved(parts, tmp_path / "changed.glb", lambda document: document.extras.update(shot=12))
    written.append(path)
    before, after = RawDocument(plain), RawDocument(path)
    assert after.binary == before.binary
    assert after.json == before.json | {"extras": before.json["extras"] | {"shot": 12}}
