"""Hostile and broken glTF: one line with the trail, soon, and nothing but a FacepipeError."""

from __future__ import annotations

import copy
import json
import os
import struct
import tempfile
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from facepipe_gltf import read as gltf
from fuzz_damage import paths_of
from gltf_builder import Builder, Json, build, full_document, glb, make_model
from hypothesis import given, settings
from hypothesis import strategies as st

from facepipe.core.errors import FacepipeError, InputError

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)


def attempt(
    data: bytes, folder: Path | None = None, name: str = "face.glb", *, strict: bool = False
) -> FacepipeError | None:
    """Read `data`; the error it ends in. Any other exception passes through and fails the test."""
    with tempfile.TemporaryDirectory() as temporary:
        source = (folder or Path(temporary)) / name
        source.write_bytes(data)
        try:
            gltf.read(source, gltf.Options(strict=strict))
        except FacepipeError as error:
            found = error
        else:
            return None
    assert "\n" not in str(found)
    assert len(str(found)) < 500
    assert str(found).startswith(name)
    return found


def expect(data: bytes | Builder, *words: str, **where: Any) -> None:
    error = attempt(data.glb() if isinstance(data, Builder) else data, **where)
    assert isinstance(error, InputError)
    for word in words:
        assert word in str(error)


def test_the_whole_document_reads() -> None:
    assert attempt(full_document().glb()) is None


# containers


GOOD = full_document().glb()


