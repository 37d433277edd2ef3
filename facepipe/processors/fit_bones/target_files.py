"""Targets in files: faces, point caches and animations of USD stages, OBJ and glTF meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.parts import FaceParts, Mesh
from facepipe.processors.cached_points import cached_points
from facepipe.processors.fit_bones.matching import match_meshes
from facepipe.processors.same_topology import world_to_world
from facepipe.rig import build, person_of, sample_transforms, sample_weights
from facepipe.stage import Face, open_face
from facepipe.stage.files import SUFFIXES as USD_SUFFIXES
from facepipe.stage.point_cache import PointCache, read_loose_animations, read_point_cache

Loader = Callable[[Path], FaceParts]
LOADED = (".obj", ".glb", ".gltf")


class FilePoints(NamedTuple):
    """World points (T, n, 3) of the rig that a file gives, at `times` (T,), and which of them it knows (n,)."""

    points: FloatArray
    times: FloatArray | None
    known: npt.NDArray[np.bool_] | None
    notes: tuple[str, ...] = ()


def split_file(word: str) -> tuple[str | None, str]:
    """File and name of ``FILE`` or ``FILE:NAME``; no file where neither has a suffix that targets can have."""
    if Path(word).suffix.lower() in (*USD_SUFFIXES, *LOADED):
        return word, ""
    file, _, name = word.rpartition(":")
    return (file, name) if Path(file).suffix.lower() in (*USD_SUFFIXES, *LOADED) else (None, "")


def read_file(parts: FaceParts, file: str, name: str, load: Loader | None) -> FilePoints:
    """The points that a file gives.

    :param parts: the face to be fitted
    :param name: of an animation of a USD stage, or of the face's mesh that the single mesh of another file is
    :raises InputError: a file that can't be read or has no such animation
    :raises TopologyError: a mesh that is not on the face's topology
    """
    path = Path(file)
    if path.suffix.lower() in LOADED:
        if load is None:
            raise InputError(path, f"suffix '{path.suffix}' needs an importer, expected a USD stage")
        return _neutral(parts, load(path), str(path), name, triangles=path.suffix.lower() != ".obj")
    cache = read_point_cache(path)
    if name:
        return _animation(parts, path, name, cache.has_face)
    if cache.times is None and cache.has_face:
        return _neutral(parts, open_face(path).parts(), str(path))
    return _cached(parts, cache, path)


def sampled(face: Face, name: str) -> tuple[FloatArray, FloatArray | None]:
    """(T, n, 3) world points of an animation of a face, and its times (T,).

    :raises InputError: no such animation, or joints and shapes that the face has not
    """
    times = next((one.times for one in face.animations if one.name == name), None)
    frames = [face.sample(name, number) for number in range(1 if times is None else len(times))]
    return np.stack([face.evaluate(weights, joint_transforms=local) for local, weights in frames]), times


def _neutral(parts: FaceParts, other: FaceParts, where: str, only: str = "", *, triangles: bool = False) -> FilePoints:
    """The neutral of another face, as it is set."""
    person = person_of(other)
    points = build(other).evaluate(person.weights, coefficients=person.coefficients)
    moved = _to_world(parts, points[None], other.meters_per_unit, other.up_axis)
    return _matched(parts, other.meshes, moved, None, where, only, triangles=triangles)


def _cached(parts: FaceParts, cache: PointCache, path: Path) -> FilePoints:
    """Points over time; those of a face as its skeleton at rest places them."""
    found = cached_points(cache, path)
    points = np.stack([found.sample(number) for number in range(found.count)])
    moved = _to_world(parts, points, cache.meters_per_unit, cache.up_axis)
    return _matched(parts, found.meshes, moved, cache.times, str(path))


def _animation(parts: FaceParts, path: Path, name: str, has_face: bool) -> FilePoints:
    """An animation of the face of a stage; of a stage without a face, one that moves the face itself."""
    animations = read_loose_animations(path)
    animation = next((one for one in animations if one.name == name), None)
    if animation is None:
        raise InputError(path, unknown(name, [one.name for one in animations], "animation"))
    if has_face:
        other = open_face(path)
        points, times = sampled(other, name)
        moved = _to_world(parts, points, other.meters_per_unit, other.up_axis)
        return _matched(parts, other.meshes, moved, times, str(path))
    rig, times = build(parts), animation.times
    frames = range(1 if times is None else len(times))
    try:
        found = [
            rig.evaluate(
                sample_weights(animation, number), joint_transforms=sample_transforms(parts.skeleton, animation, number)
            )
            for number in frames
        ]
    except InputError as error:
        raise error.under(path) from None
    return FilePoints(np.stack(found), times, None)


def _to_world(parts: FaceParts, points: FloatArray, meters_per_unit: float, up_axis: str) -> FloatArray:
    """(T, n, 3) points of the world of another stage in that of the face."""
    return _transformed(points, world_to_world(meters_per_unit, up_axis, parts)[None])


def _transformed(points: FloatArray, matrices: FloatArray) -> FloatArray:
    """(T, n, 3) points by (T, 4, 4) or (1, 4, 4) matrices."""
    return np.asarray(points @ matrices[:, :3, :3].transpose(0, 2, 1) + matrices[:, None, :3, 3])


def _matched(
    parts: FaceParts,
    meshes: Sequence[Mesh],
    points: FloatArray,
    times: FloatArray | None,
    where: str,
    only: str = "",
    *,
    triangles: bool = False,
) -> FilePoints:
    """Points (T, m, 3) of other meshes at the places of the face's."""
    match = match_meshes(parts, meshes, where, only, triangles=triangles)
    rest = build(parts).evaluate()
    found = np.repeat(rest[None], len(points), axis=0)
    found[:, match.rows] = points[:, match.others]
    known = np.zeros(len(rest), dtype=bool)
    known[match.rows] = True
    return FilePoints(found, times, None if known.all() else known, match.notes)
