"""What an export loses, said in the report."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np

from facepipe.parts import FaceParts, Mesh, PhotoView, Slider
from facepipe_gltf.baking import Baked
from facepipe_gltf.influences import LOST
from facepipe_gltf.options import Options
from facepipe_gltf.record_format import NONE

_UNNORMALISED = 1e-4
_LISTED = 3


def dropped(parts: FaceParts, meshes: Sequence[Baked], options: Options, recorded: FaceParts | None) -> tuple[str, ...]:
    """Everything of the face that the file does not hold, one line a kind.

    :param recorded: what the file keeps of the face beside what glTF has a place for; None: nothing
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
    lines += _counted("mesh's polygons, it has some that repeat a point", "meshes' polygons, some repeat a point", flat)
    lines += _counted("slider", "sliders", _missing(parts.sliders, kept.sliders))
    if parts.slider_network is not None and kept.slider_network is None:
        lines.append("learned network of the sliders")
    lines += _counted("camera of a photo", "cameras of photos", _missing(parts.photos, kept.photos))
    used = {name for baked in meshes for name in _materials(baked.mesh)} | {one.name for one in kept.materials}
    unused = [material.name for material in parts.materials if material.name not in used]
    lines += _counted("material that no mesh uses", "materials that no mesh uses", unused)
    if parts.attach_joint is not None and not any(baked.influences is not None for baked in meshes):
        lines.append(f"attach joint ({parts.attach_joint}): the file has no joints that hang under it")
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
    line = f"{total} point{'s' * (total > 1)} that no face uses, on {meshes_said(owners)}"
    return [line if recorded is None else f"skin weights and shapes of {line}"]


def _missing(own: Sequence[Slider] | Sequence[PhotoView], kept: Sequence[Slider] | Sequence[PhotoView]) -> list[str]:
    there = {one.name for one in kept}
    return [one.name for one in own if one.name not in there]


def skin_warnings(meshes: Sequence[Baked], most: int) -> list[str]:
    """Lines about skin weights that had to change to keep the `most` largest influences."""
    lines = []
    for one in meshes:
        if one.influences is None or one.mesh.skin is None:
            continue
        lost = one.influences.lost
        if lost.max(initial=0.0) > LOST:
            lines.append(
                f"{one.mesh.name}: {int((lost > LOST).sum())} points have more than {most} influences; up to "
                f"{lost.max():.3f} of a point's weight moved to the ones kept"
            )
        sums = np.asarray(one.mesh.skin.joint_weights, dtype=np.float64).sum(axis=1)
        off = np.abs(sums - 1) > _UNNORMALISED
        if off.any():
            lines.append(f"{one.mesh.name}: skin weights of {int(off.sum())} points did not sum to 1, renormalised")
    return lines


def _materials(mesh: Mesh) -> set[str | None]:
    """Those that some face shows: the mesh's own where the faces' own leave it one."""
    by_face = [one for one in mesh.material_faces if len(one.faces)]
    covered = len(np.unique(np.concatenate([one.faces for one in by_face]))) if by_face else 0
    own = {mesh.material} if covered < len(mesh.face_vertex_counts) else set()
    return own | {one.material for one in by_face}


def _loose_points(mesh: Mesh) -> int:
    used = np.zeros(len(mesh.points), np.bool_)
    used[mesh.face_vertex_indices] = True
    return int((~used).sum())


def _per_mesh(what: str, names: Mapping[str, Iterable[str]]) -> list[str]:
    """One line for all meshes that have some."""
    owners = [mesh for mesh, own in names.items() if any(True for _ in own)]
    every = sorted({name for own in names.values() for name in own})
    return [f"{line} on {meshes_said(owners)}" for line in _counted(what, f"{what}s", every)]


def _counted(one: str, many: str, names: Sequence[str]) -> list[str]:
    """At most one line: how many, and the names of a few."""
    if not names:
        return []
    few = names if len(names) <= _LISTED else [names[0], "...", names[-1]]
    return [f"{len(names)} {one if len(names) == 1 else many} ({', '.join(few)})"]


def meshes_said(names: Sequence[str]) -> str:
    """One mesh by its name, several by their number."""
    return names[0] if len(names) == 1 else f"{len(names)} meshes"
