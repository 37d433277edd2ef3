"""Meshes of any stage over time: points that change from sample to sample, with or without a face; and one authored."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from pxr import Usd, UsdGeom, UsdSkel

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray, require_finite
from facepipe.core.errors import InputError, TopologyError
from facepipe.parts import Animation, Mesh
from facepipe.rig.neural_rig import Control
from facepipe.stage.controls_over_time import author_controls
from facepipe.stage.files import check_suffix, check_units, new_stage, open_stage, save_layer
from facepipe.stage.prims import is_applied, prims_below
from facepipe.stage.read_mesh import is_left_handed, turned
from facepipe.stage.skeleton import read_animation
from facepipe.stage.values import errors_below, floats, ints, matrix, reads_prim, to_ints, to_vec3f

MOST_SAMPLES = 100_000


@dataclass(frozen=True, kw_only=True)
class CachedMesh:
    """One mesh over T samples."""

    mesh: Mesh  # name and faces; points of the first sample
    points: FloatArray  # (T, n, 3) float32 mesh space
    worlds: FloatArray  # (T, 4, 4) mesh space -> world
    untimed: FloatArray | None  # (n, 3) float32 points authored without time, mesh space
    untimed_world: FloatArray  # (4, 4) mesh space -> world without time
    authored: npt.NDArray[np.bool_]  # (T,) samples that hold points of this mesh; USD makes the others from these

    @property
    def guessed(self) -> npt.NDArray[np.bool_]:
        """(T,) samples that are between two different ones, so that nobody knows where the points were."""
        authored, numbers = np.flatnonzero(self.authored), np.arange(len(self.points))
        if not len(authored):
            return np.zeros(len(numbers), dtype=bool)
        before, after = np.searchsorted(authored, numbers, side="right") - 1, np.searchsorted(authored, numbers)
        inside = (before >= 0) & (after < len(authored)) & (before != after)
        return np.array(
            [
                here and not np.array_equal(self.points[authored[left]], self.points[authored[right]])
                for here, left, right in zip(inside, before, after, strict=True)
            ]
        )


@dataclass(frozen=True, kw_only=True)
class PointCache:
    """All meshes of a stage."""

    meshes: tuple[CachedMesh, ...]
    codes: npt.NDArray[np.float64]  # (T,) time codes; none where nothing moves, T = 1
    moving: npt.NDArray[np.bool_]  # (T,) samples at which points or the place of some mesh are authored
    codes_per_second: float
    meters_per_unit: float
    up_axis: str
    has_face: bool  # the stage has a face, whose skeleton may move the points further

    @property
    def times(self) -> npt.NDArray[np.float64] | None:
        """(T,) seconds; None: nothing moves, T = 1."""
        return self.codes / self.codes_per_second if len(self.codes) else None


def read_point_cache(path: str | os.PathLike[str], also: Collection[float] = ()) -> PointCache:
    """The meshes of a USD file at all samples of their points and transforms; skins and blendshapes are left out.

    :param also: further time codes to read them at
    :raises InputError: no such file, no readable USD, too many samples, or NaN
    :raises SchemaError: units that are no length
    :raises TopologyError: a mesh whose number of points or faces change, or whose faces don't fit its points
    """
    with errors_below(str(Path(path))):
        stage = open_stage(path)
        check_units(Path(path), stage)
        prims = [prim for prim in _prims(stage) if prim.IsA(UsdGeom.Mesh)]
        names = [str(prim.GetName()) for prim in prims]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(twice, "is the name of more than one mesh, expected different names")
        # time codes at which points or the place of a mesh are authored, apart from `also`: at codes of the controls
        # alone USD interpolates points, which nobody recorded
        own: set[float] = set()
        for prim in prims:
            own |= set(UsdGeom.Mesh(prim).GetPointsAttr().GetTimeSamples())
            place = prim
            while place and not place.IsPseudoRoot():
                own |= set(UsdGeom.Xformable(place).GetTimeSamples() if place.IsA(UsdGeom.Xformable) else ())
                place = place.GetParent()
        codes = sorted(own | set(also))
        if len(codes) > MOST_SAMPLES:
            raise InputError("time samples", f"{len(codes)}, expected at most {MOST_SAMPLES}")
        times = [Usd.TimeCode(code) for code in codes] or [Usd.TimeCode.Default()]
        return PointCache(
            meshes=tuple(_cached(prim, times) for prim in prims),
            codes=np.array(codes, dtype=np.float64),
            moving=np.array([code in own for code in codes] or [False]),
            codes_per_second=stage.GetTimeCodesPerSecond() or 24.0,
            meters_per_unit=float(UsdGeom.GetStageMetersPerUnit(stage)),
            up_axis=str(UsdGeom.GetStageUpAxis(stage)),
            has_face=any(is_applied(prim, tokens.FACE_API) for prim in _prims(stage)),
        )


def read_loose_animations(path: str | os.PathLike[str]) -> tuple[Animation, ...]:
    """The SkelAnimations of a USD file, whether it has a face or not.

    :raises InputError, TopologyError: no such file, no readable USD, NaN, a joint or shape twice, or arrays that don't
        fit each other
    """
    with errors_below(str(Path(path))):
        stage, animations = open_stage(path), []
        for prim in _prims(stage):
            if not prim.IsA(UsdSkel.Animation):
                continue
            animation, where = read_animation(prim), str(prim.GetPath())
            require_finite(animation, where)
            count = Counter((*animation.joints, *animation.shapes))
            twice = next((name for name, times in count.items() if times > 1), None)
            if twice is not None:
                raise InputError(where, f"'{twice}' twice, expected each joint and shape once")
            animations.append(animation)
        return tuple(animations)


def _prims(stage: Usd.Stage) -> Iterator[Usd.Prim]:
    return prims_below(stage.GetPseudoRoot(), "stage")


@reads_prim
def _cached(prim: Usd.Prim, times: list[Usd.TimeCode]) -> CachedMesh:
    mesh, where = UsdGeom.Mesh(prim), str(prim.GetPath())
    samples = [floats(mesh.GetPointsAttr().Get(time), 3) for time in times]
    other = next((i for i, points in enumerate(samples) if len(points) != len(samples[0])), None)
    if other is not None:
        what = f"{len(samples[other])} points at a time sample, expected {len(samples[0])} as at the first"
        raise TopologyError(where, f"{what} (time code {times[other].GetValue():g})")
    faces = []
    for attribute in (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()):
        given = [ints(attribute.Get(time)) for time in attribute.GetTimeSamples()] or [ints(attribute.Get())]
        # exporters may write samples of the faces too, all alike
        if any(not np.array_equal(sample, given[0]) for sample in given):
            raise TopologyError(where, f"{attribute.GetName()} change over time, expected the same faces throughout")
        faces.append(given[0])
    counts, indices = faces
    if counts.sum() != len(indices) or (indices.size and not 0 <= indices.min() <= indices.max() < len(samples[0])):
        raise TopologyError(where, f"faces that don't fit {len(samples[0])} points")
    points = np.stack(samples)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=(1, 2)))
    if bad.size:
        when = "" if times[0].IsDefault() else f" at time code {times[bad[0]].GetValue():g}"
        raise InputError(where, f"points hold NaN or infinity{when}, expected finite numbers")
    mesh_parts = Mesh(name=prim.GetName(), points=points[0], face_vertex_counts=counts, face_vertex_indices=indices)
    place, sampled = UsdGeom.Xformable(prim), set(mesh.GetPointsAttr().GetTimeSamples())
    return CachedMesh(
        mesh=turned(mesh_parts) if is_left_handed(mesh) else mesh_parts,
        points=points,
        worlds=np.stack([matrix(place.ComputeLocalToWorldTransform(time)) for time in times]),
        untimed=floats(mesh.GetPointsAttr().Get(), 3) if mesh.GetPointsAttr().Get() else None,
        untimed_world=matrix(place.ComputeLocalToWorldTransform(Usd.TimeCode.Default())),
        authored=np.array([time.GetValue() in sampled for time in times]),
    )


_MILLIMETRE = 0.001


def save_point_cache(
    path: str | os.PathLike[str],
    name: str,
    meshes: Sequence[Mesh],
    controls: Sequence[Control],
    values: FloatArray,
    points: FloatArray,
    rest: FloatArray,
    codes: FloatArray,
    codes_per_second: float,
) -> None:
    """Meshes whose points have time samples, below a prim with numbers ``facepipe:control:<name>``; atomically.

    :param name: of that prim
    :param meshes: names and faces
    :param values: (f, c)
    :param points: (f, n, 3) of all meshes one after another, millimetres, Y up
    :param rest: (n, 3) authored without time
    :param codes: (f,) ascending time codes
    :raises InputError: NaN, a name that USD can't hold, or a file that can't be written
    """
    check_suffix(Path(path))
    stage = new_stage(_MILLIMETRE, "Y", codes_per_second)
    root = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
    stage.SetDefaultPrim(root)
    stage.SetStartTimeCode(float(codes[0]))
    stage.SetEndTimeCode(float(codes[-1]))
    author_controls(root, path, controls, values, codes)
    ends = np.cumsum([len(mesh.points) for mesh in meshes])
    for mesh, end in zip(meshes, ends, strict=True):
        own = slice(end - len(mesh.points), end)
        frames, still = points[:, own], rest[own]
        prim = UsdGeom.Mesh.Define(stage, root.GetPath().AppendChild(mesh.name))
        prim.CreateFaceVertexCountsAttr(to_ints(mesh.face_vertex_counts))
        prim.CreateFaceVertexIndicesAttr(to_ints(mesh.face_vertex_indices))
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        attribute = prim.CreatePointsAttr(to_vec3f(still))
        bounds = np.stack([frames.min(axis=1), frames.max(axis=1)], axis=1)
        # an extent without samples would hide what moves out of it, where a viewer culls by it
        extent = prim.CreateExtentAttr(to_vec3f(np.stack([still.min(axis=0), still.max(axis=0)])))
        for code, frame, box in zip(codes.tolist(), frames, bounds, strict=True):
            attribute.Set(to_vec3f(frame), code)
            extent.Set(to_vec3f(box), code)
    save_layer(stage.GetRootLayer(), path)
