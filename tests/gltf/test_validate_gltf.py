"""Every defect that a glTF file can have is found under its name; exported faces are clean."""

from __future__ import annotations

import contextlib
import copy
import json
import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import facepipe_gltf
import numpy as np
import pytest
from facepipe_gltf.raw import local_matrix
from facepipe_gltf.read import Options, read
from faces import replace_mesh, tiny_face
from gltf_builder import glb
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from node import node_packages
from places import SUPPORT

from facepipe.checks import validate
from facepipe.core.errors import FacepipeError, InputError
from facepipe.parts import FaceParts
from facepipe.stage import Face

Json = dict[str, Any]
Seed = Callable[[Json, bytearray], None]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("good") / "face.glb"
    exported(tiny_face(), path)
    return path


def exported(parts: FaceParts, path: Path) -> bytes:
    facepipe_gltf.export(Face.from_parts(parts), path)
    return path.read_bytes()


def unpack(data: bytes) -> tuple[Json, bytearray]:
    (size,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + size]), bytearray(data[28 + size :])


def floats_at(document: Json, binary: bytearray, accessor: int) -> np.ndarray:
    """A view of a float accessor's numbers, to be changed in place."""
    entry = document["accessors"][accessor]
    view = document["bufferViews"][entry["bufferView"]]
    assert entry["componentType"] == 5126
    start = view.get("byteOffset", 0) + entry.get("byteOffset", 0)
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[entry["type"]]
    return np.frombuffer(binary, np.float32, entry["count"] * width, start)


def head(document: Json) -> Json:
    primitive: Json = document["meshes"][0]["primitives"][0]
    return primitive


def permuted_joints(document: Json, binary: bytearray) -> None:
    joints = document["skins"][0]["joints"]
    joints[1], joints[2] = joints[2], joints[1]


def rotated_joints(document: Json, binary: bytearray) -> None:
    joints = document["skins"][0]["joints"]
    joints[:] = joints[1:] + joints[:1]


def foreign(seed: Seed) -> Seed:
    """The defect in a file of another writer, whose joints may be in any order of nodes."""

    def both(document: Json, binary: bytearray) -> None:
        document["asset"]["generator"] = "another"
        seed(document, binary)

    return both


def set_at(path: str, value: object) -> Seed:
    """A seed that sets a JSON pointer."""

    def seed(document: Json, binary: bytearray) -> None:
        *keys, last = path.strip("/").split("/")
        place: Any = document
        for key in keys:
            place = place[int(key)] if isinstance(place, list) else place[key]
        place[int(last) if isinstance(place, list) else last] = value

    return seed


def fewer_target_names(document: Json, binary: bytearray) -> None:
    document["meshes"][0]["extras"]["targetNames"].pop()


def fewer_targets(document: Json, binary: bytearray) -> None:
    head(document)["targets"].pop()


def twice_named(document: Json, binary: bytearray) -> None:
    names = document["meshes"][0]["extras"]["targetNames"]
    names[1] = names[0]


def heavy_weights(document: Json, binary: bytearray) -> None:
    floats_at(document, binary, head(document)["attributes"]["WEIGHTS_0"])[:4] *= 2


def nan_position(document: Json, binary: bytearray) -> None:
    floats_at(document, binary, head(document)["attributes"]["POSITION"])[4] = np.nan


def moved_position(document: Json, binary: bytearray) -> None:
    floats_at(document, binary, head(document)["attributes"]["POSITION"])[4] += 100


def singular_inverse_bind(document: Json, binary: bytearray) -> None:
    floats_at(document, binary, document["skins"][0]["inverseBindMatrices"])[16:31] = 0


def joint_out_of_range(document: Json, binary: bytearray) -> None:
    document["skins"][0]["joints"].pop()


def beyond_the_buffer(document: Json, binary: bytearray) -> None:
    views = [one for i, one in enumerate(document["bufferViews"]) if any(i in _views(a) for a in document["accessors"])]
    end = max(view["byteOffset"] + view["byteLength"] for view in views) - 64
    del binary[end:]
    document["buffers"][0]["byteLength"] = end


def _views(accessor: Json) -> set[int]:
    sparse = accessor.get("sparse", {})
    return {one["bufferView"] for one in (accessor, *sparse.values()) if isinstance(one, dict) and "bufferView" in one}


def short_attribute(document: Json, binary: bytearray) -> None:
    document["accessors"][head(document)["attributes"]["WEIGHTS_0"]]["count"] -= 1


def cycle(document: Json, binary: bytearray) -> None:
    joints = document["skins"][0]["joints"]
    document["nodes"][joints[2]]["children"] = [joints[0]]


def shared_child(document: Json, binary: bytearray) -> None:
    document["nodes"][0]["children"] = [document["skins"][0]["joints"][2]]


def indices_beyond(document: Json, binary: bytearray) -> None:
    entry = document["accessors"][head(document)["indices"]]
    view = document["bufferViews"][entry["bufferView"]]
    binary[view.get("byteOffset", 0) : view.get("byteOffset", 0) + 2] = b"\xf0\xf0"


