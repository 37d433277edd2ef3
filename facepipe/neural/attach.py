"""A face that a neural rig moves: its controls are sliders, its hidden layer their network, its basis blendshapes.

Nothing that the face had is taken away for it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.threads import one_thread
from facepipe.declare import check_ranges
from facepipe.geometry.vectors import transformed
from facepipe.neural.attached_sliders import (
    BakedClips,
    at_rest,
    baked_clips,
    clip_shape_name,
    kept_sliders,
    neural_network,
    neural_sliders,
    own_shapes,
    shape_name,
)
from facepipe.neural.options import AttachOptions
from facepipe.parts import Animation, Blendshape, FaceParts, Mesh, PhotoView, Skin
from facepipe.rig import build, mesh_spaces
from facepipe.rig.neural_rig import NeuralRig, bones_in, most_influences, output_reach, with_influences
from facepipe.rig.sliders import with_mutual_mirrors
from facepipe.verbs.same_topology import MILLIMETRES, check_spaces, world_to_world
from facepipe.verbs.whole_faces import Topology

_SAME = 2.0**-22  # of the largest coordinate: two roundings to float32
_MATRIX = 1e-3  # millimetres, or of a rotation, by which joints may differ
_WEIGHT = 1e-5  # of a skin weight, float32 and half way between


@dataclass(frozen=True, kw_only=True)
class AttachedNeuralRig:
    """A face with a neural rig, and what it had."""

    parts: FaceParts
    dropped_mm: float  # by which points can be off for what shapes leave out, with activations from -1 to 1
    shapes: int  # of the rig
    offsets: int  # that these hold, of all meshes
    clips_mm: float  # by which points of clips are off at most, where they play shapes for what the skin doesn't do
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class AttachNeuralRig:
    """Puts a neural rig on a face of the meshes that it was learned on.

    Its controls are sliders in place of those of the same names. All else stays: skeleton, regions, materials, limits,
    other sliders, the face's own shapes, clips. With bones the joints and skin of the face must be those of the rig;
    of a rig with fewer influences the face gets these, and clips that turn joints play shapes for the difference.
    Without bones what was skinned follows the first joint rigidly, so that it isn't skinned twice and still goes with
    the body; its points are the rig's at rest, and clips that turn joints play shapes for what the first joint doesn't
    do. Shapes are scaled so that their weights stay about within -1..1 over the ranges of the controls.
    """

    options: AttachOptions = field(default_factory=AttachOptions)

    @one_thread()
    def __call__(self, parts: FaceParts, rig: NeuralRig, where: str) -> AttachedNeuralRig:
        """The face that the rig moves.

        :raises InputError: an option out of range, or a shape of the face that is called as one of the rig's
        :raises TopologyError: other meshes, joints or skin than the rig was learned on, or a singular space
        """
        check_ranges(self.options)
        check_neural_rig(parts, rig, where)
        whole, tolerance = rig, self.options.offset_tolerance_mm
        rig, scales, moved = _kept(whole, tolerance)
        kept_shapes = own_shapes(parts) if self.options.keep_shapes else frozenset()
        names = tuple(shape_name(number) for number in range(len(rig.shapes)))
        offsets = np.where(moved[..., None], rig.shapes * scales[:, None, None], 0.0)
        shapes = dict(zip(names, offsets, strict=True))
        clips = _clips(parts, rig, kept_shapes, shapes, tolerance)
        shapes |= {clip_shape_name(number): own_offsets for number, own_offsets in enumerate(clips.shapes)}
        _check_names(where, kept_shapes & shapes.keys())
        kept = kept_sliders(parts, rig, kept_shapes)
        attached = replace(
            parts,
            meshes=_meshes(parts, rig, kept_shapes, shapes),
            sliders=with_mutual_mirrors((*neural_sliders(parts, rig, scales), *kept)),
            slider_network=neural_network(parts, rig, scales),
            animations=clips.animations,
            photos=_photos(parts, clips.animations),
        )
        return AttachedNeuralRig(
            parts=attached,
            dropped_mm=_left_out(whole, tolerance),
            shapes=len(names),
            offsets=int(moved.sum()),
            clips_mm=clips.error_mm,
            warnings=_dropped(parts, attached, rig),
        )


def with_neural_rig(parts: FaceParts, rig: NeuralRig, where: str) -> FaceParts:
    """`AttachNeuralRig` with its default options: the face alone."""
    return AttachNeuralRig()(parts, rig, where).parts


def check_neural_rig(parts: FaceParts, rig: NeuralRig, where: str) -> None:
    """:raises TopologyError: other meshes, joints or skin than the rig was learned on, or a singular space"""
    if Topology.of(parts).digest != rig.topology:
        raise TopologyError(where, "other meshes than the neural rig was learned on, expected their names and faces")
    check_spaces(where, parts)
    if rig.bones is None:
        return
    if parts.skeleton.joints != rig.bones.joints:
        found, expected = len(parts.skeleton.joints), len(rig.bones.joints)
        raise TopologyError(where, f"{found} joints that differ, expected the {expected} that the neural rig moves")
    bones = bones_in(build(parts), world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES))
    for name, label in (("rest", "rest transforms"), ("inverse_bind", "bind transforms"), ("parent_world", "place")):
        if not np.allclose(getattr(bones, name), getattr(rig.bones, name), rtol=0, atol=_MATRIX):
            raise TopologyError(where, f"{label} of the skeleton differ, expected those that the neural rig moves")
    fewer = with_influences(bones, most_influences(rig.bones))
    if abs(fewer.influences - rig.bones.influences).max() > _WEIGHT:
        raise TopologyError(where, "skin weights differ, expected those that the neural rig moves")


def _spaces(parts: FaceParts, rig: NeuralRig) -> list[FloatArray]:
    """(4, 4) of every mesh from its space to that of the rig's rest points."""
    to = world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES)
    if rig.bones is not None:
        scale = np.cbrt(np.linalg.det(to[:3, :3]))
        return [np.diag([scale, scale, scale, 1.0]) @ space for space in mesh_spaces(parts)]
    skeleton = parts.skeleton
    followed = np.asarray(skeleton.transform, dtype=np.float64)
    carried = followed
    if skeleton.joints:
        carried = followed @ skeleton.rest_transforms[0] @ np.linalg.inv(skeleton.bind_transforms[0])
    return [
        to @ (carried if mesh.skin else followed) @ space
        for mesh, space in zip(parts.meshes, mesh_spaces(parts), strict=True)
    ]


