"""KHR_draco_mesh_compression: what Draco's encoder made of a known model is read as the model, or refused."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from draco_files import BITS, DRACO, FILES, FOLDER, compressed, plain
from draco_files import read as read_file
from facepipe_gltf import read as gltf
from facepipe_gltf.read.draco import EXPORTS
from facepipe_gltf.validation import validate
from gltf_builder import Array, Builder, Json, glb
from hypothesis import given, settings
from hypothesis import strategies as st
from node import HERE, node_packages
from places import REPOSITORY
from scipy.spatial import cKDTree

from facepipe.core.errors import InputError
from facepipe.parts import FaceParts

pytest.importorskip("wasmtime")

EXACT = dict.fromkeys(("points", "uvs", "normals", "colors", "weights", "shapes"), 1e-6)
ROUNDED = {  # half a step of the bits, and what a renormalised weight adds
    "points": 0.25 / 2**14,
    "uvs": 0.5 / 2**12,
    "normals": 0.006,
    "colors": 1e-6,
    "weights": 2 / 2**12,
    "shapes": 1e-6,
}


def imported(data: bytes | Builder, folder: Path, **options: Any) -> Any:
    source = folder / "face.glb"
    source.write_bytes(data.glb() if isinstance(data, Builder) else data)
    return gltf.read(source, gltf.Options(**options))


def refusal(data: bytes, folder: Path) -> str:
    with pytest.raises(InputError) as caught:
        imported(data, folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def changed(name: str, change: Callable[[Json, Json, Json], Any]) -> bytes:
    """One of the files after a change of its JSON: the document, the first primitive, what Draco's extension says."""
    root, binary = read_file(name)
    primitive = root["meshes"][0]["primitives"][0]
    change(root, primitive, primitive["extensions"][DRACO])
    return glb(root, binary)


def with_payload(payload: bytes) -> bytes:
    """The sequential file with other bytes for Draco."""

    def change(root: Json, primitive: Json, packed: Json) -> None:
        view = root["bufferViews"][packed["bufferView"]]
        view.update(byteOffset=len(binary), byteLength=len(payload))
        root["buffers"][0]["byteLength"] = len(binary) + len(payload)

    root, binary = read_file("sequential")
    primitive = root["meshes"][0]["primitives"][0]
    change(root, primitive, primitive["extensions"][DRACO])
    return glb(root, binary + payload)


def payload_of(name: str) -> bytes:
    root, binary = read_file(name)
    view = root["bufferViews"][root["meshes"][0]["primitives"][0]["extensions"][DRACO]["bufferView"]]
    return binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]


def corners(parts: FaceParts) -> dict[str, Array]:
    """What each corner of each triangle has: (corners, width) arrays."""
    (mesh,) = parts.meshes
    at, count = mesh.face_vertex_indices, len(mesh.points)
    assert mesh.skin is not None
    assert mesh.normals is not None
    assert mesh.colors is not None
    weights = np.zeros((count, len(parts.skeleton.joints)))
    np.add.at(weights, (np.arange(count)[:, None], mesh.skin.joint_indices), mesh.skin.joint_weights)
    shapes = np.zeros((count, len(mesh.blendshapes), 3))
    for number, shape in enumerate(mesh.blendshapes):
        shapes[shape.point_indices, number] = shape.offsets
    (uvs,) = mesh.uv_sets
    return {
        "points": np.asarray(mesh.points)[at],
        "uvs": uvs.values[at if uvs.indices is None else uvs.indices],
        "normals": mesh.normals[at] if len(mesh.normals) == count else mesh.normals,
        "colors": mesh.colors[at],
        "weights": weights[at],
        "shapes": shapes[at].reshape(len(at), -1),
    }