DEFECTS: dict[str, tuple[Seed, set[str]]] = {
    "another version": (set_at("asset/version", "3.0"), {"GltfAsset"}),
    "an extension that must be known": (set_at("extensionsRequired", ["EXT_mesh_gpu_instancing"]), {"GltfAsset"}),
    "scene that is not there": (set_at("scene", 7), {"GltfAsset"}),
    "targetNames too short": (fewer_target_names, {"GltfTargetNames"}),
    "targets too few": (fewer_targets, {"GltfTargetNames"}),
    "target name twice": (twice_named, {"GltfDistinctTargetNames"}),
    "no targetNames": (set_at("meshes/0/extras", {}), {"GltfTargetNames"}),
    "weights too many": (set_at("meshes/0/weights", [0] * 9), {"GltfTargetNames"}),
    "two joints swapped": (permuted_joints, {"GltfJointOrder"}),
    "joints rotated": (rotated_joints, {"GltfJointOrder"}),
    "two joints swapped in a foreign file": (foreign(permuted_joints), {"GltfJointOrder"}),
    "joints rotated in a foreign file": (foreign(rotated_joints), {"GltfJointOrder"}),
    "joint out of range": (joint_out_of_range, {"GltfJointIndices"}),
    "weights that don't sum to 1": (heavy_weights, {"GltfWeightsSum"}),
    "singular inverse bind matrix": (singular_inverse_bind, {"GltfInverseBinds"}),
    "NaN in positions": (nan_position, {"GltfFinite"}),
    "max that isn't": (moved_position, {"GltfMinMax"}),
    "accessor beyond the buffer": (beyond_the_buffer, {"GltfAccessors"}),
    "accessor that is not there": (
        lambda document, _: head(document)["attributes"].update(TEXCOORD_0=999),
        {"GltfVertexCounts"},
    ),
    "attribute too short": (short_attribute, {"GltfVertexCounts"}),
    "index out of range": (indices_beyond, {"GltfVertexCounts"}),
    "node cycle": (cycle, {"GltfNodeTree"}),
    "node with two parents": (shared_child, {"GltfNodeTree"}),
    "mesh that is not there": (set_at("nodes/0/mesh", 9), {"GltfReferences"}),
    "skinned mesh with a transform": (set_at("nodes/0/translation", [0, 1, 0]), {"GltfSkinnedNode"}),
}


@pytest.mark.parametrize("name", list(DEFECTS))
def test_a_defect_is_found_under_its_name_and_no_other(name: str, good: Path, tmp_path: Path) -> None:
    seed, expected = DEFECTS[name]
    document, binary = unpack(good.read_bytes())
    seed(document, binary)
    (tmp_path / "face.glb").write_bytes(glb(document, bytes(binary)))
    found = facepipe_gltf.validate(tmp_path / "face.glb", khronos=False)
    assert {one.check.removeprefix("facepipe:") for one in found} == expected
    for one in found:
        assert one.where.startswith("face.glb -> /")
        assert "\n" not in one.message