def _kept(rig: NeuralRig, tolerance: float) -> tuple[NeuralRig, FloatArray, BoolArray]:
    """The rig with the shapes that move some point, (r,) their largest activations, and (r, n) whether they move it."""
    scales = output_reach(rig)[: len(rig.shapes)]
    moved = _moves(rig, scales) > tolerance
    used = moved.any(axis=1)
    outputs = np.concatenate([used, np.ones(len(rig.channels), bool)])
    kept = replace(
        rig,
        shapes=rig.shapes[used],
        linear=rig.linear[:, outputs],
        last=rig.last[outputs],
        last_bias=rig.last_bias[outputs],
    )
    return kept, scales[used], moved[used]


def _moves(rig: NeuralRig, scales: FloatArray) -> FloatArray:
    """(r, n) millimetres that every shape moves every point at its largest activation."""
    return np.asarray(np.linalg.norm(rig.shapes, axis=2) * scales[:, None])


def _left_out(rig: NeuralRig, tolerance: float) -> float:
    """Millimetres, of the point that lacks most, all shapes together."""
    moves = _moves(rig, output_reach(rig)[: len(rig.shapes)])
    return float(np.where(moves > tolerance, 0.0, moves).sum(axis=0).max(initial=0.0))


def _check_names(where: str, taken: Collection[str]) -> None:
    """:raises InputError: shapes of the face that are called as further ones"""
    if taken:
        raise InputError(f"{where} -> {min(taken)}", "a shape called as one of the neural rig's, expected another name")


def _meshes(
    parts: FaceParts, rig: NeuralRig, kept_shapes: Collection[str], shapes: Mapping[str, FloatArray]
) -> tuple[Mesh, ...]:
    """The meshes at the rig's rest, with `kept_shapes` of the face and (n, 3) millimetres of further ones."""
    meshes, ends = [], np.cumsum([len(mesh.points) for mesh in parts.meshes])
    for mesh, space, turned, end in zip(parts.meshes, _spaces(parts, rig), _turned(parts, rig), ends, strict=True):
        points, back = slice(end - len(mesh.points), end), np.linalg.inv(space)[:3, :3]
        before = [shape for shape in mesh.blendshapes if shape.name in kept_shapes]
        if turned is not None:
            before = [at_rest(shape, back @ turned) for shape in before]
        further = _shapes({name: offsets[points] for name, offsets in shapes.items()}, back)
        meshes.append(_mesh(mesh, rig, rig.rest[points], space, (*before, *further)))
    return tuple(meshes)


def _shapes(shapes: Mapping[str, FloatArray], linear: FloatArray) -> tuple[Blendshape, ...]:
    """Blendshapes of one mesh, of (n, 3) millimetres; those that move none of its points are not on it."""
    blendshapes = []
    for name, moves in shapes.items():
        points = np.flatnonzero(moves.any(axis=1)).astype(np.int32)
        if len(points):
            blendshapes.append(Blendshape(name=name, point_indices=points, offsets=moves[points] @ linear.T))
    return tuple(blendshapes)


