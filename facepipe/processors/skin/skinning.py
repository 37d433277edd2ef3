"""A skeleton and weights, on the way to a face."""

from __future__ import annotations

from dataclasses import dataclass, replace

from facepipe.errors import InputError
from facepipe.geometry.heat_weights import influences
from facepipe.parts import FaceParts, FloatArray, Skeleton, Skin
from facepipe.processors.skin.report import TransferReport
from facepipe.processors.skin.surface import Surface
from facepipe.rig.build import mesh_spaces


@dataclass(frozen=True, kw_only=True)
class Skinning:
    """A skeleton and weights (m, j) of the sewn points of a face, before they are cut to few influences."""

    skeleton: Skeleton
    weights: FloatArray
    transfer: TransferReport | None = None
    warnings: tuple[str, ...] = ()


def check_joints(surface: Surface, parts: FaceParts, joints: tuple[str, ...]) -> None:
    """:raises InputError: the face has other joints"""
    old = parts.skeleton.joints
    if old and old != joints:
        raise InputError(surface.where, f"has {len(old)} joints, expected a face without, or with the same ones")


def skinned(parts: FaceParts, surface: Surface, skeleton: Skeleton, weights: FloatArray) -> FaceParts:
    """The face with the skeleton and the weights (m, j), whose rows have few influences each."""
    meshes, start = [], 0
    for mesh, space in zip(parts.meshes, mesh_spaces(parts), strict=True):
        rows = weights[surface.group[start : start + len(mesh.points)]]
        width = max(1, int((rows > 0).sum(axis=1).max(initial=0)))
        indices, values = influences(rows, width)
        skin = Skin(joint_indices=indices, joint_weights=values, geom_bind_transform=space)
        meshes.append(replace(mesh, skin=skin))
        start += len(mesh.points)
    return replace(parts, meshes=tuple(meshes), skeleton=skeleton)
