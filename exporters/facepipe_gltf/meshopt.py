"""EXT_meshopt_compression, by the npm package meshoptimizer where node has it."""

from __future__ import annotations

import dataclasses
import json
import struct
import subprocess
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

from facepipe.core.errors import ExportError, InputError
from facepipe.core.policy.children import find_program
from facepipe.records import Json
from facepipe_gltf.node import run_node
from facepipe_gltf.read.meshopt import EXTENSION

if TYPE_CHECKING:
    from facepipe_gltf.document import Document


_WHERE = "--meshopt"
_VERTICES, _INDICES = 34962, 34963
_SIZES = {5123: 2, 5125: 4}
_ALIGNMENT = 4
_PROGRAM = """
const { pathToFileURL } = require("url");
const found = (name) => {
  try { return pathToFileURL(require.resolve(name, { paths: roots })).href; } catch (error) { process.exit(4); }
};
(async () => {
  const { MeshoptEncoder } = await import(found("meshoptimizer/encoder"));
  const { MeshoptDecoder } = await import(found("meshoptimizer/decoder"));
  await Promise.all([MeshoptEncoder.ready, MeshoptDecoder.ready]);
  const chunks = [];
  for await (const chunk of process.stdin) chunks.push(chunk);
  const input = Buffer.concat(chunks), length = input.readUInt32LE(0);
  let at = 4 + length;
  for (const { count, size, mode } of JSON.parse(input.subarray(4, at).toString())) {
    const source = new Uint8Array(input.subarray(at, at += count * size));
    const packed = MeshoptEncoder.encodeGltfBuffer(source, count, size, mode, 0);
    const again = new Uint8Array(count * size);
    MeshoptDecoder.decodeGltfBuffer(again, count, size, packed, mode);
    const head = Buffer.alloc(4);
    head.writeUInt32LE(packed.length);
    process.stdout.write(head), process.stdout.write(packed), process.stdout.write(again);
  }
})().catch((error) => { console.error(String(error)); process.exitCode = 3; });
"""
_NOT_INSTALLED = 4


class _Stream(NamedTuple):
    """The part of a buffer view that is compressed."""

    data: bytes
    elements: int
    size: int  # bytes of one element
    mode: str


def compressed(document: Document) -> Document:
    """The document with vertices and triangles compressed without loss: everything is decoded again and compared.

    The extension's mode for triangles would rotate their corners, and change the polygons that readers make of them.

    :raises InputError: node, or its package meshoptimizer, is not installed
    :raises ExportError: the decoded data differ from the encoded
    """
    binary = b"".join(document.binary)
    streams = _streams(document.json, binary)
    packed = _packed([*streams.values()])
    views: list[Json] = []
    chunks: list[bytes] = []
    size = whole = 0
    for number, view in enumerate(document.json.get("bufferViews", [])):
        stream = streams.get(number)
        data = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]] if stream is None else next(packed)
        place: Json = {"buffer": 0, "byteOffset": size, "byteLength": len(data)}
        if stream is not None:
            own = place | {"byteStride": stream.size, "count": stream.elements, "mode": stream.mode}
            place = {"buffer": 1, "byteOffset": whole, "byteLength": len(stream.data), "extensions": {EXTENSION: own}}
            whole += len(stream.data) + -len(stream.data) % _ALIGNMENT
        views.append(view | place)
        chunks += [data, bytes(-len(data) % _ALIGNMENT)]
        size += len(data) + -len(data) % _ALIGNMENT
    # the second buffer is in no file: readers decode into it
    fallback: Json = {"byteLength": whole, "extensions": {EXTENSION: {"fallback": True}}}
    result = document.json | {"bufferViews": views, "buffers": [{"byteLength": size}, fallback]}
    for key in ("extensionsUsed", "extensionsRequired"):
        result[key] = sorted([*result.get(key, []), EXTENSION])
    return dataclasses.replace(document, json=result, binary=chunks) if streams else document


def _streams(json_: Json, binary: bytes) -> dict[int, _Stream]:
    """The streams to compress, by buffer view. A list of triangles is a view of its own."""
    lists = {one["bufferView"]: one for one in json_.get("accessors", []) if "bufferView" in one}
    streams = {}
    for number, view in enumerate(json_.get("bufferViews", [])):
        start, target = view["byteOffset"], view.get("target")
        if target == _VERTICES:
            size = view["byteStride"]
            data = binary[start : start + view["byteLength"]]
            streams[number] = _Stream(data, len(data) // size, size, "ATTRIBUTES")
        elif target == _INDICES:
            count, size = lists[number]["count"], _SIZES[lists[number]["componentType"]]
            streams[number] = _Stream(binary[start : start + count * size], count, size, "INDICES")
    return streams


def _packed(streams: Sequence[_Stream]) -> Iterator[bytes]:
    """Each stream compressed, and checked with the package's decoder."""
    header = json.dumps([{"count": one.elements, "size": one.size, "mode": one.mode} for one in streams]).encode()
    answer = _run(b"".join([struct.pack("<I", len(header)), header, *(one.data for one in streams)]))
    at = 0
    for stream in streams:
        (length,) = struct.unpack_from("<I", answer, at)
        data, again = answer[at + 4 : at + 4 + length], answer[at + 4 + length : at + 4 + length + len(stream.data)]
        at += 4 + length + len(stream.data)
        if again != stream.data:
            raise ExportError(_WHERE, f"{stream.mode} are not the same when decoded again, expected no loss")
        yield data


def _run(request: bytes) -> bytes:
    node = find_program("node")
    if node is None:
        raise InputError(_WHERE, "needs node (20 or newer) on the PATH, and its package meshoptimizer")
    try:
        done = run_node(node, _PROGRAM, request=request)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ExportError(_WHERE, f"node did not compress the file: {error}") from None
    if done.returncode == _NOT_INSTALLED:
        how = "`npm install --global meshoptimizer`, or NODE_PATH with the folder that holds it"
        raise InputError(_WHERE, f"node has no package meshoptimizer, expected {how}")
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines()
        raise ExportError(_WHERE, f"node did not compress the file: {lines[-1][:200] if lines else done.returncode}")
    return done.stdout
