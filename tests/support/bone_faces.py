"""Rigs, poses and targets of bone fits, for tests."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from faces import replace_mesh, tiny_face, with_meshes
from import_data import shared
from oracle import random_coefficients
from pxr import Sdf, Usd, UsdGeom

from facepipe.importers import makehuman
from facepipe.parts import Animation, FaceParts, Mesh, Skeleton
from facepipe.rig import Rig, build, rest_coefficients
from facepipe.stage import save_parts

REACH = 0.1  # of a random translation, stage units: 1 mm of the small face, 10 mm of MakeHuman


@functools.cache
def small() -> FaceParts:
    """A skinned grid with three joints, and a loose mesh."""
    return tiny_face(0)


@functools.cache
def head(targets: tuple[tuple[str, float], ...] = ()) -> FaceParts:
    """MakeHuman; skips the test where its data is absent."""
    return makehuman.read(shared("makehuman/makehuman_head.npz"), makehuman.Options(targets=dict(targets))).parts


def face_joints(rig: Rig) -> list[int]:
    """Joints of a rig that points hang at, of MakeHuman those of the face."""
    weighted = np.flatnonzero(np.asarray(abs(rig.influences[:, : len(rig.joints)]).sum(axis=0)).ravel() > 0)
    named = [int(one) for one in weighted if "neck01" in rig.joints[one].split("/")]
    return named or [int(one) for one in weighted]


def pose(rig: Rig, seed: int, share: float = 1.0) -> np.ndarray:
    """(j, 9) random coefficients of the face's joints; `share` of them, from rest."""
    values, joints = rest_coefficients(len(rig.joints)), face_joints(rig)
    values[joints] += share * (random_coefficients(np.random.default_rng(seed), len(joints), REACH) - values[joints])
    return values


def clip(rig: Rig, name: str = "talk", frames: int = 5) -> Animation:
    """From rest into a random pose, 0.1 s a frame."""
    values = np.stack([pose(rig, 3, 0.5 * frame / (frames - 1)) for frame in range(frames)])
    return Animation(name=name, times=np.arange(frames) / 10, joints=rig.joints, coefficients=values)


def sculpt(parts: FaceParts, points: np.ndarray, names: Sequence[str] = ()) -> FaceParts:
    """The meshes of a face, or some, with world points (n, 3) and nothing else."""
    rig = build(parts)
    meshes = [
        Mesh(
            name=mesh.name,
            points=own,
            face_vertex_counts=mesh.face_vertex_counts,
            face_vertex_indices=mesh.face_vertex_indices,
        )
        for mesh, own in zip(parts.meshes, rig.split(points).values(), strict=True)
    ]
    kept = tuple(mesh for mesh in meshes if not names or mesh.name in names)
    return replace(FaceParts(meters_per_unit=parts.meters_per_unit, up_axis=parts.up_axis), meshes=kept)


def in_metres_z_up(parts: FaceParts) -> FaceParts:
    """The same face in the world on a stage with other units and axes."""
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) * parts.meters_per_unit
    meshes = tuple(replace_mesh(mesh, points=mesh.points @ turn.T) for mesh in parts.meshes)
    return replace(parts, meters_per_unit=1.0, up_axis="Z", meshes=meshes)


def saved(parts: FaceParts, path: Path) -> Path:
    save_parts(parts, path)
    return path


def save_obj(parts: FaceParts, path: Path, *, objects: bool = True) -> Path:
    """An OBJ with an `o` for each mesh, or with all of them as one."""
    lines, start = [], 1
    for mesh in parts.meshes:
        lines += [f"o {mesh.name}"] if objects else []
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(mesh.points, float).tolist()]
        corners = np.split(mesh.face_vertex_indices + start, np.cumsum(mesh.face_vertex_counts)[:-1])
        lines += [f"f {' '.join(map(str, face))}" for face in corners]
        start += len(mesh.points)
    path.write_text("\n".join(lines) + "\n")
    return path


def save_cache(parts: FaceParts, frames: np.ndarray, path: Path, *, moved: float = 0.0) -> Path:
    """A stage without a face whose meshes' points (T, n, 3) change ten times a second.

    :param moved: the points are this far off along x, and an Xform above brings them back
    """
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, parts.meters_per_unit)
    UsdGeom.SetStageUpAxis(stage, parts.up_axis)
    stage.SetTimeCodesPerSecond(10)
    UsdGeom.Xform.Define(stage, "/Cache").AddTranslateOp().Set((-moved, 0.0, 0.0))
    rig = build(parts)
    for number, mesh in enumerate(parts.meshes):
        prim = UsdGeom.Mesh.Define(stage, f"/Cache/{mesh.name}")
        prim.CreateFaceVertexCountsAttr(mesh.face_vertex_counts.tolist())
        prim.CreateFaceVertexIndicesAttr(mesh.face_vertex_indices.tolist())
        own = slice(*rig.mesh_offsets[number : number + 2])
        for frame, points in enumerate(frames[:, own] + [moved, 0.0, 0.0]):
            prim.GetPointsAttr().Set([tuple(map(float, row)) for row in points], frame)
    stage.GetRootLayer().Save()
    return path


def save_loose_clip(animation: Animation, parts: FaceParts, path: Path) -> Path:
    """A stage with the SkelAnimation alone."""
    whole = saved(replace(parts, animations=(animation,)), path.with_name(f"whole_{path.name}"))
    source, stage = Usd.Stage.Open(str(whole)), Usd.Stage.CreateNew(str(path))
    stage.SetTimeCodesPerSecond(source.GetTimeCodesPerSecond())
    prim = next(one for one in source.Traverse() if one.GetTypeName() == "SkelAnimation")
    layer = source.Flatten()
    Sdf.CopySpec(layer, prim.GetPath(), stage.GetRootLayer(), Sdf.Path(f"/{animation.name}"))
    stage.GetRootLayer().Save()
    return path


def skeletonless(parts: FaceParts) -> FaceParts:
    """Without joints, skins and shapes."""
    return replace(with_meshes(parts, skin=None, blendshapes=()), skeleton=Skeleton())


def save_sources(folder: Path) -> Path:
    """rig.usda with a clip, a goal within its reach, limits."""
    for name, data in _sources().items():
        (folder / name).write_bytes(data)
    return folder


@functools.cache
def _sources() -> dict[str, bytes]:
    rig = build(small())
    with tempfile.TemporaryDirectory() as folder:
        files = [
            saved(replace(small(), animations=(clip(rig),)), Path(folder, "rig.usda")),
            saved(sculpt(small(), rig.evaluate(coefficients=pose(rig, 1))), Path(folder, "goal.usda")),
        ]
        limits = b'{"joints": {"*": {"t": [-1, 1], "s": [0.5, 2]}}, "units": "stage"}'
        return {file.name: file.read_bytes() for file in files} | {"limits.json": limits}
