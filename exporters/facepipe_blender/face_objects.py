"""Which objects of a scene make a face."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from facepipe.core.errors import InputError
from facepipe.core.names import identifier

from .record import kept_in, record_of


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
        return self.record is not None or any(_has_shapes(mesh) for mesh in self.meshes)


def faces_among(objects: Iterable[Any]) -> tuple[FaceObjects, ...]:
    """The faces that some objects make, in the order of their names."""
    objects = sorted(objects, key=lambda one: str(one.name))
    kept = {record: obj for obj in reversed(objects) if obj.type == "ARMATURE" and (record := record_of(obj))}
    groups: dict[Any, list[Any]] = {}
    for obj in objects:
        if obj.type == "MESH":
            record = record_of(obj)
            armature = armature_of(obj) or kept.get(record)  # meshes without skin belong to their face too
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
    below = [face for face in faces if obj in _ancestors(face.first)]
    if len(below) == 1:
        return below[0]
    if obj.type == "MESH":
        raise InputError(obj.name, "a mesh without armature and shape keys, expected a face with shape keys")
    raise InputError(obj.name, "is of no face, expected an armature with a mesh that has shape keys, or such a mesh")


def armature_of(obj: Any) -> Any:
    """The armature that moves a mesh object; None where there is none."""
    for modifier in obj.modifiers:
        if modifier.type == "ARMATURE" and modifier.object is not None:
            return modifier.object
    parent = obj.parent
    return parent if parent is not None and parent.type == "ARMATURE" else None


def _has_shapes(obj: Any) -> bool:
    keys = obj.data.shape_keys
    return keys is not None and len(keys.key_blocks) > 1


def _ancestors(obj: Any) -> list[Any]:
    above = []
    while obj.parent is not None:
        obj = obj.parent
        above.append(obj)
    return above
