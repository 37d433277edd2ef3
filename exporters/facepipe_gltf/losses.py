"""What an export loses, said in the report."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from facepipe.parts import FaceParts, FloatArray, Mesh
from facepipe_gltf.animations import local_matrices
from facepipe_gltf.baking import Baked
from facepipe_gltf.influences import merge
from facepipe_gltf.options import Options
from facepipe_gltf.placement import accumulate
from facepipe_gltf.space import Space

_UNNORMALISED = 1e-4
_LOST = 1e-6
_LISTED = 3


def dropped(parts: FaceParts, meshes: Sequence[Baked], options: Options) -> tuple[str, ...]:
    """Everything of the face that the file does not hold, one line each."""
    written = {baked.mesh.name for baked in meshes}
    lines = [line for mesh in parts.meshes for line in _mesh_lines(mesh, mesh.name in written)]
    lines += _per_mesh("regions", {mesh.name: mesh.regions for mesh in parts.meshes})
    lines += _per_mesh("point subsets", {mesh.name: mesh.point_subsets for mesh in parts.meshes})
    if parts.sliders:
        lines.append(f"{len(parts.sliders)} sliders")
    if parts.bone_limits is not None:
        lines.append("bone limits")
    if parts.recipe is not None:
        lines.append("recipe")
    if parts.animations and not options.animations:
        lines.append(f"{len(parts.animations)} animations (--animations exports them)")
    if parts.skeleton.joints and options.mode != "morph" and not any(mesh.skin for mesh in parts.meshes):
        lines.append(f"{parts.skeleton.name}: {len(parts.skeleton.joints)} joints, no mesh is skinned to them")
    return tuple(lines)


def skin_warnings(meshes: Sequence[Baked], most: int) -> list[str]:
    """Lines about skin weights that had to change to keep the `most` largest influences."""
    lines = []
    for one in meshes:
        if one.influences is None or one.mesh.skin is None:
            continue
        lost = one.influences.lost
        if lost.max(initial=0.0) > _LOST:
            lines.append(
                f"{one.mesh.name}: {int((lost > _LOST).sum())} points have more than {most} influences; up to "
                f"{lost.max():.3f} of a point's weight moved to the ones kept"
            )
        sums = np.asarray(one.mesh.skin.joint_weights, dtype=np.float64).sum(axis=1)
        off = np.abs(sums - 1) > _UNNORMALISED
        if off.any():
            lines.append(f"{one.mesh.name}: skin weights of {int(off.sum())} points did not sum to 1, renormalised")
    return lines


def influence_error(parts: FaceParts, meshes: Sequence[Baked], space: Space) -> float | None:
    """Largest distance in metres that the influences left out move a point, over the face's poses and animations.

    None where no influence is left out or there is no pose to measure at.
    """
    skinned = [one for one in meshes if one.influences is not None and one.influences.lost.max(initial=0.0) > _LOST]
    poses = [pose for animation in parts.animations for pose in _poses(parts, animation.name)]
    if not skinned or not poses:
        return None
    skeleton = parts.skeleton
    roots = skeleton.parents < 0
    worlds = accumulate(space.local(np.stack(poses), roots), skeleton.parents)
    matrices = worlds @ space.inverse_binds(np.asarray(skeleton.bind_transforms, dtype=np.float64))
    return max(_longest_shift(one, matrices) for one in skinned)


def _poses(parts: FaceParts, name: str) -> Iterable[FloatArray]:
    """(j, 4, 4) local matrices of each key of an animation; nothing where it moves no joint."""
    animation = next(one for one in parts.animations if one.name == name)
    number = {joint: i for i, joint in enumerate(parts.skeleton.joints)}
    own = [i for i, joint in enumerate(animation.joints) if joint in number]
    if not own:
        return
    used = np.array([number[animation.joints[i]] for i in own])
    for key in local_matrices(animation, parts.skeleton, np.array(own), used):
        local = np.array(parts.skeleton.rest_transforms, dtype=np.float64)
        local[used] = key
        yield local


def _longest_shift(baked: Baked, matrices: FloatArray) -> float:
    """How far the change of weights moves points under (T, j, 4, 4) matrices of vertices."""
    if baked.influences is None or baked.mesh.skin is None:
        return 0.0
    points = np.flatnonzero(baked.influences.lost > _LOST)
    change = np.zeros((len(points), matrices.shape[1]))
    rows = np.arange(len(points))[:, None]
    joints, weights = merge(baked.mesh.skin)
    total = weights[points].sum(axis=1, keepdims=True)
    np.add.at(change, (rows, joints[points]), -weights[points] / total)
    np.add.at(change, (rows, baked.influences.joints[points]), baked.influences.weights[points])
    corners = np.concatenate([baked.points[points], np.ones((len(points), 1))], axis=1)
    worst = 0.0
    for pose in matrices:
        blended = (change @ pose[:, :3].reshape(len(pose), 12)).reshape(-1, 3, 4)
        worst = max(worst, float(np.linalg.norm(np.einsum("nij,nj->ni", blended, corners), axis=1).max(initial=0.0)))
    return worst


def _mesh_lines(mesh: Mesh, is_written: bool) -> list[str]:
    if not is_written:
        return [f"{mesh.name}: a mesh without faces"]
    used = np.zeros(len(mesh.points), np.bool_)
    used[mesh.face_vertex_indices] = True
    loose = int((~used).sum())
    return [f"{mesh.name}: {loose} points that no face uses"] if loose else []


def _per_mesh(what: str, names: dict[str, Iterable[str]]) -> list[str]:
    """One line for all meshes that have some."""
    owners = [mesh for mesh, own in names.items() if list(own)]
    if not owners:
        return []
    every = sorted({name for own in names.values() for name in own})
    where = ", ".join(owners) if len(owners) <= _LISTED else f"{len(owners)} meshes"
    return [f"{what} of {where}: {', '.join(every)}"]
