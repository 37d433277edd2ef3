"""Plausible sizes and stances of a face: those that no head has give away wrong units and axes of a source."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import FaceParts
from facepipe.rig.rig import build

HEAD_MM = (150.0, 400.0)  # plausible heights of a head

_SCHEME, _COUNT = "multipie68", 68
_EAR_ENDS, _CHIN, _BRIDGE, _NOSE_TIP, _OUTER_CORNERS, _EYES = (0, 16), 8, 27, 30, (36, 45), slice(36, 48)
_BRIDGES, _CORNERS = 2.5, 3.0  # a head in heights from chin to bridge of the nose, in distances of the eyes' corners
_ROOM = 1.25  # since proportions differ, of stylised faces above all
_SPINE = 0.35  # height of a head above its joint, in distances from hips to head: 0.3 of grown people, 0.5 of children
_BODY_ROOM = 1.4  # as `_ROOM`, for children and figures with large heads
_LONGEST = 3.0  # metres that a body is long
_BODY_DEPTH = 0.05  # of its height, at least
_HEAD_PROPORTION = 1 / 3  # shortest side of a bounding box by the longest
_UPRIGHT_COSINE = 0.7  # cosine: eyes above the chin, and nose before the ears, within 45 degrees
# Units of files that say none, tried in this order: a body of decimetres would be a plausible one of centimetres too.
_METRES = (1.0, 0.1, 0.01, 0.001, 0.0254)
_AXES = {"Y": ("+Y", "+Z"), "Z": ("+Z", "-Y")}  # up and forward of a stage


def implausible(parts: FaceParts) -> tuple[str, ...]:
    """One line for each property that no real head has, with what fixes it.

    Landmarks (`multipie68`) measure the head, with a body or without: it is too small or too large where both 2.5
    times the height from chin to bridge of the nose and 3 times the distance of the outer corners of the eyes are.
    Without landmarks an avatar, which has joints of a head and of hips, is measured from the head's joint to the top,
    and stands along the line from hips to head. Else the height of the bounding box counts, where that has the
    proportions of a head; with those of a body, that it is no longer than `_LONGEST`. Up and front are known from
    landmarks or joints alone.
    """
    rig = build(replace(parts, meshes=tuple(replace(mesh, blendshapes=()) for mesh in parts.meshes)))  # as it rests
    points = rig.evaluate()
    by_mesh, unit = rig.split(points), parts.meters_per_unit
    found = [(mesh.landmarks[_SCHEME].indices, mesh.name) for mesh in parts.meshes if _SCHEME in mesh.landmarks]
    marks = next((by_mesh[name][indices] for indices, name in found if len(indices) == _COUNT), None)
    if marks is None:
        from facepipe.rig.joint_names import human_joint  # with tables of names that a face with landmarks needs not

        head, hips = human_joint(parts, "Head"), human_joint(parts, "Hips")
        if head is not None and hips is not None and len(points):
            places = rig.joint_worlds(rig.rest)[:, :3, 3]
            return _avatar(places[head], places[hips], points, unit, parts.up_axis)
        sides = np.ptp(points, axis=0) if len(points) else np.zeros(3)
        # a body, or a part of a face: its height says nothing of the head
        if sides.min() < _HEAD_PROPORTION * sides.max():
            most = unit * float(sides.max())
            long = f"the model is {most:.3g} m long, expected a head, or a body of at most {_LONGEST:g} m"
            fix = f"`facepipe import` with --meters-per-unit {unit * 10.0 ** -np.ceil(np.log10(most / 2.5)):.6g}"
            return (
                (f"{long}; {fix} fixes a wrong unit",)
                if most > _LONGEST and sides.min() > _BODY_DEPTH * sides.max()
                else ()
            )
        return _size(1000.0 * unit * sides[["XYZ".index(parts.up_axis)]], unit, "high", 1.0)
    heights = np.array([_BRIDGES * _between(marks, _CHIN, _BRIDGE), _CORNERS * _between(marks, *_OUTER_CORNERS)])
    return (*_size(1000.0 * unit * heights, unit, "high by its landmarks", _ROOM), *_stance(marks, parts.up_axis))


def in_usual_unit(parts: FaceParts) -> FaceParts:
    """The face in the first usual unit that gives it a plausible size; as it is where none does."""
    tried = (replace(parts, meters_per_unit=metres) for metres in _METRES)
    return next((one for one in tried if not implausible(one)), parts)


def _avatar(head: FloatArray, hips: FloatArray, points: FloatArray, unit: float, up_axis: str) -> tuple[str, ...]:
    """Lines on a body's size and stance.

    :param head: (3,) where its joint is; `hips` too
    """
    spine = head - hips
    length = float(np.linalg.norm(spine))
    if not length > 0:
        return ()
    skull = float(((points - head) @ spine).max(initial=0.0)) / length
    # two measures, as hair and hats rise over a skull and the joints of some heads lie in the neck
    measures = np.array([skull, _SPINE * length])
    lines = _size(1000.0 * unit * measures, unit, "high above its joint", _BODY_ROOM)
    if _along(spine, _AXES[up_axis][0]) >= _UPRIGHT_COSINE:
        return lines
    nearest = _nearest(spine)
    fix = f"`facepipe import` with --up-axis {nearest[1]}" if nearest in ("+Y", "+Z") else "turning its source"
    what = f"the body doesn't stand upright: its head lies {nearest} of the hips, expected {_AXES[up_axis][0]}"
    return (*lines, f"{what}; {fix} fixes it")


def _between(marks: FloatArray, first: int, other: int) -> float:
    return float(np.linalg.norm(marks[first] - marks[other]))


def _size(heights: FloatArray, meters_per_unit: float, how: str, room: float) -> tuple[str, ...]:
    """
    :param heights: of the head in millimetres, as different measures have it
    :param room: factor by which a measure may be off
    """
    low, high = HEAD_MM
    if not ((heights * room < low).all() or (heights > high * room).all()) or not (heights > 0).all():
        return ()
    height = float(heights[0])
    power = 10.0 ** np.round(np.log10(np.sqrt(low * high) / height))
    unit = f" {meters_per_unit * power:.6g}" if low <= height * power <= high else ""
    length = f"{height:.3g} mm" if height < 1000.0 else f"{height / 1000.0:.3g} m"
    what = f"the head is {length} {how}, expected {low:g} to {high:g} mm"
    return (f"{what}; `facepipe import` with --meters-per-unit{unit} fixes a wrong unit",)


def _stance(marks: FloatArray, up_axis: str) -> tuple[str, ...]:
    up, front = _AXES[up_axis]
    eyes, ears = marks[_EYES].mean(axis=0), marks[list(_EAR_ENDS)].mean(axis=0)
    own_up, own_front = eyes - marks[_CHIN], marks[_NOSE_TIP] - ears
    if _along(own_up, up) < _UPRIGHT_COSINE:
        nearest = _nearest(own_up)
        fix = f"`facepipe import` with --up-axis {nearest[1]}" if nearest in ("+Y", "+Z") else "turning its source"
        return (f"the face doesn't stand upright: its eyes lie {nearest} of the chin, expected {up}; {fix} fixes it",)
    if _along(own_front, front) < _UPRIGHT_COSINE - 0.2:  # the nose lies below the ears
        return (f"the face looks along {_nearest(own_front)}, expected {front}; turning its source fixes it",)
    return ()


def _along(direction: FloatArray, axis: str) -> float:
    """Cosine between a direction and an axis like ``-Y``."""
    length = float(np.linalg.norm(direction))
    return float(direction["XYZ".index(axis[1])]) * (-1.0 if axis[0] == "-" else 1.0) / length if length > 0 else 1.0


def _nearest(direction: FloatArray) -> str:
    longest = int(np.argmax(np.abs(direction)))
    return f"{'-' if direction[longest] < 0 else '+'}{'XYZ'[longest]}"
