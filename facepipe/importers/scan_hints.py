"""Where the face of a file is, by what the file says: the joint of a head, shapes that close eyes and open a mouth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.geometry.vectors import transformed
from facepipe.parts import Blendshape, FaceParts, Mesh
from facepipe.rig.conventions import meaning
from facepipe.rig.joint_names import human_joint
from facepipe.scans import ScanHints

_CARRIED = 0.5  # weight of the joints of a head from which they carry a point
_STRONG = 0.5  # of a shape's largest offset: points that move less say little of where it is
_FAR = 1e3  # metres: eyes that are farther from their joint are nowhere
_ABOVE_JOINT = 0.35  # height of a head above its joint, in distances from hips to head, as in `rig.plausibility`
_LEFT, _RIGHT, _BOTH = "eyeBlinkLeft", "eyeBlinkRight", "eyeBlink"
_MOUTH = ("jawOpen", "viseme_aa", "viseme_O", "viseme_E", "mouthFunnel", "mouthClose")  # the first that is there
# Of the expressions of a VRM, whose shapes may have any name.
_PRESETS = {"blinkLeft": _LEFT, "blinkRight": _RIGHT, "blink": _BOTH, "aa": "viseme_aa", "oh": "viseme_O"}


class _Moved(NamedTuple):
    """Points that a shape moves far, in the world."""

    places: FloatArray  # (k, 3)
    far: FloatArray  # (k,) how far
    normals: FloatArray  # (k, 3) of the surface


def hints_of(parts: FaceParts) -> ScanHints:
    """What `parts` say of their triangles, mesh by mesh, as `facepipe.importers.scan_file.read_scan` has them."""
    triangles = [point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices) for mesh in parts.meshes]
    of_mesh = np.repeat(np.arange(len(triangles)), [len(one) for one in triangles])
    carried = _head_points(parts)
    head = None
    if carried is not None:
        head = np.concatenate([one[rows].all(axis=1) for one, rows in zip(carried, triangles, strict=True)])
    features, swapped = _features(parts)
    return ScanHints(
        pieces=tuple(mesh.name for mesh in parts.meshes),
        piece=of_mesh.astype(np.int32),
        head=head if head is not None and head.any() else None,
        features=features,
        swapped=swapped,
        mm_per_unit=1000.0 * parts.meters_per_unit,
        vertices={one.name: transformed(np.asarray(one.points, np.float64), one.transform) for one in parts.meshes},
    )


def _head_points(parts: FaceParts) -> list[BoolArray] | None:
    """Of each mesh the points (n,) that the joint of a head and those below it carry, or that are near a joint that
    carries none; None: no such joint."""
    joint = human_joint(parts, "Head")
    if joint is None:
        return None
    below = np.zeros(len(parts.skeleton.joints), bool)
    for i, parent in enumerate(parts.skeleton.parents):  # parents come first
        below[i] = i == joint or (parent >= 0 and below[parent])
    found = []
    for mesh in parts.meshes:
        if mesh.skin is None:
            found.append(np.zeros(len(mesh.points), bool))
        else:
            found.append((mesh.skin.joint_weights * below[mesh.skin.joint_indices]).sum(axis=1) > _CARRIED)
    return found if any(one.any() for one in found) else _near_head(parts, joint)


def _near_head(parts: FaceParts, joint: int) -> list[BoolArray] | None:
    """Of each mesh the points (n,) where a head is by its joint alone, which carries nothing: by the proportions of
    bodies, and in an avatar about where it looks from; None without hips to measure a body by."""
    hips = human_joint(parts, "Hips")
    if hips is None or hips == joint:
        return None
    bind = parts.skeleton.transform @ parts.skeleton.bind_transforms
    head, spine = bind[joint, :3, 3], bind[joint, :3, 3] - bind[hips, :3, 3]
    middle, reach = head + _ABOVE_JOINT / 2 * spine, _ABOVE_JOINT * float(np.linalg.norm(spine))
    offset = _of_vrm(parts, "lookAt", "offsetFromHeadBone")  # metres, in the head's own axes
    if (
        isinstance(offset, list)
        and len(offset) == 3
        and all(isinstance(one, int | float) and abs(one) < _FAR for one in offset)
    ):
        middle = head + bind[joint, :3, :3] @ np.asarray(offset, np.float64) / parts.meters_per_unit
    worlds = [transformed(np.asarray(mesh.points, np.float64), mesh.transform) for mesh in parts.meshes]
    return [np.linalg.norm(world - middle, axis=1) < reach for world in worlds]


def _of_vrm(parts: FaceParts, *keys: str) -> object:
    """What a VRM says there, of which a stage may hold anything; None where it says nothing."""
    found: object = parts.vrm
    for key in ("VRMC_vrm", *keys):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found


def _features(parts: FaceParts) -> tuple[FloatArray | None, bool]:
    """Left eye, right eye and mouth (3, 3) by the shapes that move them, and whether names have left and right changed
    over; None where no shapes say it.

    Left is where it lies as the surface faces: names don't decide it, since a mesh may be mirrored.
    """
    moved: dict[str, _Moved] = {}
    for meant, mesh, shape in _meant(parts):
        if meant not in moved and len(shape.point_indices):
            moved[meant] = _moved(mesh, shape)
    mouth = next((moved[name] for name in _MOUTH if name in moved), None)
    if mouth is None or not ({_LEFT, _RIGHT} <= {*moved} or _BOTH in moved):
        return None, False
    named = {_LEFT, _RIGHT} <= {*moved}
    eyes = (moved[_LEFT], moved[_RIGHT]) if named else _halves(moved[_BOTH])
    places = np.stack([np.average(one.places, axis=0, weights=one.far) for one in (*eyes, mouth)])
    outward = np.sum([np.average(one.normals, axis=0, weights=one.far) for one in eyes], axis=0)
    across, upward = places[0] - places[1], places[:2].mean(axis=0) - places[2]
    other = bool(np.cross(across, upward) @ outward < 0)
    return (places[[1, 0, 2]] if other else places), named and other


def _meant(parts: FaceParts) -> Iterator[tuple[str, Mesh, Blendshape]]:
    """Shapes of eyes and mouth and what they mean: as the expressions of a VRM have it, then by their names."""
    wanted = {_LEFT, _RIGHT, _BOTH, *_MOUTH}
    shapes = {(mesh.name, shape.name): (mesh, shape) for mesh in parts.meshes for shape in mesh.blendshapes}
    for preset, meant in _PRESETS.items():
        binds = _of_vrm(parts, "expressions", "preset", preset, "morphTargetBinds")
        for bind in binds if isinstance(binds, list) else ():
            found = shapes.get((str(bind.get("node")), str(bind.get("index")))) if isinstance(bind, Mapping) else None
            if found is not None:
                yield meant, *found
    for mesh, shape in shapes.values():
        meant = meaning(shape.name) or ""
        if meant in wanted:
            yield meant, mesh, shape


def _moved(mesh: Mesh, shape: Blendshape) -> _Moved:
    offsets = np.linalg.norm(np.asarray(shape.offsets, np.float64), axis=1)
    strong = offsets >= _STRONG * offsets.max()
    at = shape.point_indices[strong]
    world = transformed(np.asarray(mesh.points, np.float64), mesh.transform)
    normals = point_normals(world, point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices))
    if np.linalg.det(mesh.transform[:3, :3]) < 0:
        normals = -normals
    return _Moved(world[at], offsets[strong] + np.finfo(np.float64).tiny, normals[at])


def _halves(moved: _Moved) -> tuple[_Moved, _Moved]:
    """What one shape moves, parted at the middle of the line along which that is widest."""
    places = moved.places - moved.places.mean(axis=0)
    along = places @ np.linalg.svd(places, full_matrices=False)[2][0]
    one = along >= (along.max() + along.min()) / 2
    if one.all():  # of one point
        return moved, moved
    return _Moved(*(column[one] for column in moved)), _Moved(*(column[~one] for column in moved))
