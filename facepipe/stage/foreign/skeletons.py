"""Which Skeleton of a foreign stage is the face's, and what its joints need to be read."""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray
from facepipe.core.errors import TopologyError
from facepipe.parts import Skeleton
from facepipe.stage.bindings import inherited_attribute, inherited_skeleton
from facepipe.stage.foreign.scene import Scene
from facepipe.stage.guard import reads_prim
from facepipe.stage.values import floats, matrices, to_floats, to_matrices


def choose_skeleton(scene: Scene, meshes: list[Usd.Prim], wanted: str | None) -> Usd.Prim | None:
    """The Skeleton of the face; None where the stage has none.

    :raises InputError: several Skeletons and no choice, or a choice that is no Skeleton
    """
    if wanted is not None:
        prim = scene.stage.GetPrimAtPath(wanted) if wanted.startswith("/") and wanted != "/" else None
        if not prim or not prim.IsA(UsdSkel.Skeleton):
            raise scene.error(f"no Skeleton at '{wanted}', expected the path of one")
        return prim
    named = dict.fromkeys(inherited_skeleton(mesh) for mesh in meshes)
    bound = [scene.stage.GetPrimAtPath(path) for path in named if path is not None and path.IsPrimPath()]
    there = [prim for prim in bound if prim and prim.IsA(UsdSkel.Skeleton)]
    candidates = there or [prim for prim in scene.prims if prim.IsA(UsdSkel.Skeleton)]
    if len(candidates) > 1:
        listed = ", ".join(str(prim.GetPath()) for prim in candidates)
        raise scene.error(f"{len(candidates)} Skeletons ({listed}), expected one; the option skeleton chooses")
    chosen = candidates[0] if candidates else None
    others = [prim for prim in scene.prims if prim.IsA(UsdSkel.Skeleton) and prim != chosen]
    if others:
        scene.warn("Skeleton that no mesh is bound to: left out", others)
    return chosen


def bind_to(scene: Scene, skeleton: Usd.Prim, meshes: list[Usd.Prim]) -> list[Usd.Prim]:
    """The meshes that are the skeleton's; those bound to nothing are bound to it."""
    bound, loose, others = [], [], []
    for mesh in meshes:
        path = inherited_skeleton(mesh)
        target = scene.stage.GetPrimAtPath(path) if path is not None and path.IsPrimPath() else None
        if target and target.IsA(UsdSkel.Skeleton) and target != skeleton:
            others.append(mesh)
            continue
        bound.append(mesh)
        if target != skeleton and inherited_attribute(mesh, "primvars:skel:jointIndices"):
            loose.append(mesh)
            UsdSkel.BindingAPI.Apply(mesh).CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    if loose:
        scene.warn(f"influences, but no Skeleton: taken as bound to <{skeleton.GetPath()}>", loose)
    if others:
        scene.warn("bound to another Skeleton: left out", others)
    return bound


@reads_prim
def mend_skeleton(prim: Usd.Prim, scene: Scene, meshes: list[Usd.Prim]) -> None:
    """Joints parent first, and both kinds of transforms for each.

    :raises TopologyError: neither bind nor rest transforms that fit the joints
    """
    skeleton = UsdSkel.Skeleton(prim)
    joints = [str(joint) for joint in skeleton.GetJointsAttr().Get() or []]
    order = parents_first(joints)
    bind, rest = _both_transforms(scene, skeleton, joints)
    if order != list(range(len(joints))):
        scene.warn("joints stand before their parents: reordered", [prim])
        for mesh in meshes:
            if not inherited_attribute(mesh, "skel:joints"):  # its indices count the old order
                UsdSkel.BindingAPI.Apply(mesh).CreateJointsAttr(joints)
    skeleton.CreateJointsAttr([joints[i] for i in order])
    _mend_names(scene, skeleton, order)
    skeleton.CreateBindTransformsAttr(to_matrices(bind[order]))
    skeleton.CreateRestTransformsAttr(to_matrices(rest[order]))
    for name in (tokens.LIMITS_LOWER, tokens.LIMITS_UPPER):
        limits = prim.GetAttribute(name)
        values = floats(limits.Get())
        if len(values) == 9 * len(joints) > 0:
            limits.Set(to_floats(values.reshape(-1, 9)[order].ravel()))


def _mend_names(scene: Scene, skeleton: UsdSkel.Skeleton, order: list[int]) -> None:
    names = [str(name) for name in skeleton.GetJointNamesAttr().Get() or []]
    if names and len(names) != len(order):
        scene.warn(f"{len(names)} names of {len(order)} joints: left out", [skeleton.GetPrim()])
        skeleton.GetJointNamesAttr().Block()
    elif names:
        skeleton.CreateJointNamesAttr([names[i] for i in order])


def parents_first(joints: list[str]) -> list[int]:
    """Indices of joint paths, each after its ancestors, otherwise in the order given."""
    place = {joint: i for i, joint in reversed(list(enumerate(joints)))}
    order: dict[int, None] = {}
    for i, joint in enumerate(joints):
        parts = joint.split("/")
        above = [place.get("/".join(parts[:depth])) for depth in range(1, len(parts))]
        order.update(dict.fromkeys([ancestor for ancestor in above if ancestor is not None]))
        order[i] = None
    return list(order)


def _both_transforms(scene: Scene, skeleton: UsdSkel.Skeleton, joints: list[str]) -> tuple[FloatArray, FloatArray]:
    """(j, 4, 4) bind transforms in world space and rest transforms relative to the parent."""
    prim, count = skeleton.GetPrim(), len(joints)
    bind = matrices(skeleton.GetBindTransformsAttr().Get())
    rest = matrices(skeleton.GetRestTransformsAttr().Get())
    parents = Skeleton(joints=tuple(joints)).parents.tolist()
    if len(bind) != count and len(rest) != count:
        found = f"{len(bind)} bind and {len(rest)} rest transforms"
        raise TopologyError(str(prim.GetPath()), f"{found}, expected {count} of one of them")
    world = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())).T
    if len(rest) != count:
        scene.warn(f"{len(rest)} rest transforms of {count} joints: taken from bind transforms", [prim])
        # rest_j = inverse(bind_parent) bind_j; binds are in the world, so above a root is the place of the prim
        above = [bind[parent] if parent >= 0 else world for parent in parents]
        rest = np.array([_solved(parent, own) for parent, own in zip(above, bind, strict=True)]).reshape(-1, 4, 4)
    if len(bind) != count:
        scene.warn(f"{len(bind)} bind transforms of {count} joints: taken from rest transforms", [prim])
        bind = np.empty((count, 4, 4))
        for i in parents_first(joints):
            bind[i] = (bind[parents[i]] if parents[i] >= 0 else world) @ rest[i]
    return bind, rest


def _solved(parent: FloatArray, child: FloatArray) -> FloatArray:
    try:
        return np.asarray(np.linalg.solve(parent, child))
    except np.linalg.LinAlgError:
        return np.full((4, 4), np.nan)  # the reader refuses it
