"""The record in a glTF file from which an import restores the face exactly.

The record is a `FaceParts` whose large arrays are empty where the file holds them in accessors, with the matrices that
took each mesh to glTF space. ``extras.facepipe`` of the document names the buffer view that it is in.
"""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.parts import FaceParts, Mesh
from facepipe.records import ArrayReader, ArrayWriter, Json, from_json, to_json

VERSION = 1
_SHOWN = ("scenes", "nodes", "meshes", "skins", "animations", "materials", "textures", "samplers")
_VARIANTS = "KHR_materials_variants"  # their names, which meshes refer to
_WHOLE = 2**53
# Of deflating: half the time of the default, for a sixth more of a block that is a hundredth of its file.
_LEVEL = 3
_FLAT = 1e-30  # of a determinant
NONE: Any = np.zeros(0)  # stands for an array that the file holds, of any kind
PER_POINT = np.zeros((0, 3))  # normals one a point; those of face corners are `NONE`


@dataclass(frozen=True, kw_only=True)
class MeshRecord:
    """What restores a mesh of the file to its mesh on the stage."""

    point_count: int
    matrix: FloatArray  # (4, 4) mesh space -> glTF space
    mirrored: bool = False  # its triangles are turned round in the file
    steps: FloatArray | None = None  # (n, 3) int8: float32 steps from points as read to those of the stage
    loose_points: IntArray | None = None  # (k,) ascending: numbers of points that no face uses
    loose_positions: FloatArray | None = None  # (k, 3)


@dataclass(frozen=True, kw_only=True)
class Record:
    """A face without the data that its file holds elsewhere."""

    face: FaceParts  # its animations name neither joints nor shapes
    meshes: tuple[MeshRecord, ...]  # parallel to the face's
    joints: tuple[IntArray, ...] = ()  # of each animation, numbers of the skeleton's joints
    shapes: tuple[IntArray, ...] = ()  # of each animation, numbers among the names of the face's shapes
    axes: FloatArray  # (4, 4): a joint's local matrix L is ``axes L inverse(axes)`` in the file
    placement: FloatArray  # (4, 4): and a root's has it in front


def content_digest(document: Json) -> str:
    """A digest of a document's content and names, however its JSON is formatted: other data, other digest.

    Accessors, buffers and images are not in it.
    """
    shown = {kind: _floats(document.get(kind)) for kind in _SHOWN}
    extensions = document.get("extensions")
    if isinstance(extensions, dict) and _VARIANTS in extensions:
        shown[_VARIANTS] = _floats(extensions[_VARIANTS])
    return hashlib.sha256(json.dumps(shown, sort_keys=True).encode()).hexdigest()


def _floats(value: object) -> object:
    """`value` with whole numbers as floats: JSON makes no difference."""
    if isinstance(value, dict):
        return {key: _floats(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_floats(inner) for inner in value]
    return float(value) if isinstance(value, int) and not isinstance(value, bool) and abs(value) < _WHOLE else value


def packed(record: Record) -> tuple[Json, bytes]:
    """The entry for a document's extras, and the record as one deflated block: the length of its JSON, JSON, arrays."""
    arrays = ArrayWriter()
    text = json.dumps(to_json(record, arrays), separators=(",", ":"), allow_nan=False).encode()
    block = struct.pack("<I", len(text)) + text + arrays.finish()
    return {"version": VERSION, "inflated": len(block)}, zlib.compress(block, _LEVEL)


def unpacked(data: bytes, inflated: int, where: str) -> Record:
    """The record in a deflated block.

    :param inflated: bytes of it that count, all there is
    :raises InputError: damaged, or none of ours
    """
    inflater = zlib.decompressobj()
    try:
        # one byte past the stated size tells that it is wrong: unbounded, a small block may inflate to all memory
        block = inflater.decompress(data, inflated + 1)
        (length,) = struct.unpack_from("<I", block)
        fields = json.loads(block[4 : 4 + length])
    except (zlib.error, struct.error, ValueError, RecursionError):
        raise InputError(where, "damaged, expected what facepipe wrote") from None
    if len(block) != inflated or not inflater.eof:
        raise InputError(where, f"{len(block)} bytes, expected {inflated}")
    record = from_json(Record, fields, ArrayReader(block[4 + length :]), where)
    for matrix in (record.axes, record.placement, *(mesh.matrix for mesh in record.meshes)):
        if np.shape(matrix) != (4, 4) or not np.isfinite(matrix).all() or not abs(np.linalg.det(matrix)) > _FLAT:
            raise InputError(where, "a matrix that can't be inverted")
    return record


def points_back(matrix: FloatArray, points: FloatArray) -> FloatArray:
    """(n, 3) float32 points of a file in mesh space: one sum a coordinate, so that every machine gets the same bits."""
    back = np.linalg.inv(matrix)
    x, y, z = np.asarray(points, np.float64).T
    columns = [back[i, 0] * x + back[i, 1] * y + back[i, 2] * z + back[i, 3] for i in range(3)]
    return np.stack(columns, axis=1).astype(np.float32)


def steps_between(found: FloatArray, wanted: FloatArray) -> FloatArray | None:
    """(n, 3) int8 float32 steps from one array to the other; None where they are further apart."""
    steps = _ordered(wanted) - _ordered(found)
    if np.abs(steps).max(initial=0) > 127:
        return None
    return np.asarray(steps.astype(np.int8))


def stepped(values: FloatArray, steps: FloatArray) -> FloatArray:
    """float32 `values` moved by as many float32 steps."""
    ordered = _ordered(values) + np.asarray(steps, np.int64)
    bits = np.where(ordered < 0, -ordered | 0x80000000, ordered).astype(np.uint32)
    return np.asarray(bits.view(np.float32).reshape(np.shape(values)))


def _ordered(values: FloatArray) -> IntArray:
    """Integers in the order of float32 values, neighbours one apart; both zeros are 0."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32).astype(np.int64)
    ordered: IntArray = np.where(bits >= 0x80000000, 0x80000000 - bits, bits)
    return ordered


def image_digest(data: bytes) -> bytes:
    """What stands in the record for an image that the file holds."""
    return hashlib.sha256(data).digest()


def shape_names(meshes: Sequence[Mesh]) -> list[str]:
    """Names of the shapes of all meshes, in their order."""
    return list(dict.fromkeys(shape.name for mesh in meshes for shape in mesh.blendshapes))


def material_groups(mesh: Mesh) -> tuple[list[str | None], IntArray]:
    """Materials of a mesh, its own first, and the number (faces,) among them that each face shows."""
    names = list(dict.fromkeys([mesh.material, *(material_face.material for material_face in mesh.material_faces)]))
    number = np.zeros(len(mesh.face_vertex_counts), np.int64)
    for shown in mesh.material_faces:
        faces = np.asarray(shown.faces, dtype=np.int64)
        if faces.size and not (faces.min() >= 0 and faces.max() < len(number)):
            raise InputError(f"{mesh.name} -> {shown.material}", f"faces outside 0..{len(number) - 1}")
        number[faces] = names.index(shown.material)
    return names, number
