"""UsdSkel itself as the judge of deformation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdSkel

from facepipe.rig.trs import decompose
from facepipe.stage import Face
from facepipe.stage.values import floats, matrix, to_quatf, to_vec3f, to_vec3h


def bake(face: Face, weights: Mapping[str, float], joint_transforms: np.ndarray | None = None) -> np.ndarray:
    """(n, 3) world points that `UsdSkel.BakeSkinning` gives; transforms are local, without shear."""
    return bake_all(face, [(weights, joint_transforms)])[0]


def bake_all(face: Face, poses: Sequence[tuple[Mapping[str, float], np.ndarray | None]]) -> np.ndarray:
    """(poses, n, 3) world points that `UsdSkel.BakeSkinning` gives for poses at successive times."""
    layer = face.stage.Flatten()
    stage = Usd.Stage.Open(layer)
    skeleton = next(one for one in stage.Traverse() if one.IsA(UsdSkel.Skeleton))
    animation = UsdSkel.Animation.Define(stage, skeleton.GetPath().AppendChild("OraclePose"))
    animation.CreateBlendShapesAttr(list(face.shapes))
    animation.CreateJointsAttr(list(face.skeleton.joints))
    for time, (weights, transforms) in enumerate(poses):
        values = [float(weights.get(name, 0.0)) for name in face.shapes]
        animation.CreateBlendShapeWeightsAttr().Set(values, time)
        local = face.skeleton.rest_transforms if transforms is None else transforms
        translations, rotations, scales, _ = decompose(local)
        animation.CreateTranslationsAttr().Set(to_vec3f(translations), time)
        animation.CreateRotationsAttr().Set(to_quatf(rotations), time)
        animation.CreateScalesAttr().Set(to_vec3h(scales), time)
    UsdSkel.BindingAPI.Apply(skeleton).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    root = UsdSkel.Root(stage.GetPrimAtPath(face.prim.GetPath()))
    assert UsdSkel.BakeSkinning(root, Gf.Interval(0, len(poses) - 1))
    meshes = [one for one in Usd.PrimRange(root.GetPrim()) if one.IsA(UsdGeom.Mesh)]
    return np.stack([np.concatenate([_world_points(mesh, t) for mesh in meshes]) for t in range(len(poses))])


def played(path: Path, times: Sequence[float | None] = (None,), animation: str | None = None) -> np.ndarray:
    """(times, n, 3) world points that UsdSkel gives a file as it is, at seconds; None: a pose, without time.

    :param animation: the one that the skeleton is to play, instead of its own
    """
    stage = Usd.Stage.Open(Usd.Stage.Open(str(path)).Flatten())
    prims = list(Usd.PrimRange(stage.GetDefaultPrim()))
    skeleton = next(prim for prim in prims if prim.IsA(UsdSkel.Skeleton))
    if animation is not None:
        source = next(prim for prim in prims if prim.IsA(UsdSkel.Animation) and prim.GetName() == animation)
        UsdSkel.BindingAPI.Apply(skeleton).CreateAnimationSourceRel().SetTargets([source.GetPath()])
    codes = [0.0 if time is None else time * stage.GetTimeCodesPerSecond() for time in times]
    assert UsdSkel.BakeSkinning(UsdSkel.Root(stage.GetDefaultPrim()), Gf.Interval.GetFullInterval())
    meshes = [prim for prim in prims if prim.IsA(UsdGeom.Mesh)]
    return np.stack([np.concatenate([_world_points(mesh, code) for mesh in meshes]) for code in codes])


def _world_points(prim: Usd.Prim, time: float) -> np.ndarray:
    points = floats(UsdGeom.Mesh(prim).GetPointsAttr().Get(time), 3).astype(np.float64)
    world = matrix(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(time))
    return points @ world[:3, :3].T + world[:3, 3]


def random_coefficients(rng: np.random.Generator, joints: int, translation: float, rotation: float = 0.6) -> np.ndarray:
    """(j, 9) bone coefficients; scales 0.7 to 1.4, rounded to half as SkelAnimation stores them."""
    values = np.concatenate(
        [
            rng.uniform(-translation, translation, (joints, 3)),
            rng.uniform(-rotation, rotation, (joints, 3)),
            rng.uniform(0.7, 1.4, (joints, 3)),
        ],
        axis=1,
    )
    values[:, 6:] = values[:, 6:].astype(np.float16)
    return values


def difference(face: Face, one: np.ndarray, other: np.ndarray) -> float:
    """Largest distance between points, in head heights."""
    return float(np.linalg.norm(one - other, axis=-1).max() / face.head_height)
