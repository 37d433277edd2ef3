"""Where the points of a point cache are in the world of its stage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import TopologyError
from facepipe.geometry.vectors import transformed
from facepipe.parts import Mesh
from facepipe.rig import build, mesh_spaces
from facepipe.stage import open_face
from facepipe.stage.controls_over_time import CachedMesh, PointCache


@dataclass(frozen=True, kw_only=True)
class CachedPoints:
    """World points of some meshes of a stage, one after another, sample by sample."""

    meshes: tuple[Mesh, ...]
    count: int  # samples
    sample: Callable[[int], FloatArray]  # (n, 3) of a sample, in stage units
    untimed: Callable[[], FloatArray] | None  # (n, 3) of the points authored without time; None: some mesh lacks them


def cached_points(cache: PointCache, path: Path) -> CachedPoints:
    """The points of a cache; the skeleton at rest places those of a face that has points without time too.

    :param path: of the stage
    :raises InputError, SchemaError: a face that can't be read
    :raises TopologyError: a mesh of the face that the cache lacks
    """
    untimed = all(mesh.untimed is not None for mesh in cache.meshes)
    if cache.has_face and untimed:
        # points of a face, which its skin moves: as the skeleton at rest places them
        parts = open_face(path).parts()
        named = {cached.mesh.name: cached for cached in cache.meshes}
        lacking = next((mesh.name for mesh in parts.meshes if mesh.name not in named), None)
        if lacking is not None:
            raise TopologyError(path, f"no mesh '{lacking}' in the point cache, expected those of the face")
        meshes = [named[mesh.name] for mesh in parts.meshes]
        rig, spaces = build(parts), mesh_spaces(parts)
        matrices = rig.skinning_matrices(rig.rest)

        def placed(points_of: Callable[[CachedMesh], FloatArray | None]) -> FloatArray:
            bound = [_moved(points_of(mesh), space) for mesh, space in zip(meshes, spaces, strict=True)]
            return rig.skin(_joined(bound), matrices)

        return CachedPoints(
            meshes=tuple(cached.mesh for cached in meshes),
            count=max(1, len(cache.codes)),
            sample=lambda number: placed(lambda mesh: mesh.points[number]),
            untimed=lambda: placed(lambda mesh: mesh.untimed),
        )

    def sample(number: int) -> FloatArray:
        return _joined([_moved(cached.points[number], cached.worlds[number]) for cached in cache.meshes])

    def still() -> FloatArray:
        return _joined([_moved(mesh.untimed, mesh.untimed_world) for mesh in cache.meshes if mesh.untimed is not None])

    return CachedPoints(
        meshes=tuple(cached.mesh for cached in cache.meshes),
        count=max(1, len(cache.codes)),
        sample=sample,
        untimed=still if untimed else None,
    )


def _moved(points: FloatArray | None, matrix: FloatArray) -> FloatArray:
    return np.asarray(np.zeros((0, 3)) if points is None else transformed(points, matrix))


def _joined(pieces: list[FloatArray]) -> FloatArray:
    return np.concatenate(pieces) if pieces else np.zeros((0, 3))
