"""What an export loses, and how far the influences that it leaves out move points."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Animation, FaceParts, Mesh, PhotoView, Skeleton, Slider
from facepipe.rig.trs import accumulate
from facepipe_gltf.baking import Baked
from facepipe_gltf.influences import LOST, merge
from facepipe_gltf.options import Options
from facepipe_gltf.placement import Space
from facepipe_gltf.record_format import NONE

_UNNORMALISED = 1e-4
_LISTED = 3
_STILL = 1e-13  # vertex matrices nearer to the identity than this are at rest but for rounding


def dropped(parts: FaceParts, meshes: Sequence[Baked], options: Options, recorded: FaceParts | None) -> tuple[str, ...]:
    """What the file does not hold of the face, one line a kind.

    :param recorded: what the file's record holds of the face; None: no record
    """
    written = {baked.mesh.name for baked in meshes}
    faceless = [mesh.name for mesh in parts.meshes if mesh.name not in written]
    lines = _counted("mesh without faces", "meshes without faces", faceless)
    lines += _loose(parts, written, recorded)
    kept = recorded or FaceParts()
    there = {mesh.name: mesh for mesh in kept.meshes}
    none = Mesh(name="", points=NONE, face_vertex_counts=NONE, face_vertex_indices=NONE)
    pairs = [(mesh, there.get(mesh.name, none)) for mesh in parts.meshes]
    lines += _per_mesh("region", {one.name: one.regions.keys() - other.regions.keys() for one, other in pairs})
    subsets = {one.name: one.point_subsets.keys() - other.point_subsets.keys() for one, other in pairs}
    lines += _per_mesh("point subset", subsets)
    flat = [name for name, one in there.items() if not len(one.face_vertex_counts)]
    lines += _counted(
        "mesh whose polygons become triangles: some repeat a point",
        "meshes whose polygons become triangles: some repeat a point",
        flat,
    )
    lines += _counted("slider", "sliders", _missing(parts.sliders, kept.sliders))
    if parts.slider_network is not None and kept.slider_network is None:
        lines.append("learned network of the sliders")
    lines += _counted("camera of a photo", "cameras of photos", _missing(parts.photos, kept.photos))
    used = {name for baked in meshes for name in _materials(baked.mesh)} | {one.name for one in kept.materials}
    unused = [material.name for material in parts.materials if material.name not in used]
    lines += _counted("material that no mesh uses", "materials that no mesh uses", unused)
    if parts.attach_joint is not None and not any(baked.influences is not None for baked in meshes):
        lines.append(f"attach joint ({parts.attach_joint}): no joint of the file hangs below it")
    if parts.bone_limits is not None and kept.bone_limits is None:
        lines.append("bone limits")
    if parts.recipe is not None and recorded is None:
        lines.append("recipe")
    if parts.animations and not options.animations:
        lines.append(f"{len(parts.animations)} animations (--animations exports them)")
    if parts.skeleton.joints and options.mode != "morph" and not any(mesh.skin for mesh in parts.meshes):
        lines.append(f"{parts.skeleton.name}: {len(parts.skeleton.joints)} joints, no mesh is skinned to them")
    return tuple(lines)


def _loose(parts: FaceParts, written: Collection[str], recorded: FaceParts | None) -> list[str]:
    loose = {mesh.name: _loose_points(mesh) for mesh in parts.meshes if mesh.name in written}
    total, owners = sum(loose.values()), [name for name, count in loose.items() if count]
    if not total:
        return []
    line = f"{total} point{'s' * (total > 1)} that no face uses, on {listed_meshes(owners)}"
    return [line if recorded is None else f"skin weights and shapes of {line}"]


def _missing(own: Sequence[Slider] | Sequence[PhotoView], kept: Sequence[Slider] | Sequence[PhotoView]) -> list[str]:
    there = {one.name for one in kept}
    return [one.name for one in own if one.name not in there]


def skin_warnings(meshes: Sequence[Baked], most: int) -> list[str]:
    """A line for each mesh whose skin weights changed to keep the `most` largest influences."""
    lines = []
    for baked in meshes:
        if baked.influences is None or baked.mesh.skin is None:
            continue
        lost = baked.influences.lost
        if lost.max(initial=0.0) > LOST:
            lines.append(
                f"{baked.mesh.name}: {int((lost > LOST).sum())} points have more than {most} influences; up to "
                f"{lost.max():.3f} of a point's weight moved to the ones kept"
            )
        sums = np.asarray(baked.mesh.skin.joint_weights, dtype=np.float64).sum(axis=1)
        off = np.abs(sums - 1) > _UNNORMALISED
        if off.any():
            lines.append(f"{baked.mesh.name}: skin weights of {int(off.sum())} points did not sum to 1, renormalised")
    return lines


def _materials(mesh: Mesh) -> set[str | None]:
    """Materials that some face shows: the mesh's own where a face has none of its own."""
    by_face = [material_face for material_face in mesh.material_faces if len(material_face.faces)]
    covered = len(np.unique(np.concatenate([one.faces for one in by_face]))) if by_face else 0
    own = {mesh.material} if covered < len(mesh.face_vertex_counts) else set()
    return own | {one.material for one in by_face}


