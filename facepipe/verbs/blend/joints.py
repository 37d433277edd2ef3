"""A source of a blend with the joints of the first one: found by name, by place, or carried on its surface."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.gradient_system import joint_bridges
from facepipe.geometry.vectors import group_sums, transformed
from facepipe.parts import FaceParts, Mesh, Skeleton
from facepipe.rig import mesh_spaces
from facepipe.rig.joint_names import joint_key
from facepipe.rig.rig import inverse
from facepipe.rig.trs import rest_worlds

# Of the place that a joint would be carried to: within it a joint of another name is that joint. Half the way to the
# next joint, no less and no more than these: jaws of drawn people lie 6 mm off, joints of lips 5 mm from the next.
_NEAR_MM = (3.0, 10.0)
_SHOWN = 3  # names of a list


def with_joints(
    base: FaceParts, base_name: str, source: FaceParts, name: str, to_base: FloatArray
) -> tuple[FaceParts, tuple[str, ...]]:
    """`source` with the joints of `base`, in its order, and what the user should know of how they were found.

    A joint is the one of the same path, else of the same name (but for namespace, prefix, case and what it hangs
    under), else the nearest to where it would be carried to, within 3 mm or half the way to the next joint, up to
    10 mm. One that the source lacks altogether keeps its offset from the points around it, and the base's orientation
    and rest. Skin weights of joints that the base lacks go to the joint above that it has, or to the first root.

    :param to_base: (4, 4) from the source's bind space to the base's
    :raises TopologyError: a singular bind transform
    """
    own, wanted = source.skeleton, base.skeleton
    if own.joints == wanted.joints:
        return source, ()
    for where, skeleton in ((base_name, wanted), (name, own)):
        for joint, bind in zip(skeleton.joints, skeleton.bind_transforms, strict=True):
            inverse(bind, f"{where} -> {joint}")
    binds = to_base @ np.asarray(own.bind_transforms, dtype=np.float64).reshape(-1, 4, 4)
    carried = _carried(base, source, to_base)
    found = _by_name(wanted, own)
    mm = base.meters_per_unit * 1000.0 * float(np.cbrt(np.abs(np.linalg.det(wanted.transform[:3, :3]))))
    placed = _by_place(found, carried, binds[:, :3, 3], np.array(_NEAR_MM) / mm)
    lacking = np.flatnonzero(placed < 0)
    left = sorted({*range(len(own.joints))} - {*placed.tolist()})
    skeleton = _skeleton(wanted, own, placed, carried, to_base, name)
    above = _above(own, placed)
    near = [f"{own.joints[placed[joint]]} for {wanted.joints[joint]}" for joint in np.flatnonzero(placed != found)]
    lines = [
        f"{name}: joints found by their place, not by name: {_some(near)}" if near else "",
        f"{name}: joints that it lacks keep their place on the surface of {base_name}: "
        f"{_some([wanted.joints[joint] for joint in lacking])}"
        if len(lacking)
        else "",
        f"{name}: joints that {base_name} lacks are left out, their skin weights go to those above: "
        f"{_some([own.joints[joint] for joint in left])}"
        if left
        else "",
    ]
    meshes = tuple(_skinned(mesh, source, above if wanted.joints else None) for mesh in source.meshes)
    return replace(source, skeleton=skeleton, meshes=meshes), tuple(line for line in lines if line)


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return f"{len(names)} ({', '.join(names[:_SHOWN])}{more})"


def _by_name(base: Skeleton, own: Skeleton) -> IntArray:
    """(j,) number of each joint of the base in the source, -1 for none; a name that several joints have is none."""
    found = np.full(len(base.joints), -1, dtype=np.int64)

    def match(keys: Callable[[str, str], set[str]]) -> None:
        named: list[dict[str, list[int]]] = []
        for skeleton, taken in ((base, np.flatnonzero(found >= 0)), (own, found[found >= 0])):
            free: dict[str, list[int]] = defaultdict(list)
            for number, (path, called) in enumerate(zip(skeleton.joints, skeleton.names, strict=True)):
                for key in keys(path, called) if number not in taken else ():
                    free[key].append(number)
            named.append(free)
        for key, (joint, *others) in named[0].items():
            twins = named[1].get(key, [])
            if not others and len(twins) == 1 and twins[0] not in found:
                found[joint] = twins[0]

    match(lambda path, called: {path})
    match(lambda path, called: {called})
    match(lambda path, called: {joint_key(path.rpartition("/")[2]), joint_key(called)} - {""})
    return found


def _by_place(found: IntArray, carried: FloatArray, places: FloatArray, within: FloatArray) -> IntArray:
    """(j,) as `found`, with the joints of the source that are nearest to where others would be carried to.

    :param within: (2,) the least and the most of half the way to the next joint, in which they are found
    """
    placed = found.copy()
    joints, free = np.flatnonzero(found < 0), np.setdiff1d(np.arange(len(places)), found)
    apart = np.linalg.norm(carried[joints][:, None] - carried[None], axis=2)
    reach = np.clip(np.where(apart > 0, apart, np.inf).min(axis=1, initial=np.inf) / 2, *within)
    distances = np.linalg.norm(carried[joints][:, None] - places[free][None], axis=2)
    for flat in np.argsort(distances, axis=None, kind="stable"):
        row, column = np.unravel_index(flat, distances.shape)
        near = distances[row, column] <= reach[row]
        if near and placed[joints[row]] < 0 and free[column] not in placed:
            placed[joints[row]] = free[column]
    return placed


def _carried(base: FaceParts, source: FaceParts, to_base: FloatArray) -> FloatArray:
    """(j, 3) joints of the base as far from the points around them on the source as they are on the base."""
    joints = np.asarray(base.skeleton.bind_transforms, dtype=np.float64).reshape(-1, 4, 4)[:, :3, 3]
    named = {
        mesh.name: transformed(mesh.points, to_base @ space)
        for mesh, space in zip(source.meshes, mesh_spaces(source), strict=True)
    }
    pairs = [
        (transformed(mesh.points, space), named[mesh.name])
        for mesh, space in zip(base.meshes, mesh_spaces(base), strict=True)
        if mesh.name in named and len(named[mesh.name]) == len(mesh.points)
    ]
    if not pairs or not len(joints):
        return joints
    points, others = (np.concatenate(side) for side in zip(*pairs, strict=True))
    bridges = joint_bridges(points, joints)
    moves = (others - points)[bridges.leaders] * bridges.weights[:, None]
    total = np.bincount(bridges.followers, bridges.weights, minlength=len(joints))
    return np.asarray(joints + group_sums(bridges.followers, moves, len(joints)) / total[:, None])


def _skeleton(
    base: Skeleton, own: Skeleton, placed: IntArray, carried: FloatArray, to_base: FloatArray, name: str
) -> Skeleton:
    """The base's joints, bound and at rest as those of the source that they are, else as they are carried."""
    back = inverse(to_base, name)
    binds = np.asarray(base.bind_transforms, dtype=np.float64).reshape(-1, 4, 4)
    rests, known = rest_worlds(base), np.flatnonzero(placed >= 0)
    has, own_binds, own_rests = placed[known], np.asarray(own.bind_transforms, dtype=np.float64), rest_worlds(own)
    # a joint that is carried has axes as long as the base's, times what those of the others are longer by
    sizes = [np.cbrt(np.abs(np.linalg.det(one[:, :3, :3]))) for one in (own_binds[has], binds[known])]
    length = float(np.median(sizes[0] / sizes[1])) if len(known) else 1.0
    bind: FloatArray = back @ binds
    turned = back[:3, :3] / np.cbrt(np.abs(np.linalg.det(back[:3, :3])))
    bind[:, :3, :3] = length * (turned @ binds[:, :3, :3])
    bind[:, :3, 3] = transformed(carried, back)
    bind[known] = own_binds[has]
    # rest: what takes the base's joint there, in its own axes and relative to its parent; of a root, what takes the
    # source's joints there
    scale = 1.0 / (length * float(np.cbrt(np.abs(np.linalg.det(to_base[:3, :3])))))
    rest: FloatArray = bind.copy()
    whole = own_rests[has[0]] @ inverse(own_binds[has[0]], name) if len(known) else np.eye(4)
    for joint, parent in enumerate(base.parents):
        if placed[joint] >= 0:
            rest[joint] = own_rests[placed[joint]]
        elif parent < 0:
            rest[joint] = whole @ bind[joint]
        else:
            step = inverse(inverse(binds[parent], name) @ binds[joint], name)
            change = step @ inverse(rests[parent], name) @ rests[joint]
            change[:3, 3] *= scale
            rest[joint] = rest[parent] @ inverse(bind[parent], name) @ bind[joint] @ change
    local, parents = rest.copy(), own.parents
    for joint, parent in enumerate(base.parents):
        above = -1 if parent < 0 else placed[parent]
        if placed[joint] >= 0 and parents[placed[joint]] == above and (parent < 0 or above >= 0):
            local[joint] = own.rest_transforms[placed[joint]]  # to the bit
        elif parent >= 0:
            local[joint] = inverse(rest[parent], name) @ rest[joint]
    return replace(
        own,
        joints=base.joints,
        joint_names=base.joint_names,
        bind_transforms=bind,
        rest_transforms=local,
    )


def _above(own: Skeleton, placed: IntArray) -> IntArray:
    """(joints of the source,) number in the base of each: of the nearest above that it has, else of its first root."""
    numbers = np.zeros(len(own.joints), dtype=np.int32)
    known = {int(number): joint for joint, number in enumerate(placed) if number >= 0}
    for joint, parent in enumerate(own.parents):
        numbers[joint] = known.get(joint, numbers[parent] if parent >= 0 else 0)
    return numbers


def _skinned(mesh: Mesh, source: FaceParts, above: IntArray | None) -> Mesh:
    """The mesh with its skin on the joints of the base, or in its place without skin where the base has no joints."""
    if mesh.skin is None:
        return mesh
    if above is None:
        return replace(mesh, skin=None, transform=source.skeleton.transform @ mesh.skin.geom_bind_transform)
    return replace(mesh, skin=replace(mesh.skin, joint_indices=above[mesh.skin.joint_indices]))