def assert_same(found: FaceParts, expected: FaceParts, within: dict[str, float]) -> None:
    """The same triangles with the same at their corners, in whatever order."""
    got, right = corners(found), corners(expected)
    # vertices lie 0.03 apart in position or, at the seam, 0.3 in UVs: the nearest one is the same one
    keys = [np.concatenate([one["points"], one["uvs"] / 10], axis=1) for one in (got, right)]
    vertices, first, numbers = np.unique(keys[1], axis=0, return_index=True, return_inverse=True)
    distance, nearest = cKDTree(vertices).query(keys[0])
    assert distance.max() < 0.005

    def sorted_triangles(corner: Array) -> Array:
        rows = corner.reshape(-1, 3)
        turned = np.take_along_axis(rows, (rows.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
        return turned[np.lexsort(turned.T)]

    assert np.array_equal(sorted_triangles(nearest), sorted_triangles(numbers.ravel()))
    for name, values in got.items():
        assert np.abs(values - right[name][first][nearest]).max() <= within[name], name
    assert [one.name for one in found.meshes[0].blendshapes] == [one.name for one in expected.meshes[0].blendshapes]
    triangles = [dict.fromkeys(one.material for one in parts.meshes[0].material_faces) for parts in (found, expected)]
    assert triangles[0] == triangles[1]


@pytest.mark.parametrize("name", FILES)
def test_it_reads_what_was_compressed(name: str, tmp_path: Path) -> None:
    found = gltf.read(FOLDER / f"{name}.glb", gltf.Options())
    expected = imported(plain(FILES[name][2]), tmp_path)
    assert_same(found.parts, expected.parts, ROUNDED if FILES[name][1] else EXACT)
    rounded = ("renormalised", "rounded its primitives apart")
    others = [line for line in found.warnings if not any(words in line for words in rounded)]
    assert others == [line.replace("face.glb", f"{name}.glb") for line in expected.warnings]


def test_sequential_files_keep_the_order_of_vertices_and_triangles(tmp_path: Path) -> None:
    found = gltf.read(FOLDER / "sequential.glb", gltf.Options(weld=False)).parts.meshes[0]
    expected = imported(plain(), tmp_path, weld=False).parts.meshes[0]
    assert np.array_equal(found.points, expected.points)
    assert np.array_equal(found.face_vertex_indices, expected.face_vertex_indices)


def test_strips_of_compressed_triangles_are_triangles(tmp_path: Path) -> None:
    strip = changed("sequential", lambda root, primitive, packed: primitive.update(mode=5))
    assert_same(imported(strip, tmp_path).parts, imported(plain(), tmp_path).parts, EXACT)


def test_what_is_there_uncompressed_too_is_read_so(tmp_path: Path) -> None:
    builder = plain()
    primitive = builder.root["meshes"][0]["primitives"][0]
    numbers = {name: number for number, name in enumerate(primitive["attributes"])}
    primitive["extensions"] = {DRACO: {"bufferView": builder.view(b"no Draco"), "attributes": numbers}}
    builder.root["extensionsUsed"] = [DRACO]
    assert_same(imported(builder, tmp_path).parts, imported(plain(), tmp_path).parts, EXACT)
    del primitive["indices"]
    (tmp_path / "face.glb").write_bytes(builder.glb())
    assert not any("Draco" in one.message for one in validate(tmp_path / "face.glb", khronos=False))
    builder.root["extensionsRequired"] = [DRACO]
    assert "can't be decoded: Not a Draco file" in refusal(builder.glb(), tmp_path)


def test_attributes_that_are_not_compressed_are_read_beside_those_that_are(tmp_path: Path) -> None:
    root, binary = read_file("sequential")
    primitive = root["meshes"][0]["primitives"][0]
    builder = Builder(root, bytearray(binary))
    other = np.linspace(0, 1, 108).reshape(54, 2)
    primitive["attributes"]["TEXCOORD_0"] = builder.array(other)
    del primitive["extensions"][DRACO]["attributes"]["TEXCOORD_0"]
    found = imported(builder, tmp_path).parts.meshes[0].uv_sets[0]
    assert np.abs(np.unique(found.values[:, 0]) - np.unique(other[:, 0].astype(np.float32))).max() < 1e-6


def test_other_counts_of_the_accessors_are_named(tmp_path: Path) -> None:
    def change(root: Json, primitive: Json, packed: Json) -> None:
        root["accessors"][primitive["attributes"]["POSITION"]]["count"] = 50

    found = imported(changed("sequential", change), tmp_path)
    assert_same(found.parts, imported(plain(), tmp_path).parts, EXACT)
    assert any("holds 54 vertices, its accessors say 50" in line for line in found.warnings)


@pytest.mark.parametrize(("name", "apart"), [("parts", False), ("rounded_parts", True)])
def test_primitives_that_draco_rounded_apart_are_named(name: str, apart: bool) -> None:
    warnings = gltf.read(FOLDER / f"{name}.glb", gltf.Options()).warnings
    assert any("Draco has rounded its primitives apart" in line for line in warnings) == apart


def entry(name: str, **values: Any) -> Callable[[Json, Json, Json], Any]:
    return lambda root, primitive, packed: root["accessors"][primitive["attributes"][name]].update(values)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda root, primitive, packed: packed["attributes"].update(POSITION=99), "attribute 99 has 0 components"),
        (lambda root, primitive, packed: packed["attributes"].update(POSITION=2), "2 components, expected 3"),
        (lambda root, primitive, packed: packed["attributes"].update(POSITION=-1), "attributes.POSITION: -1"),
        (lambda root, primitive, packed: packed["attributes"].update(POSITION=2**40), "attribute 1099511627776 has 0"),
        (lambda root, primitive, packed: packed["attributes"].pop("NORMAL"), "no 'NORMAL' in its attributes"),
        (lambda root, primitive, packed: packed.pop("bufferView"), "no bufferView"),
        (lambda root, primitive, packed: packed.update(bufferView=999), "999, but there are"),
        (entry("JOINTS_0", type="MAT9"), "'MAT9', expected SCALAR"),
        (entry("POSITION", componentType=5124), "componentType: 5124"),
        (entry("POSITION", count="x"), "count"),
        (
            lambda root, primitive, packed: root["bufferViews"][packed["bufferView"]].update(
                extensions={"EXT_meshopt_compression": {}}
            ),
            "expected one of them",
        ),
        (
            lambda root, primitive, packed: primitive["targets"][0].update(POSITION=primitive["indices"]),
            "expected VEC3",
        ),
    ],
)
def test_what_does_not_fit_is_refused(change: Any, words: str, tmp_path: Path) -> None:
    assert words in refusal(changed("edgebreaker", change), tmp_path)


