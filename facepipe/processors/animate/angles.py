"""The angles that a performance has of head and eyes, by name."""

from __future__ import annotations

from collections.abc import Mapping

from facepipe.rig.conventions import shape_key

PARTS = ("Head", "LeftEye", "RightEye")
ANGLES: Mapping[str, str] = {  # key -> name
    shape_key(part + angle): part + angle for part in PARTS for angle in ("Yaw", "Pitch", "Roll")
}


def angle_of(name: str) -> str | None:
    """The name of `ANGLES` that a column's name means, in any spelling; None for all others."""
    return ANGLES.get(shape_key(name))