@pytest.mark.parametrize(
    ("data", "word"),
    [
        (b"", "empty"),
        (b"glTF", "4 bytes"),
        (GOOD[:19], "19 bytes"),
        (GOOD[:-1], "truncated"),
        (GOOD[: len(GOOD) // 2], "truncated"),
        (b"GLTF" + GOOD[4:], "magic"),
        (GOOD[:4] + struct.pack("<I", 1) + GOOD[8:], "version 1"),
        (GOOD[:12] + struct.pack("<I", 2**32 - 1) + GOOD[16:], "beyond"),
        (GOOD[:16] + b"BIN\0" + GOOD[20:], "first chunk"),
        (glb(b"[1, 2]"), "not an object"),
        (glb(b"\xff\xfe"), "UTF-8"),
        (glb(b'{"asset": {"version": "2.0"}, "x": NaN}'), "NaN"),
        (glb(b'{"asset": {"version": "2.0"}, "x": ' + b"[" * 200_000 + b"]" * 200_000 + b"}"), "deep"),
        (glb(b'{"asset": {"version": "2.0"}, "scene": ' + b"9" * 10_000 + b"}"), "JSON"),
        (glb(b'{"asset": {"version": "2.0"}, "nodes": [{"scale": [1e999, 1, 1]}]}'), "nodes[0].scale[0]"),
        (glb({"asset": {"version": "1.0"}}), "1.0"),
        (glb({"asset": {"version": "2.0", "minVersion": "2.1"}}), "minVersion"),
        (glb({"asset": {}}), "asset: no version"),
        (glb({"asset": {"version": "2.0"}}), "no mesh"),
    ],
)
def test_broken_containers(data: bytes, word: str) -> None:
    expect(data, word)


def test_second_binary_chunk() -> None:
    data = GOOD + struct.pack("<II", 4, 0x004E4942) + b"\0\0\0\0"
    expect(data[:8] + struct.pack("<I", len(data)) + data[12:], "second BIN")


@pytest.mark.parametrize("name", ["KHR_meshopt_compression", "EXT_mesh_gpu_instancing"])
def test_required_extensions_that_are_not_supported(name: str) -> None:
    builder = full_document()
    builder.root["extensionsRequired"] = [name]
    expect(builder, "extensionsRequired[0]", name)


# one wrong value in a good document: where, what, and the trail

_TRAILS: list[tuple[str, Any, str]] = [
    ("accessors.0.count", 10**9, "accessors[0]"),
    ("accessors.0.count", 2**60, "accessors[0]"),
    ("accessors.0.count", -1, "accessors[0].count"),
    ("accessors.0.count", True, "accessors[0].count"),
    ("accessors.0.count", "54", "accessors[0].count"),
    ("accessors.0.count", 1.5, "accessors[0].count"),
    ("accessors.0.count", None, "accessors[0].count"),
    ("accessors.0.count", 50, "accessors[3] has 54 elements, expected 50"),
    ("accessors.0.componentType", 5124, "accessors[0].componentType"),
    ("accessors.0.type", "VEC2", "accessors[0]"),
    ("accessors.0.bufferView", 999, "accessors[0].bufferView"),
    ("accessors.0.byteOffset", 12, "accessors[0]"),
    ("accessors.0.bufferView", {}, "accessors[0].bufferView"),
    ("bufferViews.0.byteLength", 2**40, "bufferViews[0]"),
    ("bufferViews.0.byteOffset", 2**40, "bufferViews[0]"),
    ("bufferViews.0.byteStride", 4, "bufferViews[0].byteStride"),
    ("bufferViews.0.buffer", 1, "bufferViews[0].buffer"),
    ("buffers.0.byteLength", 2**40, "buffers[0]"),
    ("nodes.1.children", [1], "nodes[1]"),
    ("nodes.1.children", [2, 2], "nodes[2]"),
    ("nodes.11.children", [3], "nodes[3]"),
    ("nodes.8.children", [0], "nodes["),
    ("nodes.1.children", [99], "nodes[1].children[0]"),
    ("nodes.1.rotation", [0, 0, 0, 0], "nodes[1].rotation"),
    ("nodes.1.rotation", [0, 0, 1], "nodes[1].rotation"),
    ("nodes.1.scale", [1, 10**400, 1], "nodes[1].scale[1]"),
    ("nodes.1.scale", [1, 1, 1e300], "nodes[1].scale[2]"),
    ("nodes.2.matrix", [1] * 16, "nodes[2].matrix"),
    ("nodes.11.mesh", 1, "nodes[11].mesh"),
    ("nodes.11.skin", 1, "nodes[11].skin"),
    ("nodes.11.mesh", False, "nodes[11].mesh"),
    ("nodes.1.name", "\ud800", "nodes[1].name"),
    ("scene", 1, "scene"),
    ("scenes.0.nodes", [0, 0], "scenes[0].nodes[1]"),
    ("scenes.0.nodes", [1], "scenes[0].nodes[0]"),
    ("skins.0.joints", [1, 3, 99], "skins[0].joints[2]"),
    ("skins.0.joints", [1, 1], "skins[0]"),
    ("skins.0.joints", [], "skins[0]"),
    ("skins.0.joints", [1], "meshes[0]"),
    ("skins.0.inverseBindMatrices", 0, "skins[0].inverseBindMatrices"),
    ("meshes.0.primitives.0.indices", 0, "meshes[0].primitives[0].indices"),
    ("meshes.0.primitives.0.mode", 7, "meshes[0].primitives[0]"),
    ("meshes.0.primitives.0.material", 5, "meshes[0].primitives[0].material"),
    ("meshes.0.primitives.0.attributes.JOINTS_1", 0, "JOINTS_1"),
    ("meshes.0.primitives.0.targets.0.POSITION", 2, "targets[0].POSITION"),
    ("meshes.0.primitives.0.attributes", {}, "no POSITION"),
    ("meshes.0.primitives", {}, "meshes[0].primitives"),
    ("meshes.0.extras.facepipe", 3, "meshes[0].extras.facepipe"),
    ("materials.0.pbrMetallicRoughness.baseColorTexture.index", 9, "materials[0]"),
    ("materials.0.pbrMetallicRoughness.baseColorFactor", [1, 1, 1], "materials[0]"),
    ("materials.0.alphaMode", "GLASS", "materials[0]"),
    ("samplers.0.wrapS", 1, "samplers[0].wrapS"),
    ("textures.0.source", 9, "textures[0].source"),
    ("images.0.bufferView", 0, "images[0]"),
    ("animations.0.samplers.0.input", 0, "animations[0].samplers[0].input"),
    ("animations.0.samplers.0.interpolation", "LINEAR", "animations[0].samplers[0].output"),
    ("animations.0.channels.0.sampler", 2, "animations[0].channels[0].sampler"),
    ("animations.0.channels.0.target.node", 99, "animations[0].channels[0].target.node"),
]


def put(root: Json, path: str, value: Any) -> Json:
    """`root` with one value replaced."""
    root = copy.deepcopy(root)
    *steps, last = [int(step) if step.isdigit() else step for step in path.split(".")]
    holder: Any = root
    for step in steps:
        holder = holder[step]
    holder[last] = value
    return root


@pytest.mark.parametrize(("path", "value", "trail"), _TRAILS)
def test_wrong_values_are_named_by_their_trail(path: str, value: Any, trail: str) -> None:
    builder = full_document()
    builder.glb()
    expect(glb(put(builder.root, path, value), bytes(builder.binary)), "face.glb -> ", trail, strict=True)


# binary data


def with_floats(kind: str, bad: float) -> Builder:
    """The document with one wrong float in the accessor of one use."""
    builder = full_document()
    primitive = builder.root["meshes"][0]["primitives"][0]
    sampler = builder.root["animations"][0]["samplers"][0]
    accessor = {
        "POSITION": primitive["attributes"]["POSITION"],
        "WEIGHTS_0": primitive["attributes"]["WEIGHTS_0"],
        "TEXCOORD_0": primitive["attributes"]["TEXCOORD_0"],
        "dense target": primitive["targets"][2]["POSITION"],
        "sparse target": primitive["targets"][0]["POSITION"],
        "inverse bind": builder.root["skins"][0]["inverseBindMatrices"],
        "key times": sampler["input"],
        "keys": sampler["output"],
    }[kind]
    entry = builder.root["accessors"][accessor]
    view = entry["bufferView"] if "bufferView" in entry else entry["sparse"]["values"]["bufferView"]
    at = builder.root["bufferViews"][view]["byteOffset"]
    builder.binary[at : at + 4] = struct.pack("<f", bad)
    return builder


def test_motion_under_scales_that_multiply_beyond_float64() -> None:
    builder = build(make_model())
    nodes, joint = builder.root["nodes"], builder.root["skins"][0]["joints"][1]
    above = next(node for node in nodes if joint in node.get("children", []))
    above["children"].remove(joint)
    for _ in range(16):
        above["children"] = [*above.get("children", []), len(nodes)]
        above = {"scale": [1e18, 1e18, 1e18]}
        nodes.append(above)
    above["children"] = [joint]
    sampler = {"input": builder.array(np.array([0.0])), "output": builder.array(np.full((1, 3), 3e38))}
    channel = {"sampler": 0, "target": {"node": joint, "path": "scale"}}
    builder.add("animations", {"samplers": [sampler], "channels": [channel]})
    expect(builder, "animations[0]: joint transforms that are not finite")


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize(
    "kind",
    ["POSITION", "WEIGHTS_0", "TEXCOORD_0", "dense target", "sparse target", "inverse bind", "key times", "keys"],
)
def test_non_finite_floats(kind: str, bad: float) -> None:
    expect(with_floats(kind, bad), "accessors[", "non-finite")


@pytest.mark.parametrize(
    ("kind", "bad", "words"),
    [
        ("WEIGHTS_0", -0.5, ("WEIGHTS_0", "-0.5")),
        ("key times", 5.0, ("animations[0].samplers[0].input", "ascend")),  # the next is earlier
    ],
)
def test_floats_out_of_place(kind: str, bad: float, words: tuple[str, str]) -> None:
    expect(with_floats(kind, bad), *words)


def test_singular_inverse_bind() -> None:
    builder = full_document()
    binds = np.tile(np.eye(4), (9, 1, 1))
    binds[4, 1, 1] = 0.0
    builder.root["skins"][0]["inverseBindMatrices"] = builder.array(binds.reshape(-1, 16))
    expect(builder, "skins[0].inverseBindMatrices", "matrix 4 is singular")


@pytest.mark.parametrize(("indices", "word"), [([0, 9], "index 9 of 3"), ([1, 1], "ascending"), ([2, 0], "ascending")])
def test_sparse_indices(indices: list[int], word: str) -> None:
    builder = triangle()
    sparse = {
        "count": 2,
        "indices": {"bufferView": builder.view(bytes(indices)), "componentType": 5121},
        "values": {"bufferView": builder.view(bytes(24))},
    }
    builder.root["accessors"][0]["sparse"] = sparse
    expect(builder, "accessors[0].sparse.indices", word)


def triangle() -> Builder:
    builder = Builder()
    builder.add("meshes", {"primitives": [{"attributes": {"POSITION": builder.array(TRIANGLE)}}]})
    builder.add("nodes", {"mesh": 0})
    return builder


# files that ask for more than they hold


def zeros(count: int) -> Builder:
    builder = triangle()
    builder.root["accessors"][0] = {"componentType": 5126, "type": "VEC3", "count": count}
    return builder


def repeated_primitives() -> Builder:
    """Many primitives over one large index buffer."""
    builder = triangle()
    indices = builder.array(np.zeros(300_000), "u2")
    builder.root["meshes"][0]["primitives"] = [{"attributes": {"POSITION": 0}, "indices": indices}] * 20_000
    return builder


def overlapping_accessors() -> Builder:
    """Many UV accessors, each with its own vertices, over one bufferView."""
    builder = triangle()
    big = builder.array(np.zeros((99_999, 3)))
    builder.root["meshes"][0]["primitives"] = []
    for _ in range(2000):
        accessor = builder.add("accessors", dict(builder.root["accessors"][big]))
        builder.root["meshes"][0]["primitives"].append({"attributes": {"POSITION": accessor}})
    return builder


def chain_of_joints() -> Builder:
    """Joint paths grow with the square of the chain."""
    builder = triangle()
    count = 20_000
    builder.root["nodes"] = [{"name": "j" * 60, "children": [i + 1]} for i in range(count)] + [{"mesh": 0}]
    builder.add("skins", {"joints": list(range(count))})
    return builder


def crossed_key_times() -> Builder:
    """Every channel has times of its own, so that the union is as long as all together."""
    builder = build(make_model())
    samplers, channels = [], []
    for node, path in [(n, p) for n in make_model().joint_nodes for p in ("translation", "scale")]:
        times = builder.array(np.arange(50_000) + len(samplers) / 40)
        samplers.append({"input": times, "output": builder.array(np.ones((50_000, 3)), "i1", normalized=True)})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})
    for number in range(10):
        builder.add("animations", {"samplers": samplers, "channels": channels, "name": str(number)})
    return builder


