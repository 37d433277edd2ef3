"""The record of an imported face in a .blend file, since Blender has no place for all of it.

A text block holds it: readable lines, and as a property the whole face as imported, with only the names of materials.
The objects of the face point to it.
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FacepipeError, SchemaError
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
    text.from_string("\n".join(_lines(kept)))


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


def _lines(kept: Kept) -> list[str]:
    parts = kept.parts
    return [
        f"facepipe: what is kept of the face {parts.name}. Without this block an export holds only what Blender shows.",
        f"file: {kept.file}",
        f"{len(parts.meshes)} meshes, {len(parts.shapes)} shapes, {len(parts.skeleton.joints)} joints, "
        f"{len(parts.sliders)} sliders, {len(parts.animations)} animations",
    ]
