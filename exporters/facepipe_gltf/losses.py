"""Checks of a face before an export, what the export loses, and how far influences left out move points."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import ExportError
from facepipe.parts import (
    Animation,
    Blendshape,
    FaceParts,
    Inbetween,
    Mesh,
    Skeleton,
    TextureInput,
)
from facepipe.rig.sliders import modes_line
from facepipe.rig.trs import accumulate
from facepipe_gltf.baking import Baked
from facepipe_gltf.buffers import LOST, merge
from facepipe_gltf.options import Options
from facepipe_gltf.placement import Space
from facepipe_gltf.record_format import NONE

_LARGEST = float(np.finfo(np.float32).max)
_UNNORMALISED = 1e-4
_LISTED = 3
_STILL = 1e-13  # vertex matrices nearer to the identity than this are at rest but for rounding


def check(parts: FaceParts) -> None:
    """Finite numbers, counts that fit each other, indices in range.

    :raises ExportError: naming the first array that is wrong
    """
    _finite(f"{parts.name} -> metersPerUnit", parts.meters_per_unit)
    if not parts.meters_per_unit > 0:
        raise ExportError(f"{parts.name} -> metersPerUnit", f"{parts.meters_per_unit:g}, expected above 0")
    skeleton, where = parts.skeleton, f"{parts.name} -> {parts.skeleton.name}"
    _invertible(f"{where} -> transform", skeleton.transform)
    for name in ("bind_transforms", "rest_transforms"):
        _array(f"{where} -> {name}", getattr(skeleton, name), (len(skeleton.joints), 4, 4))
    singular = np.flatnonzero(_singular(np.asarray(skeleton.bind_transforms, dtype=np.float64)))
    if len(singular):  # all at once, and the first by name: most skeletons have none
        _invertible(
            f"{where} -> {skeleton.joints[singular[0]]} -> bind transform", skeleton.bind_transforms[singular[0]]
        )
    if (skeleton.parents >= np.arange(len(skeleton.joints))).any():
        raise ExportError(where, "a joint comes before its parent, expected parents first")
    for mesh in parts.meshes:
        _mesh(f"{parts.name} -> {mesh.name}", mesh, len(parts.skeleton.joints))
    for animation in parts.animations:
        where, count = f"{parts.name} -> {animation.name}", animation.samples
        moved, shapes = len(animation.joints), len(animation.shapes)
        for name, width in (("translations", 3), ("rotations", 4), ("scales", 3), ("coefficients", 9)):
            _array(f"{where} -> {name}", getattr(animation, name), (count, moved, width))
        if animation.rotations is not None and (np.linalg.norm(animation.rotations, axis=-1) < 1e-6).any():
            raise ExportError(f"{where} -> rotations", "a quaternion of length 0, expected unit length")
        _array(f"{where} -> shape weights", animation.shape_weights, (count, shapes))
        if animation.times is not None:
            _finite(f"{where} -> times", animation.times)
            if count == 0 or (np.diff(np.asarray(animation.times, dtype=np.float32)) <= 0).any():
                what = "not ascending in float32, expected at least one time, each later"
                raise ExportError(f"{where} -> times", what)
    for material in parts.materials:
        for name, value in vars(material).items():
            numbers = (*value.scale, *value.bias) if isinstance(value, TextureInput) else value
            if isinstance(numbers, float | int | tuple):
                _finite(f"{parts.name} -> {material.name} -> {name}", numbers)


def _mesh(where: str, mesh: Mesh, joint_count: int) -> None:
    count, corners = len(mesh.points), len(mesh.face_vertex_indices)
    _shape(f"{where} -> points", mesh.points, (count, 3))
    for name in ("points", "normals", "colors"):
        if getattr(mesh, name) is not None:
            _finite(f"{where} -> {name}", getattr(mesh, name))
    for name, mask in mesh.regions.items():
        _finite(f"{where} -> {name}", mask)
    _invertible(f"{where} -> transform", mesh.transform)
    if int(np.sum(mesh.face_vertex_counts)) != corners:
        what = f"{corners} indices, expected {int(np.sum(mesh.face_vertex_counts))}"
        raise ExportError(f"{where} -> faceVertexIndices", what)
    _indices(f"{where} -> faceVertexIndices", mesh.face_vertex_indices, count)
    if mesh.normals is not None and len(mesh.normals) not in (count, corners):
        raise ExportError(f"{where} -> normals", f"{len(mesh.normals)} values, expected {count} or {corners}")
    if mesh.colors is not None:
        _shape(f"{where} -> colors", mesh.colors, (count, 3))
    for uv_set in mesh.uv_sets:
        _finite(f"{where} -> {uv_set.name}", uv_set.values)
        if uv_set.indices is None:
            _shape(f"{where} -> {uv_set.name}", uv_set.values, (count, 2))
        else:
            _shape(f"{where} -> {uv_set.name} -> indices", uv_set.indices, (corners,))
            _indices(f"{where} -> {uv_set.name} -> indices", uv_set.indices, len(uv_set.values))
    for one in mesh.material_faces:
        _indices(f"{where} -> {one.material} -> faces", one.faces, len(mesh.face_vertex_counts))
    if mesh.skin is not None:
        skin = mesh.skin
        width = np.shape(skin.joint_weights)[-1]
        _shape(f"{where} -> jointWeights", skin.joint_weights, (count, width))
        _shape(f"{where} -> jointIndices", skin.joint_indices, (count, width))
        _finite(f"{where} -> jointWeights", skin.joint_weights)
        _invertible(f"{where} -> geomBindTransform", skin.geom_bind_transform)
        _indices(f"{where} -> jointIndices", skin.joint_indices, joint_count)
    for shape in mesh.blendshapes:
        at, indices = f"{where} -> {shape.name}", np.asarray(shape.point_indices)
        # a sparse accessor needs ascending numbers, and a dense one would keep the last offset of a point alone
        if not (indices[1:] > indices[:-1]).all():
            raise ExportError(f"{at} -> pointIndices", "not ascending, expected each point once, in order")
        _indices(f"{at} -> pointIndices", indices, count)
        _offsets(at, shape, (len(indices), 3))
        for between in shape.inbetweens:
            _offsets(f"{at} -> {between.name}", between, (len(indices), 3))
            _finite(f"{at} -> {between.name} -> weight", between.weight)


def _offsets(where: str, sculpt: Blendshape | Inbetween, expected: tuple[int, ...]) -> None:
    for name, array in (("offsets", sculpt.offsets), ("normalOffsets", sculpt.normal_offsets)):
        _array(f"{where} -> {name}", array, expected)


def _finite(where: str, values: Any) -> None:
    array = np.asarray(values)
    finite = np.isfinite(array) if array.dtype == np.float32 else np.abs(array.astype(np.float64)) <= _LARGEST
    if not finite.all():
        raise ExportError(where, "NaN, infinity or beyond float32, expected finite numbers")


def _invertible(where: str, matrix: Any) -> None:
    _finite(where, matrix)
    if _singular(np.asarray(matrix, dtype=np.float64)):
        raise ExportError(where, "singular matrix, expected an invertible one")


def _singular(matrices: FloatArray) -> npt.NDArray[np.bool_]:
    """(...,) of (..., 4, 4)."""
    linear = matrices[..., :3, :3]
    size = np.abs(linear).max(axis=(-1, -2), keepdims=True, initial=0.0)
    return np.asarray(np.abs(np.linalg.det(linear / np.where(size == 0, 1.0, size))) < 1e-12)


def _shape(where: str, array: Any, expected: tuple[int, ...]) -> None:
    if np.shape(array) != expected:
        raise ExportError(where, f"array of shape {np.shape(array)}, expected {expected}")


def _array(where: str, array: Any, expected: tuple[int, ...]) -> None:
    if array is not None:
        _shape(where, array, expected)
        _finite(where, array)


def _indices(where: str, indices: Any, count: int) -> None:
    array = np.asarray(indices)
    if array.size and (array.min() < 0 or array.max() >= count):
        raise ExportError(where, f"index outside 0..{count - 1}")


def dropped(parts: FaceParts, meshes: Sequence[Baked], options: Options, recorded: FaceParts | None) -> tuple[str, ...]:
    """What the file does not hold of the face, one line a kind.

    :param recorded: what the file's record holds of the face; None: no record
    """
    written = {baked.mesh.name for baked in meshes}
    faceless = [mesh.name for mesh in parts.meshes if mesh.name not in written]
    lines = _counted("mesh without faces", "meshes without faces", faceless)
    shown = [mesh for mesh in parts.meshes if mesh.name in written]
    uses = {one.name: np.bincount(one.face_vertex_indices, minlength=len(one.points)) for one in shown}
    loose = {name: int(np.count_nonzero(counts == 0)) for name, counts in uses.items()}
    if total := sum(loose.values()):
        owners = listed_meshes([name for name, count in loose.items() if count])
        line = f"{total} point{'s' * (total > 1)} that no face uses, on {owners}"
        # the record has the places of such points, and no vertex of the file what else they had
        lines.append(line if recorded is None else f"skin weights and shapes of {line}")
    kept = recorded or FaceParts()
    there = {mesh.name: mesh for mesh in kept.meshes}
    none = Mesh(name="", points=NONE, face_vertex_counts=NONE, face_vertex_indices=NONE)
    pairs = [(mesh, there.get(mesh.name, none)) for mesh in parts.meshes]
    lines += _per_mesh("region", {one.name: one.regions.keys() - other.regions.keys() for one, other in pairs})
    subsets = {one.name: one.point_subsets.keys() - other.point_subsets.keys() for one, other in pairs}
    lines += _per_mesh("point subset", subsets)
    flat = [name for name, one in there.items() if not len(one.face_vertex_counts)]
    become = "whose polygons become triangles: some repeat a point"
    lines += _counted(f"mesh {become}", f"meshes {become}", flat)
    sliders, photos = {one.name for one in kept.sliders}, {one.name for one in kept.photos}
    gone = {one.name for one in parts.sliders if one.modes}
    lines += _counted("slider", "sliders", [one.name for one in parts.sliders if one.name not in sliders | gone])
    lines += modes_line(parts.sliders)
    if parts.slider_network is not None and kept.slider_network is None:
        lines.append("learned network of the sliders")
    unkept = [one.name for one in parts.photos if one.name not in photos]
    lines += _counted("camera of a photo", "cameras of photos", unkept)
    used = {name for baked in meshes for name in _materials(baked.mesh)} | {one.name for one in kept.materials}
    used |= {other for one in parts.materials if one.name in used for other in one.variants.values()}
    unused = [material.name for material in parts.materials if material.name not in used]
    lines += _counted("material that no mesh uses", "materials that no mesh uses", unused)
    if parts.attach_joint is not None and not any(baked.influences is not None for baked in meshes):
        lines.append(f"attach joint ({parts.attach_joint}): no joint of the file hangs below it")
    if parts.bone_limits is not None and kept.bone_limits is None:
        lines.append("bone limits")
    if parts.vrm:
        terms = "what VRM says of the avatar (terms, human bones, expressions ...)"
        lines.append(f"{terms}: {'for other programs, ' if recorded else ''}only a .vrm holds it")
    if parts.recipe is not None and recorded is None:
        lines.append("recipe")
    if parts.animations and not options.animations:
        lines.append(f"{len(parts.animations)} animations (--animations exports them)")
    if parts.skeleton.joints and options.mode != "morph" and not any(mesh.skin for mesh in parts.meshes):
        lines.append(f"{parts.skeleton.name}: {len(parts.skeleton.joints)} joints, no mesh is skinned to them")
    return tuple(lines)


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

    None where there is no pose to measure at.
    """
    skeleton = parts.skeleton
    poses = _poses(parts.animations, skeleton)
    if poses is None:
        return None
    worlds = accumulate(space.local(poses, skeleton.parents < 0), skeleton.parents)
    matrices = worlds @ space.inverse_binds(np.asarray(skeleton.bind_transforms, dtype=np.float64))
    worst = 0.0
    for baked in meshes:
        if baked.influences is None or baked.mesh.skin is None or not baked.influences.any_lost:
            continue
        # (j, n) changes of the weights of points that lose influences
        points = np.flatnonzero(baked.influences.lost > LOST)
        changes = np.zeros((len(skeleton.joints), len(points)))
        columns = np.arange(len(points))[:, None]
        joints, weights = merge(baked.mesh.skin, points)
        np.add.at(changes, (joints, columns), -weights / weights.sum(axis=1, keepdims=True))
        np.add.at(changes, (baked.influences.joints[points], columns), baked.influences.weights[points])
        # a point's changes sum to 0, so only a joint's difference from the identity counts
        followed = np.flatnonzero(changes.any(axis=1))
        moves = np.swapaxes(matrices[:, followed, :3] - np.eye(3, 4), -1, -2)
        moving = np.abs(moves).max(axis=(2, 3)) > _STILL
        corners = np.concatenate([baked.points[points].T, np.ones((1, len(points)))])
        weighted = changes[followed, None] * corners
        for move, moved in zip(moves, moving, strict=True):
            # few joints move in a pose: these products stay too small for BLAS to wake its threads
            shifts = move[moved].reshape(-1, 3).T @ weighted[moved].reshape(-1, len(points))
            worst = max(worst, float(np.einsum("in,in->n", shifts, shifts).max(initial=0.0)))
    return float(np.sqrt(worst))


def _poses(animations: Sequence[Animation], skeleton: Skeleton) -> FloatArray | None:
    """(T, j, 4, 4) local matrices of every key of every animation that moves a joint; None: no animation does."""
    from facepipe.rig.animation import local_transforms

    # animations of bone coefficients for the same joints are taken as one: faces have a pose for every shape
    groups: dict[tuple[str, ...], list[FloatArray]] = {}
    for animation in animations:
        if animation.coefficients is not None:
            groups.setdefault(animation.joints, []).append(np.asarray(animation.coefficients))
    joined = [one for one in animations if one.coefficients is None]
    joined += [Animation(name="", joints=one, coefficients=np.concatenate(all_)) for one, all_ in groups.items()]
    number = {joint: i for i, joint in enumerate(skeleton.joints)}
    poses = []
    for animation in joined:
        rows = [i for i, joint in enumerate(animation.joints) if joint in number]
        if rows:
            used = np.array([number[animation.joints[i]] for i in rows])
            keys = local_transforms(skeleton, animation, np.array(rows))
            every = np.empty((len(keys), *skeleton.rest_transforms.shape))
            every[:] = skeleton.rest_transforms
            every[:, used] = keys
            poses.append(every)
    return np.concatenate(poses) if poses else None
