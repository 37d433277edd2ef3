"""Whole bodies as avatars come, drawn by seed: of a right size, of a wrong unit, or lying down."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gltf_builder import Builder
from pxr import Gf, Usd, UsdGeom, UsdSkel
from their_glbs import matrices, pick, yes

Array = np.ndarray[Any, np.dtype[Any]]
# hips, spine, neck, head as rigs call them
JOINTS = [
    ("Hips", "Spine", "Neck", "Head"),
    ("mixamorig:Hips", "mixamorig:Spine", "mixamorig:Neck", "mixamorig:Head"),
    ("J_Bip_C_Hips", "J_Bip_C_Spine", "J_Bip_C_Neck", "J_Bip_C_Head"),
    ("pelvis", "spine_01", "neck_01", "head"),
    ("CC_Base_Hip", "CC_Base_Spine01", "CC_Base_NeckTwist01", "CC_Base_Head"),
    ("Bip01 Pelvis", "Bip01 Spine", "Bip01 Neck", "Bip01 Head"),
]


@dataclass
class Body:
    """A file of a body, and what is wrong with it."""

    path: Path
    factor: float  # its lengths are so many times too large
    lies: bool  # Z points up in a file of Y
    joints: bool


def _shape(rng: np.random.Generator, height: float) -> tuple[Array, Array]:
    """A body as rings about a spine, feet at 0: (n, 3) metres, Y up, and (4,) heights of hips, spine, neck, head."""
    joints = np.array([0.53, 0.62, 0.84, 0.88]) * height
    levels = np.linspace(0, 1, 21)
    radius = np.interp(
        levels, [0, 0.45, 0.55, 0.8, 0.85, 0.88, 0.94, 1], [0.06, 0.1, 0.1, 0.12, 0.04, 0.045, 0.05, 0.02]
    )
    wide = np.interp(levels, [0, 0.5, 0.79, 0.83, 0.85, 1], [1.2, 1.6, 2.0, 1.2, 1, 1]) * rng.uniform(0.9, 1.1)
    angles = np.arange(12) * np.pi / 6
    rings = [
        np.stack([w * r * height * np.cos(angles), np.full(12, up * height), r * height * np.sin(angles)], axis=1)
        for up, r, w in zip(levels, radius, wide, strict=True)
    ]
    return np.concatenate(rings), joints


def _faces(rings: int = 21, around: int = 12) -> Array:
    quads = [[r * around + i, r * around + (i + 1) % around, (r + 1) * around + (i + 1) % around, (r + 1) * around + i]
             for r in range(rings - 1) for i in range(around)]  # fmt: skip
    return np.array([[a, b, c, a, c, d] for a, b, c, d in quads]).reshape(-1, 3)


def _drawn(rng: np.random.Generator) -> tuple[Array, Array, float, bool, bool, tuple[str, ...]]:
    height = float(rng.uniform(1.1, 1.95))
    factor = float(pick(rng, 1.0, 0.01, 100.0, 1000.0, 10.0, 0.001))
    lies, joints = yes(rng, 0.4), yes(rng, 0.75)
    points, heights = _shape(rng, height)
    spine = np.stack([np.zeros(4), heights, np.zeros(4)], axis=1)
    if lies:  # what is up is Z now
        points, spine = (one[:, [0, 2, 1]] * (1, -1, 1) for one in (points, spine))
    return points * factor, spine * factor, factor, lies, joints, JOINTS[int(rng.integers(len(JOINTS)))]


def glb_body(rng: np.random.Generator, folder: Path) -> Body:
    """An avatar in glTF, skinned, or a mesh alone."""
    points, spine, factor, lies, joints, names = _drawn(rng)
    b = Builder()
    primitive: dict[str, Any] = {
        "attributes": {"POSITION": b.array(points)},
        "indices": b.array(_faces().ravel(), "u2"),
    }
    node: dict[str, Any] = {"name": "Body", "mesh": 0}
    if joints:
        near = np.abs(points[:, None] - spine[None]).sum(2).argmin(1)
        primitive["attributes"]["JOINTS_0"] = b.array(np.pad(near[:, None], ((0, 0), (0, 3))), "u1")
        primitive["attributes"]["WEIGHTS_0"] = b.array(np.tile([1.0, 0, 0, 0], (len(points), 1)))
    b.add("meshes", {"primitives": [primitive]})
    roots = []
    if joints:
        local = np.diff(spine, axis=0, prepend=0)
        for i, name in enumerate(names):
            b.add("nodes", {"name": name, "translation": local[i].tolist()} | ({"children": [i + 1]} if i < 3 else {}))
        binds = np.tile(np.eye(4), (4, 1, 1))
        binds[:, :3, 3] = -spine
        node["skin"] = b.add("skins", {"joints": [0, 1, 2, 3], "inverseBindMatrices": matrices(b, binds)})
        roots = [0]
    roots.append(b.add("nodes", node))
    b.add("scenes", {"nodes": roots})
    (folder / "body.glb").write_bytes(b.glb())
    return Body(folder / "body.glb", factor, lies, joints)


def usd_body(rng: np.random.Generator, folder: Path) -> Body:
    """An avatar on a stage, in the unit that it declares, rightly or not."""
    points, spine, factor, lies, joints, names = _drawn(rng)
    stage = Usd.Stage.CreateNew(str(folder / "body.usda"))
    unit = pick(rng, 1.0, 0.01)
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    UsdGeom.SetStageUpAxis(stage, "Y")
    points, spine = points / unit, spine / unit
    stage.SetDefaultPrim(UsdSkel.Root.Define(stage, "/Body").GetPrim())
    mesh = UsdGeom.Mesh.Define(stage, "/Body/Mesh")
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, one)) for one in points])
    mesh.CreateFaceVertexIndicesAttr(_faces().ravel().tolist())
    mesh.CreateFaceVertexCountsAttr([3] * len(_faces()))
    mesh.CreateSubdivisionSchemeAttr("none")
    if joints:
        skeleton = UsdSkel.Skeleton.Define(stage, "/Body/Skel")
        clean = [name.replace(":", "_").replace(" ", "_") for name in names]
        skeleton.CreateJointsAttr(["/".join(clean[: i + 1]) for i in range(4)])
        local = np.diff(spine, axis=0, prepend=0)
        skeleton.CreateRestTransformsAttr([Gf.Matrix4d(1.0).SetTranslate(Gf.Vec3d(*map(float, one))) for one in local])
        skeleton.CreateBindTransformsAttr([Gf.Matrix4d(1.0).SetTranslate(Gf.Vec3d(*map(float, one))) for one in spine])
        api = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
        near = np.abs(points[:, None] - spine[None]).sum(2).argmin(1)
        api.CreateJointIndicesPrimvar(False, 1).Set(near.tolist())
        api.CreateJointWeightsPrimvar(False, 1).Set([1.0] * len(points))
        api.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    stage.GetRootLayer().Save()
    return Body(folder / "body.usda", factor, lies, joints)


def differences(body: Body, lines: tuple[str, ...]) -> list[tuple[str, str]]:
    """(subject, figure) of what is wrong with the body and not said, or said and not wrong."""
    found = []
    unit, turned = (any(option in line for line in lines) for option in ("--meters-per-unit", "--up-axis"))
    # a doll of some centimetres without joints may be a part of a face
    if (body.factor != 1) != unit and (body.joints or body.factor >= 1):
        found.append(("units", f"{body.factor:g} times its size, {'' if unit else 'not '}named"))
    if body.lies != turned and body.joints:
        found.append(("stance", f"{'lies' if body.lies else 'stands'}, {'' if turned else 'not '}named"))
    return found


KINDS: dict[str, Callable[[np.random.Generator, Path], Body]] = {
    "bodies in glTF": glb_body,
    "bodies on stages": usd_body,
}
