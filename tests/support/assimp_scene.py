"""What assimp 5 holds of a glTF file, read from its C structures. usage: assimp_scene.py FILE OUT.npz

A process of its own: a reader that runs past its buffers takes no test along. The arrays are `nodes`, `parents` and
`local` of the node tree, and, for each mesh by its number, `2 node`, `2 positions`, `2 names` and `2 targets`
(positions, not offsets), `2 bones`, `2 weights` (vertices, bones) and `2 binds` (inverse).
"""

from __future__ import annotations

import ctypes
import ctypes.util
import sys
from ctypes import POINTER, Structure, c_char, c_float, c_uint, c_void_p
from typing import Any

import numpy as np


class _String(Structure):
    _fields_ = (("length", ctypes.c_uint32), ("data", c_char * 1024))


class _Node(Structure):
    pass


_Node._fields_ = (
    *(("name", _String), ("transformation", c_float * 16), ("parent", POINTER(_Node)), ("child_count", c_uint)),
    *(("children", POINTER(POINTER(_Node))), ("mesh_count", c_uint), ("meshes", POINTER(c_uint)), ("data", c_void_p)),
)


class _Weight(Structure):
    _fields_ = (("vertex", c_uint), ("weight", c_float))


class _Bone(Structure):
    _fields_ = (
        *(("name", _String), ("count", c_uint), ("armature", c_void_p), ("node", c_void_p)),
        *(("weights", POINTER(_Weight)), ("offset", c_float * 16)),
    )


_VECTORS = tuple((name, POINTER(c_float)) for name in ("vertices", "normals", "tangents", "bitangents"))
_SETS = (("colors", c_void_p * 8), ("uvs", c_void_p * 8))


class _AnimMesh(Structure):
    _fields_ = (("name", _String), *_VECTORS, *_SETS, ("vertex_count", c_uint), ("weight", c_float))


class _Mesh(Structure):
    _fields_ = (
        *(("kinds", c_uint), ("vertex_count", c_uint), ("face_count", c_uint), *_VECTORS, *_SETS),
        *(("uv_components", c_uint * 8), ("faces", c_void_p), ("bone_count", c_uint)),
        *(("bones", POINTER(POINTER(_Bone))), ("material", c_uint), ("name", _String), ("target_count", c_uint)),
        ("targets", POINTER(POINTER(_AnimMesh))),
    )


class _Scene(Structure):
    _fields_ = (
        *(("flags", c_uint), ("root", POINTER(_Node)), ("mesh_count", c_uint)),
        ("meshes", POINTER(POINTER(_Mesh))),
    )


def library() -> Any:
    """The shared library, None where it is not there."""
    path = ctypes.util.find_library("assimp")
    if path is None:
        return None
    found = ctypes.CDLL(path)
    found.aiImportFile.restype = POINTER(_Scene)
    found.aiImportFile.argtypes = (ctypes.c_char_p, c_uint)
    found.aiGetErrorString.restype = ctypes.c_char_p
    return found


def read(path: str) -> dict[str, Any]:
    """A file as assimp reads it, without any post-processing."""
    assimp = library()
    scene = assimp.aiImportFile(path.encode(), 0)
    if not scene:
        sys.exit(f"{path}: {assimp.aiGetErrorString().decode()}")
    found: dict[str, Any] = {}
    nodes = _visit(scene.contents.root)
    found["nodes"] = [_text(node.name) for node, _ in nodes]
    found["parents"] = [parent for _, parent in nodes]
    found["local"] = [_matrix(node.transformation) for node, _ in nodes]
    shown = [(node, node.meshes[i]) for node, _ in nodes for i in range(node.mesh_count)]
    for j, (node, number) in enumerate(shown):
        found[f"{j} node"] = _text(node.name)
        found |= {f"{j} {key}": value for key, value in _held(scene.contents.meshes[number].contents).items()}
    return found


def _visit(root: Any) -> list[tuple[Any, int]]:
    """All nodes with the numbers of their parents, parents first."""
    found = [(root.contents, -1)]
    for own, (node, _) in enumerate(found):  # it grows
        found += [(node.children[i].contents, own) for i in range(node.child_count)]
    return found


def _held(mesh: _Mesh) -> dict[str, Any]:
    count = mesh.vertex_count
    targets = [mesh.targets[i].contents for i in range(mesh.target_count)]
    bones = [mesh.bones[i].contents for i in range(mesh.bone_count)]
    weights = np.zeros((count, len(bones)))
    for column, bone in enumerate(bones):
        for i in range(bone.count):
            weights[bone.weights[i].vertex, column] += bone.weights[i].weight
    return {
        "positions": _array(mesh.vertices, count),
        "names": [_text(target.name) for target in targets],
        "targets": [_array(target.vertices, count) for target in targets],
        "bones": [_text(one.name) for one in bones],
        "weights": weights,
        "binds": [_matrix(one.offset) for one in bones],
    }


def _array(pointer: Any, count: int) -> np.ndarray:
    return np.ctypeslib.as_array(pointer, (count, 3))


def _matrix(numbers: Any) -> np.ndarray:
    return np.array(numbers).reshape(4, 4)


def _text(string: _String) -> str:
    return string.data.decode()


if __name__ == "__main__":
    np.savez(sys.argv[2], **read(sys.argv[1]))