def test_targets_of_other_counts_are_refused(tmp_path: Path) -> None:
    root, binary = read_file("sequential")
    builder = Builder(root, bytearray(binary))
    root["meshes"][0]["primitives"][0]["targets"][1]["POSITION"] = builder.array(np.zeros((53, 3)))
    assert "has 53 elements, expected 54" in refusal(builder.glb(), tmp_path)


def test_checks_look_at_what_was_compressed(tmp_path: Path) -> None:
    def checks(data: bytes) -> set[str]:
        (tmp_path / "face.glb").write_bytes(data)
        return {one.check.partition(":")[2] for one in validate(tmp_path / "face.glb", khronos=False)}

    usual = {"GltfMinMax", "GltfSkinnedNode"}  # the writer of tests gives neither bounds nor nodes as engines want them
    assert checks((FOLDER / "quantised.glb").read_bytes()) == usual
    fewer = changed("quantised", lambda root, primitive, packed: root["skins"][0]["joints"].pop())
    assert checks(fewer) >= {"GltfJointIndices"}
    assert checks(with_payload(b"no Draco")) >= {"GltfAccessors"}


def varint(number: int) -> bytes:
    result = b""
    while number > 127:
        result += bytes([number & 127 | 128])
        number >>= 7
    return result + bytes([number])


HEADER = b"DRACO\x02\x02"


@pytest.mark.parametrize(
    "payload",
    [
        b"\0",
        b"DRACO",
        HEADER + b"\x01\x00\x00\x00",
        HEADER + b"\x00\x00\x00\x00" + b"\0" * 64,  # a cloud of points
        b"DRACO\x09\x09\x01\x01\x00\x00" + b"\0" * 64,
        *(HEADER + b"\x01\x00\x00\x00" + varint(n) + varint(n) + b"\1" * 99 for n in (10**6, 2**29, 2**32 - 1)),
        *(HEADER + b"\x01\x01\x00\x00" + b"\0" + varint(n) * 4 + b"\1" * 99 for n in (10**6, 2**29, 2**32 - 1)),
    ],
    ids=range(11),
)
def test_what_is_no_mesh_of_draco_is_refused(payload: bytes, tmp_path: Path) -> None:
    line = refusal(with_payload(payload), tmp_path)
    assert "meshes[0].primitives[0].extensions.KHR_draco_mesh_compression: " in line


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_damaged_data_is_refused_or_read(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    broken = bytearray(payload_of(data.draw(st.sampled_from(list(FILES)))))
    for _ in range(data.draw(st.integers(0, 4))):
        broken[data.draw(st.integers(0, len(broken) - 1))] = data.draw(st.integers(0, 255))
    del broken[data.draw(st.integers(1, len(broken))) :]
    with contextlib.suppress(InputError):
        imported(with_payload(bytes(broken)), tmp_path_factory.getbasetemp())


def test_without_wasmtime_one_line_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wasmtime", None)
    assert "expected `pip install 'facepipe[draco]'`" in refusal((FOLDER / "parts.glb").read_bytes(), tmp_path)


def test_a_file_without_draco_needs_no_wasmtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wasmtime", None)
    assert imported(plain(), tmp_path).parts.meshes


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_the_files_are_what_draco_makes_today(name: str) -> None:
    method, bits, primitives = FILES[name]
    assert compressed(plain(primitives), method, bits).glb() == (FOLDER / f"{name}.glb").read_bytes()


@pytest.mark.slow
def test_the_decoder_and_its_names_are_those_of_the_package() -> None:
    node_packages()
    package = HERE / "node_modules/draco3dgltf"
    script = (package / "draco_decoder_gltf_nodejs.js").read_text(encoding="utf-8").replace("\n", "")
    names = dict(re.findall(r"\ba\.(\w+)=a\.asm\.([\w$]+)\)\.apply", script))
    called = {name: export for name, export in EXPORTS.items() if name != "__wasm_call_ctors"}
    assert {name: names.get(name) for name in called} == called
    shipped = REPOSITORY / "exporters/facepipe_gltf/read/draco_decoder.wasm"
    assert shipped.read_bytes() == (package / "draco_decoder_gltf.wasm").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["SEQUENTIAL", "EDGEBREAKER"])
@pytest.mark.parametrize("bits", [{}, BITS, {"POSITION": 16}])
def test_other_settings_of_the_encoder_are_read(method: str, bits: dict[str, int], tmp_path: Path) -> None:
    for primitives in (1, 3):
        found = imported(compressed(plain(primitives), method, bits), tmp_path).parts
        assert_same(found, imported(plain(primitives), tmp_path).parts, ROUNDED if bits else EXACT)
