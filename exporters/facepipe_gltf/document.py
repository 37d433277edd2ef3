"""A face as a glTF document, the exporter's table of contents; levels in one file, and meshopt's compression."""

from __future__ import annotations

import dataclasses
import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from facepipe.core import __version__
from facepipe.core.errors import ExportError, InputError
from facepipe.core.names import select
from facepipe.declare import check_ranges
from facepipe.parts import FaceParts, HasLevels, HasParts, exact
from facepipe.records import Json
from facepipe.rig.animation import linear_skinning_notes
from facepipe_gltf.animations import AnimationWriter, JointNodes, joint_nodes
from facepipe_gltf.baking import Baked, Sculpt, bake, extras, storage_error, weight_error
from facepipe_gltf.buffers import MESHOPT, Buffers, Chunk, Encoding
from facepipe_gltf.losses import check, dropped, influence_error, listed_meshes, skin_warnings
from facepipe_gltf.materials import VARIANTS, WEBP, Image, MaterialWriter
from facepipe_gltf.options import Options, check_engine, engine_warnings
from facepipe_gltf.placement import space_of
from facepipe_gltf.primitives import PrimitiveWriter, by_material
from facepipe_gltf.record import record_of
from facepipe_gltf.record_format import Record, packed

_WHERE, _PACKAGE = "--meshopt", "meshoptimizer"
_VERTICES, _INDICES = 34962, 34963
_SIZES = {5123: 2, 5125: 4}
_ALIGNMENT = 4
_PROGRAM = """
  const { MeshoptEncoder } = await import(found("meshoptimizer/encoder"));
  const { MeshoptDecoder } = await import(found("meshoptimizer/decoder"));
  await Promise.all([MeshoptEncoder.ready, MeshoptDecoder.ready]);
  const input = await received(), length = input.readUInt32LE(0);
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
"""
_LODS = "MSFT_lod"
_COUNTED = ("vertices", "triangles", "primitives", "targets")


class _Stream(NamedTuple):
    """The part of a buffer view that is compressed."""

    data: bytes
    elements: int
    size: int  # bytes of one element
    mode: str


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


def meshopt_missing() -> str | None:
    """What compressing lacks here, as a message has it; None: nothing."""
    from facepipe_gltf.node_packages import answer_of

    try:
        answer_of(_WHERE, _PACKAGE, _PROGRAM, struct.pack("<I", 2) + b"[]")
    except (InputError, ExportError) as error:
        return error.what
    return None


def _compressed(streams: Sequence[_Stream]) -> Iterator[bytes]:
    """Each stream compressed, and checked with the package's decoder."""
    from facepipe_gltf.node_packages import answer_of

    header = json.dumps([{"count": one.elements, "size": one.size, "mode": one.mode} for one in streams]).encode()
    request = b"".join([struct.pack("<I", len(header)), header, *(one.data for one in streams)])
    answer = answer_of(_WHERE, _PACKAGE, _PROGRAM, request)
    at = 0
    for stream in streams:
        (length,) = struct.unpack_from("<I", answer, at)
        data, again = answer[at + 4 : at + 4 + length], answer[at + 4 + length : at + 4 + length + len(stream.data)]
        at += 4 + length + len(stream.data)
        if again != stream.data:
            raise ExportError(_WHERE, f"{stream.mode} are not the same when decoded again, expected no loss")
        yield data


def lower_levels(face: HasParts) -> tuple[FaceParts, ...]:
    """The face at each lower level, finest first.

    :raises InputError: it has none
    """
    levels = face.lower_levels() if isinstance(face, HasLevels) else ()
    if not levels:
        raise InputError("--lods", "the face has no levels of detail, expected some that `facepipe lod` made")
    return levels


@dataclass(frozen=True, kw_only=True)
class Document:
    """A glTF document that is not yet a file: the buffer and images have no place."""

    json: Json  # images without uri or bufferView, the buffer without uri
    binary: Sequence[Chunk]  # buffer 0 in pieces
    images: Sequence[Image]
    counts: dict[str, int]
    warnings: tuple[str, ...]
    dropped: tuple[str, ...]
    error_mm: float | None
    places: Places
    chosen: tuple[str, ...] = ()  # what was done to it, one line each


class Places(NamedTuple):
    """What the entries of a document are called on the face."""

    meshes: tuple[str, ...]  # of the first nodes
    targets: tuple[tuple[str, ...], ...]  # their morph targets: a shape, or ``<shape>_<inbetween>``
    joints: dict[str, int]  # path -> node
    materials: tuple[str | None, ...]