def pointers_to_a_mesh_of_many_nodes() -> Builder:
    """Every channel means all nodes that show the mesh."""
    builder = triangle()
    builder.root["nodes"] *= 8_000
    builder.root["scenes"] = [{"nodes": [0]}]
    target = {"path": "pointer", "extensions": {"KHR_animation_pointer": {"pointer": "/meshes/0/weights"}}}
    one = {"samplers": [{"input": 0, "output": 0}], "channels": [{"sampler": 0, "target": target}]}
    builder.root["animations"] = [one] * 1100
    return builder


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: zeros(2**31), "far more data"),
        (lambda: zeros(2**52), "count"),
        pytest.param(repeated_primitives, "far more data", marks=pytest.mark.slow),
        (overlapping_accessors, "far more data"),
        (chain_of_joints, "far more data"),
        (crossed_key_times, "far more data"),
        (pointers_to_a_mesh_of_many_nodes, "far more data"),
    ],
    ids=[
        "zeros",
        "more zeros",
        "repeated primitives",
        "overlapping accessors",
        "chain of joints",
        "crossed key times",
        "pointers",
    ],
)
def test_small_files_cannot_ask_for_much(make: Callable[[], Builder], word: str, tmp_path: Path) -> None:
    data = make().glb()
    tracemalloc.start()
    try:
        expect(data, word, folder=tmp_path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 500 * 2**20 + 60 * len(data)


# URIs


@pytest.mark.parametrize(
    ("uri", "word"),
    [
        ("../outside.bin", "outside the roots"),
        ("sub/../../outside.bin", "outside the roots"),
        ("%2e%2e/outside.bin", "outside the roots"),
        ("..%2foutside.bin", "outside the roots"),
        ("..\\outside.bin", "expected a path"),
        ("/etc/hostname", "expected a path"),
        ("%2fetc%2fhostname", "expected a path"),
        ("file:///etc/hostname", "data URI or a file"),
        ("http://127.0.0.1:9/a.bin", "data URI or a file"),
        ("C:/a.bin", "data URI or a file"),
        ("link.bin", "outside the roots"),
        ("linked/outside.bin", "outside the roots"),
        ("loop.bin", ""),
        ("pipe", "regular file"),
        (".", ""),
        ("", "expected a path"),
        ("a\0b", "expected a path"),
        ("a" * 5000, ""),
        ("absent.bin", "No such file"),
        ("short.bin", "3 bytes"),
        ("data:application/octet-stream;base64,%%%", "base64"),
        ("data:application/octet-stream;base64,AAA", "base64"),
        ("data:application/octet-stream,AAAA", "base64"),
        ("data:", "base64"),
    ],
)
def test_uris_stay_in_the_roots(uri: str, word: str, tmp_path: Path) -> None:
    home = tmp_path / "home"
    (home / "sub").mkdir(parents=True)
    (tmp_path / "outside.bin").write_bytes(TRIANGLE.tobytes())
    (home / "link.bin").symlink_to(tmp_path / "outside.bin")
    (home / "linked").symlink_to(tmp_path)
    (home / "loop.bin").symlink_to(home / "loop.bin")
    (home / "short.bin").write_bytes(b"abc")
    os.mkfifo(home / "pipe")
    builder = triangle()
    builder.root["buffers"] = [{"byteLength": 36, "uri": uri}]
    expect(json.dumps(builder.root).encode(), word, "face.gltf -> buffers[0]", folder=home, name="face.gltf")


def test_images_of_unknown_type() -> None:
    builder = full_document()
    builder.root["images"][0] = {"bufferView": builder.view(b"RIFF....WEBP")}
    expect(builder, "images[0]", "not a picture", strict=True)
    assert attempt(builder.glb()) is None


# fuzz


ODD: list[Any] = [
    None, True, False, -1, 0, 1, 2, 3, 255, 2**31, 2**53, 10**400, -0.5, 1.5, 1e308, -1e308, 5e-324, "", "x", "2.0",
    "\ud800", "\0", "../x", "SCALAR", "MAT4", "weights", [], [0], [-1], [[]], [0] * 16, {}, {"a": 1}, {"index": 0},
]  # fmt: skip


_BUILDER = full_document()
_BUILDER.glb()
_PATHS = paths_of(_BUILDER.root)


@settings(max_examples=600, deadline=None, derandomize=True, database=None)
@given(st.lists(st.tuples(st.sampled_from(_PATHS), st.sampled_from([*ODD, "delete"])), min_size=1, max_size=3))
def test_any_json_value_replaced(changes: list[tuple[tuple[Any, ...], Any]]) -> None:
    root = copy.deepcopy(_BUILDER.root)
    for path, value in changes:
        holder: Any = root
        try:
            for step in path[:-1]:
                holder = holder[step]
            if value == "delete":
                del holder[path[-1]]
            else:
                holder[path[-1]] = copy.deepcopy(value)
        except (KeyError, IndexError, TypeError):
            continue  # an earlier change took the place away
    attempt(glb(json.dumps(root).encode(), bytes(_BUILDER.binary)))


@settings(max_examples=300, deadline=None, derandomize=True, database=None)
@given(st.lists(st.tuples(st.integers(0, len(GOOD) - 1), st.integers(0, 255)), min_size=1, max_size=8))
def test_any_bytes_replaced(changes: list[tuple[int, int]]) -> None:
    data = bytearray(GOOD)
    for at, value in changes:
        data[at] = value
    attempt(bytes(data))


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(
    st.lists(st.tuples(st.integers(0, len(_BUILDER.binary) // 4 - 1), st.binary(min_size=4, max_size=4)), max_size=6)
)
def test_any_binary_words_replaced(changes: list[tuple[int, bytes]]) -> None:
    binary = bytearray(_BUILDER.binary)
    for word, value in changes:
        binary[4 * word : 4 * word + 4] = value
    attempt(glb(_BUILDER.root, bytes(binary)))


@settings(max_examples=100, deadline=None, derandomize=True, database=None)
@given(st.integers(0, len(GOOD) - 1))
def test_any_truncation(length: int) -> None:
    assert isinstance(attempt(GOOD[:length]), InputError)