def _turned(parts: FaceParts, rig: NeuralRig) -> list[FloatArray | None]:
    """(n, 3, 3) of every mesh, from its own shapes' offsets to the world's, millimetres; None where they stay."""
    if rig.bones is not None or not parts.skeleton.joints:
        return [None] * len(parts.meshes)
    face_rig, to = build(parts), world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES)
    matrices = face_rig.skinning_matrices(face_rig.rest)[:, :3, :3].reshape(-1, 9)
    blended = to[:3, :3] @ (face_rig.influences @ matrices).reshape(-1, 3, 3)
    pieces = np.split(blended, face_rig.mesh_offsets[1:-1])
    return [piece @ space[:3, :3] for piece, space in zip(pieces, mesh_spaces(parts), strict=True)]


def _clips(
    parts: FaceParts, rig: NeuralRig, kept_shapes: Collection[str], shapes: Mapping[str, FloatArray], tolerance: float
) -> BakedClips:
    """Clips of shapes that are there, and of joints: as they are where the skin is the face's, else by shapes too."""
    meshes = _meshes(parts, rig, (), {})
    other_skin = any(one.skin is not two.skin for one, two in zip(parts.meshes, meshes, strict=True))
    joints = [animation for animation in parts.animations if animation.joints and other_skin]
    baked = BakedClips(animations=(), shapes=np.zeros((0, *rig.rest.shape)), error_mm=0.0)
    if joints:
        pairs = zip(_spaces(parts, rig), mesh_spaces(parts), strict=True)
        spaces = [(there @ np.linalg.inv(here))[:3, :3] for there, here in pairs]
        baked = baked_clips(parts, replace(parts, meshes=meshes), joints, shapes, spaces, tolerance)
    again = {animation.name: animation for animation in baked.animations}
    kept = [
        again.get(animation.name, animation)
        for animation in parts.animations
        if animation.name in again or set(animation.shapes) <= set(kept_shapes)
    ]
    return replace(baked, animations=tuple(kept))


def _photos(parts: FaceParts, animations: Sequence[Animation]) -> tuple[PhotoView, ...]:
    """Photos, without the poses that are gone."""
    names = {animation.name for animation in animations}
    return tuple(photo if photo.animation in names else replace(photo, animation=None) for photo in parts.photos)


def _mesh(mesh: Mesh, rig: NeuralRig, rest: FloatArray, space: FloatArray, shapes: tuple[Blendshape, ...]) -> Mesh:
    back = np.linalg.inv(space)
    points, skin = transformed(rest, back), mesh.skin
    there = transformed(mesh.points, space)
    if np.abs(there - rest).max(initial=0.0) <= _SAME * np.abs(rest).max(initial=0.0):
        points = mesh.points  # nothing to author
    if skin is not None and rig.bones is None:
        one = np.ones((len(points), 1), np.float32)
        skin = replace(skin, joint_indices=np.zeros((len(points), 1), np.int32), joint_weights=one)
    elif skin is not None and rig.bones is not None:
        skin = _fewer(skin, most_influences(rig.bones))
    return replace(mesh, points=points, skin=skin, blendshapes=shapes)


def _fewer(skin: Skin, most: int) -> Skin:
    """The largest `most` weights of every point, renormalised; the skin itself where it has no more."""
    if int(np.count_nonzero(skin.joint_weights, axis=1).max(initial=0)) <= most:
        return skin
    order = np.argsort(-np.asarray(skin.joint_weights), axis=1, kind="stable")[:, :most]
    weights = np.take_along_axis(np.asarray(skin.joint_weights, np.float64), order, axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    joints = np.where(weights > 0, np.take_along_axis(skin.joint_indices, order, axis=1), 0)
    return replace(skin, joint_indices=joints.astype(np.int32), joint_weights=weights)


def _dropped(parts: FaceParts, attached: FaceParts, rig: NeuralRig) -> tuple[str, ...]:
    lines, network, controls = [], parts.slider_network, {control.name for control in rig.controls}
    if network is not None and network.info.get("kind") != "neural rig" and set(network.sliders) - controls:
        lines.append("left out: the learned network of the sliders, which takes others than the rig's controls")
    for kind, before, after in (
        ("clips that play shapes which are not kept", parts.animations, attached.animations),
        ("sliders of joints or shapes that no longer move the face", parts.sliders, attached.sliders),
    ):
        there = {one.name for one in after}
        gone = [one.name for one in before if one.name not in there]
        lines += [f"left out: {kind}: {', '.join(gone)}"] if gone else []
    return tuple(lines)