def write(parts: FaceParts, options: Options, *, levels: Sequence[FaceParts] = (), tangents: bool = True) -> Document:
    """The glTF document of a face.

    :param levels: lower levels of detail of the face, finest first
    :param tangents: with tangents where a material needs them; without, readers make their own
    :raises ExportError: NaN or infinity, counts that don't fit, or skin weights that can't be normalised
    :raises InputError: a shape glob that matches nothing, or an option that the engine can't read
    """
    check_ranges(options)
    check_engine(options)
    for one in (parts, *levels):
        check(one)
    with np.errstate(over="ignore"):  # the buffers refuse infinities
        document = _Writer(parts, options, tangents, levels).document()
    if options.texture_format == "ktx2":
        from facepipe_gltf.ktx2 import with_ktx2

        json_, images, chosen = with_ktx2(document.json, document.images)
        document = replace(document, json=json_, images=images, chosen=chosen)
    if not options.meshopt:
        return document

    # the document with vertices and triangles compressed without loss: everything is decoded again and compared. The
    # extension's mode for triangles would rotate their corners, and change the polygons that readers make of them.
    binary = b"".join(document.binary)
    streams = _streams(document.json, binary)
    compressed = _compressed([*streams.values()])
    views: list[Json] = []
    chunks: list[bytes] = []
    size = whole = 0
    for number, view in enumerate(document.json.get("bufferViews", [])):
        stream, start = streams.get(number), view["byteOffset"]
        data = binary[start : start + view["byteLength"]] if stream is None else next(compressed)
        place: Json = {"buffer": 0, "byteOffset": size, "byteLength": len(data)}
        if stream is not None:
            own = place | {"byteStride": stream.size, "count": stream.elements, "mode": stream.mode}
            place = {"buffer": 1, "byteOffset": whole, "byteLength": len(stream.data), "extensions": {MESHOPT: own}}
            whole += len(stream.data) + -len(stream.data) % _ALIGNMENT
        views.append(view | place)
        chunks += [data, bytes(-len(data) % _ALIGNMENT)]
        size += len(data) + -len(data) % _ALIGNMENT
    # the second buffer is in no file: readers decode into it
    fallback: Json = {"byteLength": whole, "extensions": {MESHOPT: {"fallback": True}}}
    result = document.json | {"bufferViews": views, "buffers": [{"byteLength": size}, fallback]}
    for key in ("extensionsUsed", "extensionsRequired"):
        result[key] = sorted([*result.get(key, []), MESHOPT])
    return dataclasses.replace(document, json=result, binary=chunks) if streams else document


