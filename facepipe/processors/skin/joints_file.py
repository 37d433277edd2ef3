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
from typing import Any

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean, identifier
from facepipe.core.reading import read_json_object

MOST_JOINTS = 1024
_MOST_BYTES = 1 << 24
_UNITS = {"stage": None, "mm": 0.001, "cm": 0.01, "m": 1.0}
_FIELDS = ("position", "rotation", "radius", "regions", "surface")
_LARGEST = 1e9
_LONGEST_PATH = 1000


@dataclass(frozen=True, kw_only=True)
class JointSpec:
    """One joint to be made; what its fields mean is above."""

    path: str
    position: tuple[float, float, float]
    rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    radius: float | None = None
    regions: tuple[str, ...] = ()
    surface: bool | None = None


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
    content = read_json_object(path, _MOST_BYTES)
    unknown = [key for key in content if key not in ("unit", "joints", "parts")]
    if unknown:
        raise InputError(path, f"'{ascii(unknown[0])[1:-1][:60]}' is unknown, expected unit, joints, parts")
    joints, unit = content.get("joints"), content.get("unit", "stage")
    if not isinstance(joints, dict):
        raise InputError(path, 'expected an object {"joints": {"name": {"position": [x, y, z]}}}')
    return JointSet(
        joints=tuple(_joint(f"{path} -> {_shown(name)}", name, one) for name, one in joints.items()),
        parts=_parts(f"{path} -> parts", content.get("parts", {})),
        unit=unit if isinstance(unit, str) else str(unit)[:40],
        where=str(path),
    )


def _shown(name: str) -> str:
    """A name as messages show it, whatever is in it."""
    return ascii(name)[1:-1][:80]


def _joint(where: str, path: str, content: object) -> JointSpec:
    if not isinstance(content, dict) or "position" not in content:
        raise InputError(where, 'expected an object {"position": [x, y, z]}')
    unknown = [key for key in content if key not in _FIELDS]
    if unknown:
        raise InputError(where, f"'{ascii(unknown[0])[1:-1][:60]}' is unknown, expected some of {', '.join(_FIELDS)}")
    position = _numbers(f"{where} -> position", content["position"], 3)
    rotation = _numbers(f"{where} -> rotation", content.get("rotation", [0, 0, 0, 1]), 4)
    if math.hypot(*rotation) < 1e-6:
        raise InputError(f"{where} -> rotation", "of length 0, expected a unit quaternion x y z w")
    radius = content.get("radius")
    if radius is not None and _numbers(f"{where} -> radius", [radius], 1)[0] <= 0:
        raise InputError(f"{where} -> radius", f"{radius}, expected a length above 0")
    regions = content.get("regions", [])
    if not isinstance(regions, list) or not all(isinstance(region, str) for region in regions):
        raise InputError(f"{where} -> regions", "expected a list of region names")
    surface = content.get("surface")
    if surface is not None and not isinstance(surface, bool):
        raise InputError(f"{where} -> surface", f"{str(surface)[:40]}, expected true or false")
    return JointSpec(
        path=path,
        position=(position[0], position[1], position[2]),
        rotation=(rotation[0], rotation[1], rotation[2], rotation[3]),
        radius=None if radius is None else float(radius),
        regions=tuple(regions),
        surface=surface,
    )


def _numbers(where: str, values: Any, count: int) -> tuple[float, ...]:
    good = isinstance(values, list) and len(values) == count
    if not good or not all(type(value) in (int, float) and abs(value) <= _LARGEST for value in values):
        raise InputError(where, f"{str(values)[:60]}, expected {count} finite numbers")  # NaN fails the comparison
    return tuple(float(value) for value in values)


def _parts(where: str, content: object) -> dict[str, tuple[str, str]]:
    if not isinstance(content, dict):
        raise InputError(where, "expected an object of mesh names and joints")
    parts: dict[str, tuple[str, str]] = {}
    for glob, value in content.items():
        if isinstance(value, str):
            parts[glob] = (value, value)
        elif isinstance(value, dict) and sorted(value) == ["lower", "upper"]:
            parts[glob] = (str(value["upper"]), str(value["lower"]))
        else:
            raise InputError(f"{where} -> {_shown(glob)}", 'expected a joint, or {"upper": joint, "lower": joint}')
    return parts