def _loose_points(mesh: Mesh) -> int:
    used = np.zeros(len(mesh.points), np.bool_)
    used[mesh.face_vertex_indices] = True
    return int((~used).sum())


def _per_mesh(kind: str, names: Mapping[str, Iterable[str]]) -> list[str]:
    """One line for all meshes that have some."""
    owners = [mesh for mesh, own in names.items() if any(True for _ in own)]
    every = sorted({name for own in names.values() for name in own})
    return [f"{line} on {listed_meshes(owners)}" for line in _counted(kind, f"{kind}s", every)]


def _counted(singular: str, plural: str, names: Sequence[str]) -> list[str]:
    """At most one line: how many, and the names of a few."""
    if not names:
        return []
    few = names if len(names) <= _LISTED else [names[0], "...", names[-1]]
    return [f"{len(names)} {singular if len(names) == 1 else plural} ({', '.join(few)})"]


def listed_meshes(names: Sequence[str]) -> str:
    """One mesh by its name, several by their number."""
    return names[0] if len(names) == 1 else f"{len(names)} meshes"


def influence_error(parts: FaceParts, meshes: Sequence[Baked], space: Space) -> float | None:
    """Largest distance in metres that left-out influences move a point by, over the face's poses and animations.

    None where no influence is left out or there is no pose to measure at.
    """
    changes = [_change(mesh, len(parts.skeleton.joints)) for mesh in meshes if mesh.influences is not None]
    changes = [change for change in changes if len(change.points)]
    if not changes:
        return None
    skeleton = parts.skeleton
    poses = _poses(parts.animations, skeleton)
    if poses is None:
        return None
    worlds = accumulate(space.local(poses, skeleton.parents < 0), skeleton.parents)
    matrices = worlds @ space.inverse_binds(np.asarray(skeleton.bind_transforms, dtype=np.float64))
    return max(_longest_shift(change, matrices) for change in changes)


class _Change(NamedTuple):
    """What happens to the weights of those points of a mesh that lose influences."""

    points: FloatArray  # (n, 3) metres
    weights: FloatArray  # (j, n), summing to 0 for each point


def _change(baked: Baked, joint_count: int) -> _Change:
    if baked.influences is None or baked.mesh.skin is None:
        return _Change(np.zeros((0, 3)), np.zeros((joint_count, 0)))
    points = np.flatnonzero(baked.influences.lost > LOST)
    change = np.zeros((joint_count, len(points)))
    columns = np.arange(len(points))[:, None]
    joints, weights = merge(baked.mesh.skin, points)
    np.add.at(change, (joints, columns), -weights / weights.sum(axis=1, keepdims=True))
    np.add.at(change, (baked.influences.joints[points], columns), baked.influences.weights[points])
    return _Change(baked.points[points], change)


def _poses(animations: Sequence[Animation], skeleton: Skeleton) -> FloatArray | None:
    """(T, j, 4, 4) local matrices of every key of every animation that moves a joint; None: no animation does."""
    from facepipe.rig.animation import local_transforms

    number = {joint: i for i, joint in enumerate(skeleton.joints)}
    poses = []
    for animation in _joined(animations):
        rows = [i for i, joint in enumerate(animation.joints) if joint in number]
        if rows:
            used = np.array([number[animation.joints[i]] for i in rows])
            keys = local_transforms(skeleton, animation, np.array(rows))
            every = np.empty((len(keys), *skeleton.rest_transforms.shape))
            every[:] = skeleton.rest_transforms
            every[:, used] = keys
            poses.append(every)
    return np.concatenate(poses) if poses else None


def _joined(animations: Sequence[Animation]) -> list[Animation]:
    """Animations of bone coefficients for the same joints as one: faces have a pose for every shape."""
    groups: dict[tuple[str, ...], list[FloatArray]] = {}
    others = []
    for animation in animations:
        if animation.coefficients is None:
            others.append(animation)
        else:
            groups.setdefault(animation.joints, []).append(np.asarray(animation.coefficients))
    return others + [
        Animation(name="", joints=joints, coefficients=np.concatenate(keys)) for joints, keys in groups.items()
    ]


def _longest_shift(change: _Change, matrices: FloatArray) -> float:
    """Largest distance that the change of weights moves points by, under (T, j, 4, 4) matrices of vertices.

    The changes of a point's weights sum to 0, so only a joint's difference from the identity counts.
    """
    followed = np.flatnonzero(change.weights.any(axis=1))
    moves = np.swapaxes(matrices[:, followed, :3] - np.eye(3, 4), -1, -2)
    moving = np.abs(moves).max(axis=(2, 3)) > _STILL
    corners = np.concatenate([change.points.T, np.ones((1, len(change.points)))])
    weighted = change.weights[followed, None] * corners
    worst = 0.0
    for move, moved in zip(moves, moving, strict=True):
        # few joints move in a pose: these products stay too small for BLAS to wake its threads
        shifts = move[moved].reshape(-1, 3).T @ weighted[moved].reshape(-1, len(change.points))
        worst = max(worst, float(np.einsum("in,in->n", shifts, shifts).max(initial=0.0)))
    return float(np.sqrt(worst))
