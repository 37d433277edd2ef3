"""Where the points of a point cache are in the world of its stage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import TopologyError
from facepipe.parts import Mesh
from facepipe.rig import build, mesh_spaces
from facepipe.stage import open_face
from facepipe.stage.point_cache import CachedMesh, PointCache


@dataclass(frozen=True, kw_only=True)
class CachedPoints:
    """World points of some meshes of a stage, one after another, sample by sample."""

    meshes: tuple[Mesh, ...]
    count: int  # samples
    sample: Callable[[int], FloatArray]  # (n, 3) of a sample, in stage units
    untimed: Callable[[], FloatArray] | None  # (n, 3) of the points authored without time; None: some mesh lacks them


def cached_points(cache: PointCache, path: Path) -> CachedPoints:
    """Of a face whose points are authored without time too, the skeleton at rest places them; else each mesh itself.

    :param path: of the stage
    :raises InputError, SchemaError: a face that can't be read
    :raises TopologyError: a mesh of the face that the cache lacks
    """
    untimed = all(one.untimed is not None for one in cache.meshes)
    if cache.has_face and untimed:
        return _held(cache, path)

    def sample(number: int) -> FloatArray:
        return _joined([_moved(one.points[number], one.worlds[number]) for one in cache.meshes])

    def still() -> FloatArray:
        return _joined([_moved(one.untimed, one.untimed_world) for one in cache.meshes if one.untimed is not None])

    return CachedPoints(
        meshes=tuple(one.mesh for one in cache.meshes),
        count=max(1, len(cache.codes)),
        sample=sample,
        untimed=still if untimed else None,
    )


def _held(cache: PointCache, path: Path) -> CachedPoints:
    """Points of a face, which its skin moves: as the skeleton at rest places them."""
    parts = open_face(path).parts()
    cached = {one.mesh.name: one for one in cache.meshes}
    lacking = next((mesh.name for mesh in parts.meshes if mesh.name not in cached), None)
    if lacking is not None:
        raise TopologyError(path, f"no mesh '{lacking}' in the point cache, expected those of the face")
    meshes = [cached[mesh.name] for mesh in parts.meshes]
    rig, spaces = build(parts), mesh_spaces(parts)
    matrices = rig.skinning_matrices(rig.rest)

    def placed(of: Callable[[CachedMesh], FloatArray | None]) -> FloatArray:
        bound = [_moved(of(one), space) for one, space in zip(meshes, spaces, strict=True)]
        return rig.skin(_joined(bound), matrices)

    return CachedPoints(
        meshes=tuple(one.mesh for one in meshes),
        count=max(1, len(cache.codes)),
        sample=lambda number: placed(lambda one: one.points[number]),
        untimed=lambda: placed(lambda one: one.untimed),
    )


def _moved(points: FloatArray | None, matrix: FloatArray) -> FloatArray:
    return np.asarray(np.zeros((0, 3)) if points is None else points @ matrix[:3, :3].T + matrix[:3, 3])


def _joined(pieces: list[FloatArray]) -> FloatArray:
    return np.concatenate(pieces) if pieces else np.zeros((0, 3))