def posed_rest() -> FaceParts:
    """A face whose rest pose is not its bind pose."""
    parts = tiny_face()
    rest = parts.skeleton.rest_transforms.copy()
    rest[1, :3, 3] += (0.3, -0.2, 0.1)
    rest[2, :3, :3] = rest[2, :3, :3] @ [[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]
    return replace(parts, skeleton=replace(parts.skeleton, rest_transforms=rest))


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize("make", [tiny_face, posed_rest])
def test_exported_faces_are_clean(suffix: str, make: Callable[[], FaceParts], tmp_path: Path) -> None:
    exported(make(), tmp_path / f"face{suffix}")
    assert facepipe_gltf.validate(tmp_path / f"face{suffix}", khronos=False) == ()


def test_a_rest_pose_is_no_permutation_in_foreign_files(tmp_path: Path) -> None:
    document, binary = unpack(exported(posed_rest(), tmp_path / "face.glb"))
    document["asset"]["generator"] = "another"
    (tmp_path / "face.glb").write_bytes(glb(document, bytes(binary)))
    assert facepipe_gltf.validate(tmp_path / "face.glb", khronos=False) == ()


def test_quantised_faces_are_clean(tmp_path: Path) -> None:
    options = facepipe_gltf.Options(quantize=True)
    facepipe_gltf.export(Face.from_parts(tiny_face()), tmp_path / "face.glb", options)
    assert facepipe_gltf.validate(tmp_path / "face.glb", khronos=False) == ()


def test_the_command_reaches_the_checks_by_suffix(good: Path, tmp_path: Path) -> None:
    document, binary = unpack(good.read_bytes())
    fewer_target_names(document, binary)
    (tmp_path / "face.glb").write_bytes(glb(document, bytes(binary)))
    assert "facepipe:GltfTargetNames" in {one.check for one in validate(tmp_path / "face.glb")}


def test_the_khronos_validator_is_run_where_it_is_installed(
    good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node_packages()
    monkeypatch.setenv("NODE_PATH", str(SUPPORT / "js" / "node_modules"))
    (tmp_path / "face.glb").write_bytes(good.read_bytes())
    clean = [one for one in facepipe_gltf.validate(tmp_path / "face.glb") if one.severity != "info"]
    assert clean == []
    document, binary = unpack(good.read_bytes())
    document["asset"]["version"] = "9.9"
    (tmp_path / "face.glb").write_bytes(glb(document, bytes(binary)))
    found = facepipe_gltf.validate(tmp_path / "face.glb")
    assert ("khronos:UNKNOWN_ASSET_MAJOR_VERSION", "error") in {(one.check, one.severity) for one in found}


def test_a_missing_khronos_validator_is_a_note(good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / "face.glb").write_bytes(good.read_bytes())
    (note,) = facepipe_gltf.validate(tmp_path / "face.glb")
    assert (note.check, note.severity) == ("khronos:NotInstalled", "info")


def test_no_file_outside_the_folder_is_read(tmp_path: Path) -> None:
    (tmp_path / "secret.bin").write_bytes(bytes(64))
    folder = tmp_path / "face"
    folder.mkdir()
    view = {"buffer": 0, "byteLength": 12}
    accessor = {"bufferView": 0, "componentType": 5126, "count": 1, "type": "VEC3"}
    for uri in ("../secret.bin", str(tmp_path / "secret.bin"), "%2e%2e/secret.bin", "file:///etc/passwd"):
        document = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": 64, "uri": uri}]}
        text = json.dumps({**document, "bufferViews": [view], "accessors": [accessor]})
        (folder / "face.gltf").write_text(text)
        found = {one.check: one for one in facepipe_gltf.validate(folder / "face.gltf", khronos=False)}
        assert set(found) == {"facepipe:GltfAccessors", "facepipe:GltfAsset"}  # there is no mesh either
        refused = "outside the roots|the document's folder|a file beside the document"
        assert re.search(refused, found["facepipe:GltfAccessors"].message)


def test_bytes_beyond_the_end_are_found_and_not_read(good: Path, tmp_path: Path) -> None:
    (tmp_path / "face.glb").write_bytes(good.read_bytes() + b"more")
    (found,) = facepipe_gltf.validate(tmp_path / "face.glb", khronos=False)
    assert (found.check, found.message) == ("facepipe:GltfAsset", "bytes beyond the length in its header are left out")
    imported = read(tmp_path / "face.glb", Options())
    assert imported.warnings == (f"face.glb: {found.message}",)


@pytest.mark.parametrize("content", [b"", b"glTF", b"nonsense" * 9, b"glTF" + bytes(40)])
def test_what_is_no_glb_is_an_input_error(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.glb"):
        validate(tmp_path / "a.glb")


JUNK = st.sampled_from([None, -1, 0, 1, 7, 2**31, 1e300, "x", [], {}, [None], [1, 2], True, [[0]], {"a": 1}]).map(
    copy.deepcopy
)


@pytest.mark.parametrize("odd", ["1", None, 1e31, [1.0]])
def test_a_node_whose_numbers_are_none_is_not_moved(odd: object) -> None:
    np.testing.assert_array_equal(local_matrix({"translation": [odd, 2.0, 3.0], "scale": [2.0, odd, 2.0]}), np.eye(4))


@settings(max_examples=150, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_mutated_documents_never_raise_anything_else(data: st.DataObject, good: Path, tmp_path: Path) -> None:
    document, binary = unpack(good.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        place: Any = document
        while True:
            keys = list(place) if isinstance(place, dict) else list(range(len(place)))
            key = data.draw(st.sampled_from(keys))
            child = place[key]
            if not (isinstance(child, dict | list) and child) or data.draw(st.integers(0, 4)) == 0:
                place[key] = data.draw(JUNK)
                break
            place = child
    (tmp_path / "face.glb").write_bytes(glb(document, bytes(binary)))
    facepipe_gltf.validate(tmp_path / "face.glb", khronos=False)


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(at=st.floats(0, 1), length=st.floats(0, 1), noise=st.binary(min_size=1, max_size=6))
def test_damaged_bytes_never_raise_anything_else(
    at: float, length: float, noise: bytes, good: Path, tmp_path: Path
) -> None:
    data = bytearray(good.read_bytes())
    start = int(at * (len(data) - len(noise)))
    data[start : start + len(noise)] = noise
    for content in (bytes(data), bytes(data[: int(length * len(data))])):
        (tmp_path / "face.glb").write_bytes(content)
        with contextlib.suppress(FacepipeError):
            facepipe_gltf.validate(tmp_path / "face.glb", khronos=False)


def test_face_without_skin_is_clean(tmp_path: Path) -> None:
    parts = tiny_face()
    loose = tuple(replace_mesh(mesh, skin=None) for mesh in parts.meshes)
    exported(replace(parts, meshes=loose), tmp_path / "face.glb")
    assert facepipe_gltf.validate(tmp_path / "face.glb", khronos=False) == ()
