"""What an export loses, said in the report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.parts import FaceParts, Mesh
from facepipe_gltf.baking import Baked
from facepipe_gltf.options import Options

_UNNORMALISED = 1e-4


def dropped(parts: FaceParts, options: Options) -> tuple[str, ...]:
    """Everything of the face that the file does not hold, one line each."""
    lines = [line for mesh in parts.meshes for line in _mesh_lines(mesh)]
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


def skin_warnings(meshes: Sequence[Baked]) -> list[str]:
    """Lines about skin weights that had to change."""
    lines = []
    for one in meshes:
        if one.influences is None or one.mesh.skin is None:
            continue
        lost = one.influences.lost
        if lost.size and lost.max() > 0:
            count = one.influences.joints.shape[1]
            points = int((lost > 0).sum())
            lines.append(
                f"{one.mesh.name}: {points} points have more than {count} influences; up to {lost.max():.3f} of the "
                "weight of a point moved to the others"
            )
        sums = np.asarray(one.mesh.skin.joint_weights, dtype=np.float64).sum(axis=1)
        off = np.abs(sums - 1) > _UNNORMALISED
        if off.any():
            lines.append(f"{one.mesh.name}: skin weights of {int(off.sum())} points did not sum to 1, renormalised")
    return lines


def _mesh_lines(mesh: Mesh) -> list[str]:
    if not (np.asarray(mesh.face_vertex_counts) >= 3).any():
        return [f"{mesh.name}: a mesh without faces"]
    lines = []
    loose = len(mesh.points) - len(np.unique(mesh.face_vertex_indices))
    if loose:
        lines.append(f"{mesh.name}: {loose} points that no face uses")
    if mesh.regions:
        lines.append(f"{mesh.name}: {len(mesh.regions)} regions ({', '.join(sorted(mesh.regions))})")
    if mesh.point_subsets:
        lines.append(f"{mesh.name}: {len(mesh.point_subsets)} point subsets ({', '.join(sorted(mesh.point_subsets))})")
    return lines