@dataclass
class _Writer:
    parts: FaceParts
    options: Options
    tangents: bool
    levels: Sequence[FaceParts]
    nodes: list[Json] = field(default_factory=list)
    meshes: list[Json] = field(default_factory=list)
    targets: dict[int, Sequence[Sculpt]] = field(default_factory=dict)  # by mesh node
    warnings: list[str] = field(default_factory=list)
    uncolored: list[str] = field(default_factory=list)  # meshes whose display colours are left out
    colored: set[str] = field(default_factory=set)  # meshes whose display colours are in the file
    played: set[str] = field(default_factory=set)  # animations that are in the file
    record: Record | None = None
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_COUNTED, 0))

    def document(self) -> Document:
        parts, options = self.parts, self.options
        if options.fps is not None and options.animations:
            from facepipe.rig.animation import resampled

            resampled_clips = []
            for animation in parts.animations:
                at_frames, off = resampled(parts.skeleton, animation, options.fps, parts.meters_per_unit * 1000)
                resampled_clips.append(at_frames)
                if off:
                    what = f"sampled at {options.fps:g} frames per second: off by at most {off}"
                    self.warnings.append(f"{animation.name}: {what}")
            parts = self.parts = replace(parts, animations=tuple(resampled_clips), frames_per_second=options.fps)
        self.space = space_of(parts)
        self.buffers = Buffers(dense=options.is_dense, apart=bool(options.meshopt))
        self.materials = MaterialWriter(parts.materials, self.tangents, options.reader, options.texture_format)
        shapes = () if options.mode == "skin" else select(list(parts.shapes), options.shapes, "shapes")
        meshes = self._meshes(parts, shapes)
        scene = list(range(len(self.nodes)))
        # lower levels are in no scene: readers without MSFT_lod would show them all at once
        for number, level in enumerate(self.levels, 1):
            nodes = self.nodes
            lower = self._meshes(level, shapes)
            above = {baked.mesh.name: node for baked, node in zip(meshes, nodes, strict=False)}
            first = len(nodes) - len(lower)
            for index, baked in enumerate(lower, first):
                node = above[baked.mesh.name]
                node.setdefault("extensions", {_LODS: {"ids": []}})[_LODS]["ids"].append(index)
                nodes[index]["name"] = f"{node['name']}_lod{number}"
                mesh = self.meshes[nodes[index]["mesh"]]
                mesh["name"] = f"{mesh['name']}_lod{number}"
        joints, skins = self._skin(meshes)
        if joints is not None:
            scene += joints.roots
        animations = []
        if options.animations:
            writer = AnimationWriter(parts.skeleton, self.space, joints, self.targets, self.buffers, self.warnings)
            written_clips = [writer.write(animation) for animation in parts.animations]
            for animation, clip in zip(parts.animations, written_clips, strict=True):
                if clip is None:
                    self.warnings.append(f"{animation.name}: left out, nothing that it moves is in the file")
                else:
                    self.played.add(animation.name)
                    animations.append(clip)
        self.record = record_of(parts, meshes, self.space, options, self.played, self.colored)
        return self._assemble(scene, skins, animations, meshes, shapes)

    def _meshes(self, parts: FaceParts, shapes: Sequence[str]) -> list[Baked]:
        """The meshes of the face or a level that have faces, with a node for each that shows it."""
        meshes = [bake(parts, mesh, shapes, self.space, self.options) for mesh in parts.meshes]
        meshes = [baked for baked in meshes if len(baked.corners.faces)]
        for baked in meshes:
            mesh, sculpts = baked.mesh, baked.sculpts
            writer = PrimitiveWriter(baked, self.options, self.buffers, len(self.parts.skeleton.joints))
            shown = [(triangles, self.materials.surface(name, mesh)) for name, triangles in by_material(baked)]
            colored = [surface.colored for _, surface in shown]
            if mesh.colors is not None and not all(colored) and mesh.name not in self.uncolored:
                self.uncolored.append(mesh.name)
            # all primitives or none: where one has no colours, those of its points are lost, and the record keeps all
            if all(colored):
                self.colored.add(mesh.name)
            primitives = writer.write(shown)
            ours: Json = ({"pointCount": len(mesh.points)} if self.options.restorable else {}) | extras(sculpts)
            if mesh.holds is not None:
                ours["holds"] = mesh.holds.mesh
            if mesh.landmarks and self.options.restorable:
                ours["landmarks"] = {
                    scheme: {"points": np.asarray(landmarks.indices).tolist(), "names": list(landmarks.names)}
                    for scheme, landmarks in mesh.landmarks.items()
                }
            if mesh.anchor is not None and self.options.restorable:
                ours["anchor"] = int(mesh.anchor)
            name = exact(mesh)
            data_name = name if mesh.data_label is None else mesh.data_label
            entry: Json = {"name": data_name, "primitives": primitives, "extras": {"facepipe": ours}}
            if sculpts:
                entry["extras"]["targetNames"] = [sculpt.label for sculpt in sculpts]
                entry["weights"] = [0.0] * len(sculpts)
                self.targets[len(self.nodes)] = sculpts
            node: Json = {"name": name, "mesh": len(self.meshes)}
            if baked.influences is not None:
                node["skin"] = 0
            self.meshes.append(entry)
            self.nodes.append(node)
            vertices = sum(self.buffers.accessors[one["attributes"]["POSITION"]]["count"] for one in primitives)
            counts = (vertices, len(baked.corners.faces), len(primitives), len(sculpts))
            for kind, count in zip(_COUNTED, counts, strict=True):
                self.counts[kind] += count
        return meshes

    def _skin(self, meshes: Sequence[Baked]) -> tuple[JointNodes | None, list[Json]]:
        """The one skin that all skinned meshes share, and its nodes."""
        if not any(mesh.influences is not None for mesh in meshes):
            return None, []
        skeleton = self.parts.skeleton
        joints = joint_nodes(skeleton, self.space, len(self.nodes), person=self.options.pose == "set-joints")
        inverse_binds = self.space.inverse_binds(np.asarray(skeleton.bind_transforms, dtype=np.float64))
        if self.parts.attach_joint is not None:
            joints.nodes[joints.roots[0] - len(self.nodes)]["extras"] = {
                "facepipe": {"attachJoint": self.parts.attach_joint}
            }
        self.nodes += joints.nodes
        self.warnings += joints.warnings
        accessor = self.buffers.add(inverse_binds.astype(np.float32), "matrices")
        return joints, [{"name": skeleton.name, "joints": joints.of_joint, "inverseBindMatrices": accessor}]

    def _extras(self) -> Json | None:
        """The record, which puts a view of its own into the buffers; None: there is none."""
        if self.record is None:
            return None
        entry, block = packed(self.record)
        return {"facepipe": entry | {"bufferView": self.buffers.add_bytes(block)}}

    def _uncolored(self) -> list[str]:
        """A line for meshes whose display colours are left out."""
        named = f"display colours of {listed_meshes(self.uncolored)}: the materials' colours are shown"
        return [named] if self.uncolored else []

    def _assemble(
        self,
        scene: list[int],
        skins: list[Json],
        animations: list[Json],
        meshes: Sequence[Baked],
        shapes: Sequence[str],
    ) -> Document:
        textures = self.materials.textures
        extras = self._extras()  # before the buffers are finished
        views, binary = self.buffers.finish()
        asset = {"version": "2.0", "generator": f"facepipe {__version__}"}
        if self.parts.attribution:
            asset["copyright"] = self.parts.attribution
        required = ["KHR_mesh_quantization"] if self.options.quantize and meshes else []
        required += [WEBP] if textures.webp_used else []
        lists = {
            "nodes": self.nodes,
            "meshes": self.meshes,
            "skins": skins,
            "animations": animations,
            "materials": self.materials.materials,
            "textures": textures.textures,
            "samplers": textures.samplers,
            "images": [{"name": image.name, "mimeType": image.mime} for image in textures.images],
            "accessors": self.buffers.accessors,
            "bufferViews": views,
            "buffers": [{"byteLength": sum(map(len, binary))}] if binary else [],
            "extensionsUsed": sorted([*self.materials.extensions, *required, *([_LODS] if self.levels else [])]),
            "extensionsRequired": required,
        }
        scenes: list[Json] = [{"name": self.parts.name} | ({"nodes": scene} if scene else {})]
        document: Json = {"asset": asset, "scene": 0, "scenes": scenes}
        # the schema knows no empty lists: one item or more, or no key
        document |= {key: value for key, value in lists.items() if value}
        if VARIANTS in self.materials.extensions:
            document["extensions"] = {VARIANTS: {"variants": [{"name": name} for name in self.materials.variants]}}
        if extras is not None:
            document["extras"] = extras
        return Document(
            json=document,
            binary=binary,
            images=textures.images,
            counts=self._counts(skins, animations, shapes),
            warnings=(
                *self.warnings,
                *linear_skinning_notes(self.parts),
                *skin_warnings(meshes, self.options.most_influences),
                *textures.warnings,
                *engine_warnings(self.options.reader, self.nodes, skins),
            ),
            dropped=(
                *dropped(self.parts, meshes, self.options, self.record.face if self.record else None),
                *self._uncolored(),
                *self.materials.dropped,
            ),
            error_mm=self._error_mm(meshes),
            places=self._places(meshes, skins),
        )

    def _places(self, meshes: Sequence[Baked], skins: Sequence[Json]) -> Places:
        return Places(
            meshes=tuple(baked.mesh.name for baked in meshes),
            targets=tuple(tuple(sculpt.name for sculpt in baked.sculpts) for baked in meshes),
            joints=dict(zip(self.parts.skeleton.joints, skins[0]["joints"], strict=True)) if skins else {},
            materials=self.materials.names,
        )

    def _error_mm(self, meshes: Sequence[Baked]) -> float | None:
        """The sum of the errors of `ExportReport.error_mm`, in mm; None for an exact file."""
        options = self.options
        encoding, smallest = Encoding(bool(options.quantize)), options.drop_deltas / 1000
        stored = [storage_error(mesh, encoding, smallest) for mesh in meshes] if options.quantize or smallest else []
        fewer = None
        if any(mesh.influences is not None and mesh.influences.any_lost for mesh in meshes):
            fewer = influence_error(self.parts, meshes, self.space)
        if not stored and fewer is None:
            return None
        error = max(stored, default=0.0) + (fewer or 0.0)
        if options.quantize:  # joints of one point take it a head height apart at most
            heights = np.concatenate([mesh.points[:, 1] for mesh in meshes] or [np.zeros(1)])
            error += max((weight_error(mesh, encoding) for mesh in meshes), default=0.0) * float(np.ptp(heights))
        return error * 1000

    def _counts(self, skins: list[Json], animations: list[Json], shapes: Sequence[str]) -> dict[str, int]:
        return self.counts | {
            "meshes": len(self.meshes),
            "shapes": len(shapes),
            "joints": len(skins[0]["joints"]) if skins else 0,
            "animations": len(animations),
            "materials": len(self.materials.materials),
            "images": len(self.materials.textures.images),
            "sparse accessors": self.buffers.sparse_count,
            **({"levels": 1 + len(self.levels)} if self.levels else {}),
        }
