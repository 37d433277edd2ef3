"""Which objects of a scene make a face, and the record of an imported one.

Blender has no place for all of a face: a text block of the .blend file holds it as imported, with only the names of
materials; readable lines, and as a property the whole face. The objects of the face point to it.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FacepipeError, InputError, SchemaError
from facepipe.core.names import identifier
from facepipe.hosting.host_face import Field, arrays_from_bytes, face_from_bytes, face_to_bytes
from facepipe.parts import FaceParts

RECORD = "facepipe_record"  # property of objects: the text block
MESH = "facepipe_mesh"  # property of mesh objects: the name of their mesh in the face
_CONTENT = "facepipe_content"  # property of the text block
_ARRAYS = {
    "face": Field("int", ("face bytes",)),
    "header": Field("int", ("header bytes",)),
    "bones": Field("float", ("joints", 4, 4)),
    "places": Field("float", ("meshes", 4, 4)),
}


@dataclass(frozen=True, kw_only=True)
class Kept:
    """The face as it was imported, and how Blender showed it then."""

    parts: FaceParts
    bones: dict[str, FloatArray]  # joint -> (4, 4) in armature space
    places: dict[str, FloatArray]  # mesh -> (4, 4) mesh object relative to the armature, or to the first mesh
    file: str = ""  # that it came from
    neural_rig: tuple[str, ...] = ()  # its link: file, digest, topology


def record_of(obj: Any) -> Any:
    """The text block that an object points to; None where there is none."""
    text = obj.get(RECORD)
    return text if getattr(text, "id_type", "") == "TEXT" else None


def keep(kept: Kept, text: Any) -> None:
    """Write a record into a text block."""
    buffer = io.BytesIO()
    header = {"file": kept.file, "neural_rig": kept.neural_rig, "bones": [*kept.bones], "places": [*kept.places]}
    np.savez_compressed(
        buffer,
        face=np.frombuffer(face_to_bytes(kept.parts), dtype=np.uint8),
        header=np.frombuffer(json.dumps(header).encode(), dtype=np.uint8),
        bones=np.array([*kept.bones.values()]).reshape(-1, 4, 4),
        places=np.array([*kept.places.values()]).reshape(-1, 4, 4),
    )
    text.pop(_CONTENT, None)  # Blender writes bytes over others of another length wrongly
    text[_CONTENT] = buffer.getvalue()
    text.use_fake_user = True
    parts = kept.parts
    lines = [
        f"facepipe: what is kept of the face {parts.name}. Without this block an export holds only what Blender shows.",
        f"file: {kept.file}",
        f"{len(parts.meshes)} meshes, {len(parts.shapes)} shapes, {len(parts.skeleton.joints)} joints, "
        f"{len(parts.sliders)} sliders, {len(parts.animations)} animations",
    ]
    text.from_string("\n".join(lines))


def kept_in(text: Any) -> Kept:
    """The record in a text block.

    :raises SchemaError: a text block that holds none, or a damaged one
    """
    try:
        arrays = arrays_from_bytes(memoryview(text[_CONTENT]).tobytes(), _ARRAYS)
        header = json.loads(arrays["header"].tobytes())
        names = [*header["bones"], *header["places"], header["file"], *header["neural_rig"]]
        if not all(isinstance(name, str) for name in names):
            raise TypeError
        return Kept(
            parts=face_from_bytes(arrays["face"].tobytes()),
            bones=dict(zip(header["bones"], arrays["bones"], strict=True)),
            places=dict(zip(header["places"], arrays["places"], strict=True)),
            file=header["file"],
            neural_rig=tuple(header["neural_rig"]),
        )
    except (KeyError, ValueError, TypeError, RecursionError, FacepipeError):  # the .blend may be of others
        raise SchemaError(text.name, "holds no face, expected the text block of an imported face") from None


@dataclass(frozen=True, kw_only=True)
class FaceObjects:
    """An armature, or None, and the meshes that it moves."""

    armature: Any
    meshes: tuple[Any, ...]

    @property
    def first(self) -> Any:
        """The object whose place is that of the face."""
        return self.meshes[0] if self.armature is None else self.armature

    @property
    def record(self) -> Any:
        """The text block with the record of an imported face; None for a face made in Blender."""
        found = [record_of(obj) for obj in (self.armature, *self.meshes) if obj is not None]
        return next((one for one in found if one is not None), None)

    @property
    def name(self) -> str:
        """What the face is called: as when it was imported, else as its first object.

        :raises SchemaError: a damaged record of the imported face
        """
        return kept_in(self.record).parts.name if self.record is not None else identifier(self.first.name, "Face")

    @property
    def is_face(self) -> bool:
        """Whether it was a face when imported, or has shape keys."""
        return self.record is not None or any(
            keys is not None and len(keys.key_blocks) > 1 for keys in (mesh.data.shape_keys for mesh in self.meshes)
        )


def armature_of(mesh: Any) -> Any:
    """The armature that moves a mesh object; else the one that is its parent, since parts without skin go along too."""
    moving = (one.object for one in mesh.modifiers if one.type == "ARMATURE")
    parent = mesh.parent if mesh.parent is not None and mesh.parent.type == "ARMATURE" else None
    return next((one for one in moving if one is not None), parent)


def faces_among(objects: Iterable[Any]) -> tuple[FaceObjects, ...]:
    """The faces that some objects make, in the order of their names."""
    objects = sorted(objects, key=lambda one: str(one.name))
    kept = {record: obj for obj in reversed(objects) if obj.type == "ARMATURE" and (record := record_of(obj))}
    groups: dict[Any, list[Any]] = {}
    for obj in objects:
        if obj.type == "MESH":
            record = record_of(obj)
            armature = armature_of(obj) or kept.get(record)
            groups.setdefault((armature, record if armature is None else None), []).append(obj)
    faces = []
    for (armature, record), meshes in groups.items():
        for of_face in [meshes] if armature is not None or record is not None else [[mesh] for mesh in meshes]:
            faces.append(FaceObjects(armature=armature, meshes=tuple(of_face)))
    return tuple(face for face in faces if face.is_face)


def face_of(obj: Any, objects: Iterable[Any]) -> FaceObjects:
    """The face that an object belongs to.

    :param obj: what the user has chosen; None for nothing
    :param objects: those of the scene
    :raises InputError: no object, or one of no face
    """
    if obj is None:
        raise InputError("facepipe", "no object is active, expected the armature or a mesh of a face")
    faces = faces_among(objects)
    for face in faces:
        if obj in (face.armature, *face.meshes):
            return face
    below = []  # faces under an empty that the user took for the whole: meant where there is one alone
    for face in faces:
        above = face.first.parent
        while above is not None and above != obj:
            above = above.parent
        below += [face] if above is not None else []
    if len(below) == 1:
        return below[0]
    if obj.type == "MESH":
        raise InputError(obj.name, "a mesh without armature and shape keys, expected a face with shape keys")
    raise InputError(obj.name, "is of no face, expected an armature with a mesh that has shape keys, or such a mesh")
