"""Joints to skin a face with, from a JSON file.

    {
      "unit": "mm",
      "joints": {
        "head": {"position": [0, 60, 20]},
        "head/jaw": {"position": [0, 0, 20], "surface": false},
        "head/jaw/chin": {"position": [0, -72, 100], "regions": ["mouth_lower"]},
        "head/jaw/lip": {"position": [0, -32, 98], "radius": 30},
        "head/eyeLeft": {"position": [32, 30, 65], "rotation": [0, 0, 0, 1]}
      },
      "parts": {"EyeLeft": "head/eyeLeft", "Teeth*": {"upper": "head", "lower": "head/jaw"}}
    }

Names are paths, parents anywhere in the file. A joint has, beside its position in the world:

- ``rotation``: quaternion x y z w relative to its parent's axes; without it the axes are the parent's.
- ``radius``: no weight further from it, along the surface.
- ``regions``: weight in these only: regions of the face, or a side of its mouth or eyes (``mouth_upper``,
  ``mouth_lower``, ``eye_left_upper``, ``eye_left_lower``, ``eye_right_upper``, ``eye_right_lower``).
- ``surface``: whether it moves the face itself: false for pivots deep inside. Without it: yes, unless it is in an
  eyeball and has no regions. An eyeball goes with the joint nearest to its centre, one that does not move the face
  before others.

``parts`` gives loose parts whole to a joint, by mesh names or globs; ``upper`` and ``lower`` part them by the mouth.
``unit`` of positions and radii is ``stage`` (the face's own), ``mm``, ``cm`` or ``m``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean, identifier
from facepipe.core.reading import read_json_object
from facepipe.declare import from_json

MOST_JOINTS = 1024
_MOST_BYTES = 1 << 24
_UNITS = {"stage": None, "mm": 0.001, "cm": 0.01, "m": 1.0}
_LENGTHS = {"low": -1e9, "high": 1e9}
_LONGEST_PATH = 1000


@dataclass(frozen=True, kw_only=True)
class PlacedJoint:
    """A joint but for its path; what its fields mean is above.

    :raises InputError: a rotation of length 0, or a radius that is not above 0
    """

    position: tuple[float, float, float] = field(metadata=_LENGTHS)
    rotation: tuple[float, float, float, float] = field(default=(0.0, 0.0, 0.0, 1.0), metadata=_LENGTHS)
    radius: float | None = field(default=None, metadata=_LENGTHS)
    regions: tuple[str, ...] = ()
    surface: bool | None = None

    def __post_init__(self) -> None:
        if math.hypot(*self.rotation) < 1e-6:
            raise InputError("rotation", "of length 0, expected a unit quaternion x y z w")
        if self.radius is not None and self.radius <= 0:
            raise InputError("radius", f"{self.radius}, expected a length above 0")


@dataclass(frozen=True, kw_only=True)
class JointSpec(PlacedJoint):
    """One joint to be made."""

    path: str


@dataclass(frozen=True, kw_only=True)
class _Halves:
    upper: str
    lower: str


@dataclass(frozen=True, kw_only=True)
class _JointsFile:
    joints: Mapping[str, PlacedJoint]
    parts: Mapping[str, str | _Halves] = field(default_factory=dict)
    unit: Literal["stage", "mm", "cm", "m"] = "stage"


@dataclass(frozen=True, kw_only=True)
class JointSet:
    """The joints of a face, parents first.

    :raises InputError: no joints, one twice or without its parent, or parts given to a joint that is not there
    """

    joints: tuple[JointSpec, ...]
    parts: Mapping[str, tuple[str, str]] = field(default_factory=dict)  # mesh glob -> joint above and below the mouth
    unit: str = "stage"
    where: str = "joints"  # for messages

    def __post_init__(self) -> None:
        paths = [joint.path for joint in self.joints]
        if not 1 <= len(paths) <= MOST_JOINTS:
            raise InputError(self.where, f"{len(paths)} joints, expected 1 to {MOST_JOINTS}")
        if self.unit not in _UNITS:
            raise InputError(f"{self.where} -> unit", f"'{self.unit[:40]}', expected one of {', '.join(_UNITS)}")
        known = set(paths)
        for number, path in enumerate(paths):
            self._check_path(path, known, twice=path in paths[:number])
        for glob, names in self.parts.items():
            for name in names:
                if name not in known:
                    trail = f"{self.where} -> parts -> {_shown(glob)}"
                    near = did_you_mean(name, paths) or ", expected one of the file"
                    raise InputError(trail, f"no joint '{_shown(name)}'{near}")
        order = sorted(self.joints, key=lambda joint: joint.path.count("/"))
        object.__setattr__(self, "joints", tuple(order))

    def _check_path(self, path: str, paths: set[str], *, twice: bool) -> None:
        where = f"{self.where} -> {_shown(path)}"
        if twice:
            raise InputError(where, "twice, expected each joint once")
        if len(path) > _LONGEST_PATH or any(identifier(part) != part for part in path.split("/")):
            raise InputError(where, "expected names of ASCII letters, digits and underscores, joined by /")
        parent = path.rpartition("/")[0]
        if parent and parent not in paths:
            raise InputError(where, f"no parent '{parent[:80]}', expected it among the joints")

    def scale(self, meters_per_unit: float) -> float:
        """Stage units in one unit of the file."""
        meters = _UNITS[self.unit]
        return 1.0 if meters is None else meters / meters_per_unit


def read_joints(path: Path) -> JointSet:
    """The joints of a JSON file.

    :raises InputError: not such JSON
    """
    file = from_json(_JointsFile, read_json_object(path, _MOST_BYTES), str(path))
    parts = {
        glob: part if isinstance(part, _Halves) else _Halves(upper=part, lower=part)
        for glob, part in file.parts.items()
    }
    return JointSet(
        joints=tuple(JointSpec(path=name, **vars(joint)) for name, joint in file.joints.items()),
        parts={glob: (part.upper, part.lower) for glob, part in parts.items()},
        unit=file.unit,
        where=str(path),
    )


def _shown(name: str) -> str:
    """A name as messages show it, whatever is in it."""
    return ascii(name)[1:-1][:80]
