"""A face that a neural rig moves: its controls are sliders, its hidden layer their network, its basis blendshapes.

Nothing that the face had is taken away for it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.threads import one_thread
from facepipe.declare import check_ranges
from facepipe.geometry.shape_basis import motion_basis
from facepipe.geometry.vectors import transformed
from facepipe.neural.options import AttachOptions
from facepipe.parts import Animation, Blendshape, FaceParts, Mesh, Slider, SliderNetwork
from facepipe.rig import CHANNELS, build, mesh_spaces, sample_transforms, sample_weights
from facepipe.rig.neural_rig import NeuralRig, bones_in, most_influences, output_reach, with_influences
from facepipe.rig.sliders import with_mutual_mirrors
from facepipe.verbs.whole_faces import MILLIMETRES, Topology, check_spaces, world_to_world

_SAME = 2.0**-22  # of the largest coordinate: two roundings to float32
_MOST_SHAPES = 256  # that clips add
_MOST_FRAMES = 512  # that these are chosen by
_MATRIX = 1e-3  # millimetres, or of a rotation, by which joints may differ
_WEIGHT = 1e-5  # of a skin weight, float32 and half way between


def shape_name(number: int) -> str:
    """Of a shape of the basis."""
    return f"neural_{number:03d}"


def _names(rig: NeuralRig, joints: Sequence[str]) -> list[tuple[str, str]]:
    return [(joints[joint], CHANNELS[channel]) for joint, channel in rig.channels.tolist()]


def _factors(parts: FaceParts, rig: NeuralRig, scales: FloatArray) -> FloatArray:
    """(r + m,) from the rig's outputs to shape weights and bone coefficients of the face."""
    smaller = 0.001 / parts.meters_per_unit
    return np.concatenate([1.0 / scales, np.where(rig.channels[:, 1] < 3, smaller, 1.0)])


def neural_sliders(parts: FaceParts, rig: NeuralRig, scales: FloatArray) -> tuple[Slider, ...]:
    """The controls, with what is straight of what they do; mirrors as on the face.

    :param scales: (r,) activations of shapes, millimetres, at which their weights are 1
    """
    face_sliders, count = {one.name: one for one in parts.sliders}, len(rig.shapes)
    channels = _names(rig, parts.skeleton.joints)
    sliders = []
    for control, row in zip(rig.controls, rig.linear * _factors(parts, rig, scales), strict=True):
        gains = (row / (control.maximum - control.minimum)).tolist()
        pairs = zip(channels, gains[count:], strict=True)
        slider = Slider(
            name=control.name,
            default=control.default,
            minimum=control.minimum,
            maximum=control.maximum,
            channels=tuple((*channel, gain) for channel, gain in pairs if gain),
            shapes=tuple((shape_name(i), gain) for i, gain in enumerate(gains[:count]) if gain),
        )
        if before := face_sliders.get(control.name):  # with the group, mirror and value that the face's has
            value = before.value
            if value is not None and not control.minimum <= value <= control.maximum:
                value = None
            slider = replace(slider, group=before.group, mirror=before.mirror, value=value)
        sliders.append(slider)
    return tuple(sliders)


def neural_network(parts: FaceParts, rig: NeuralRig, scales: FloatArray) -> SliderNetwork | None:
    """The hidden layer over plain values; the shares of their ranges are in its weights. None without units."""
    if not len(rig.hidden):
        return None
    low, high, rest = (
        np.array([getattr(one, key) for one in rig.controls]) for key in ("minimum", "maximum", "default")
    )
    first = rig.hidden / (high - low)
    count, factors = len(rig.shapes), _factors(parts, rig, scales)
    order = np.roll(np.arange(len(factors)), -count)  # channels before shapes
    return SliderNetwork(
        sliders=tuple(control.name for control in rig.controls),
        channels=tuple(_names(rig, parts.skeleton.joints)),
        shapes=tuple(shape_name(i) for i in range(count)),
        weights=(first, (rig.last * factors[:, None])[order]),
        biases=(rig.hidden_bias - first @ rest, (rig.last_bias * factors)[order]),
        activation="silu",
        info={"kind": "neural rig", "topology": rig.topology},
    )


def clip_shape_name(number: int) -> str:
    """Of a shape that baked clips play beside those of the rig."""
    return f"clip_{number:03d}"


def own_shapes(parts: FaceParts) -> frozenset[str]:
    """Names of the shapes that the face has of its own: not those of a neural rig that was put on it before."""
    names = {*parts.shapes}
    network = parts.slider_network
    if network is None or network.info.get("kind") != "neural rig":
        return frozenset(names)
    return frozenset(name for name in names - set(network.shapes) if not name.startswith("clip_"))


def _beyond_joints(
    parts: FaceParts, attached: FaceParts, spaces: Sequence[FloatArray], animation: Animation
) -> Iterator[FloatArray]:
    """(n, 3) float32 millimetres of each sample, by which shapes are to move points before the other skin does."""
    rig, other = build(parts), build(attached)
    still = other.points
    if not np.allclose(rig.points, still, rtol=0, atol=_SAME * np.abs(still).max(initial=0.0)):
        still = other.unskin(rig.evaluate(), other.skinning_matrices(other.rest))  # its own points: as far as from rest
    for number in range(animation.samples):
        local = sample_transforms(parts.skeleton, animation, number)
        points = rig.evaluate(sample_weights(animation, number), joint_transforms=local)
        moved = other.unskin(points, other.skinning_matrices(local)) - still
        pieces = zip(np.split(moved, other.mesh_offsets[1:-1]), spaces, strict=True)
        yield np.concatenate([piece @ space.T for piece, space in pieces]).astype(np.float32)


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
        clips, clip_shapes, clips_mm = _clips(parts, rig, kept_shapes, shapes, tolerance)
        shapes |= {clip_shape_name(number): own_offsets for number, own_offsets in enumerate(clip_shapes)}
        taken = kept_shapes & shapes.keys()
        if taken:
            raise InputError(
                f"{where} -> {min(taken)}", "a shape called as one of the neural rig's, expected another name"
            )
        # sliders that are no controls of the rig, and whose shapes and joints still move the face
        controls = {control.name for control in rig.controls}
        kept = tuple(
            slider
            for slider in parts.sliders
            if slider.name not in controls
            and all(shape in kept_shapes for shape, _ in slider.shapes)
            and (rig.bones is not None or not slider.channels)
        )
        poses = {animation.name for animation in clips}  # the others are gone
        attached = replace(
            parts,
            meshes=_meshes(parts, rig, kept_shapes, shapes),
            sliders=with_mutual_mirrors((*neural_sliders(parts, rig, scales), *kept)),
            slider_network=neural_network(parts, rig, scales),
            animations=clips,
            photos=tuple(one if one.animation in poses else replace(one, animation=None) for one in parts.photos),
        )
        moves = _moves(whole, output_reach(whole)[: len(whole.shapes)])
        return AttachedNeuralRig(
            parts=attached,
            dropped_mm=float(np.where(moves > tolerance, 0.0, moves).sum(axis=0).max(initial=0.0)),
            shapes=len(names),
            offsets=int(moved.sum()),
            clips_mm=clips_mm,
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


def _meshes(
    parts: FaceParts, rig: NeuralRig, kept_shapes: Collection[str], shapes: Mapping[str, FloatArray]
) -> tuple[Mesh, ...]:
    """The meshes at the rig's rest, with `kept_shapes` of the face and (n, 3) millimetres of further ones."""
    meshes, ends = [], np.cumsum([len(mesh.points) for mesh in parts.meshes])
    for mesh, space, turned, end in zip(parts.meshes, _spaces(parts, rig), _turned(parts, rig), ends, strict=True):
        points, back = slice(end - len(mesh.points), end), np.linalg.inv(space)[:3, :3]
        before = [shape for shape in mesh.blendshapes if shape.name in kept_shapes]
        if turned is not None:
            turns = back @ turned
            ways = [partial(np.einsum, "kij,kj->ki", turns[shape.point_indices]) for shape in before]
            before = [shape.changed(way, way) for shape, way in zip(before, ways, strict=True)]
        for name, offsets in shapes.items():  # those that move none of its points are not on it
            moved = np.flatnonzero(offsets[points].any(axis=1)).astype(np.int32)
            if len(moved):
                before.append(Blendshape(name=name, point_indices=moved, offsets=offsets[points][moved] @ back.T))
        meshes.append(_mesh(mesh, rig, rig.rest[points], space, tuple(before)))
    return tuple(meshes)


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
) -> tuple[tuple[Animation, ...], FloatArray, float]:
    """Clips of shapes that are there, and of joints: as they are where the skin is the face's, else by shapes too.

    :returns: the clips, (k, n, 3) millimetres of shapes that they play beside the rig's, largest error of a point
    """
    meshes = _meshes(parts, rig, (), {})
    other_skin = any(one.skin is not two.skin for one, two in zip(parts.meshes, meshes, strict=True))
    joints = [animation for animation in parts.animations if animation.joints and other_skin]
    again: dict[str, Animation] = {}
    further, error_mm = np.zeros((0, *rig.rest.shape)), 0.0
    if joints:
        pairs = zip(_spaces(parts, rig), mesh_spaces(parts), strict=True)
        spaces = [(there @ np.linalg.inv(here))[:3, :3] for there, here in pairs]
        attached = replace(parts, meshes=meshes)
        # for a face with another skin: weights of shapes for where its joints don't bring points
        frames = np.stack(
            [moved for animation in joints for moved in _beyond_joints(parts, attached, spaces, animation)]
        )
        left = frames.reshape(len(frames), -1)  # in place: frames may be many
        rig_shapes = np.array(list(shapes.values())).reshape(len(shapes), left.shape[1])
        weights = np.linalg.lstsq(rig_shapes @ rig_shapes.T, rig_shapes.astype(np.float32) @ left.T, rcond=1e-9)[0].T
        left -= weights.astype(np.float32) @ rig_shapes.astype(np.float32)
        # (k, n, 3) orthonormal shapes that leave `tolerance`, RMS; none where that is all there is
        squares = sum(float(np.square(frame, dtype=np.float64).sum()) for frame in frames)
        if squares > tolerance**2 * len(frames) * len(rig.rest):
            some = frames[:: max(1, -(-len(frames) // _MOST_FRAMES))]
            further = motion_basis(some, tolerance, _MOST_SHAPES)[0]
        amounts = left @ further.reshape(len(further), left.shape[1]).T.astype(np.float32)
        sizes = np.maximum(np.abs(amounts).max(axis=0, initial=0.0), np.finfo(np.float32).eps)
        further, amounts = further * sizes[:, None, None], amounts / sizes
        left -= amounts @ further.reshape(len(further), left.shape[1]).astype(np.float32)
        every = (*shapes, *map(clip_shape_name, range(len(further))))
        rows = np.concatenate([weights, amounts], axis=1)
        ends = np.cumsum([animation.samples for animation in joints])
        again = {
            one.name: replace(one, shapes=every, shape_weights=own_rows)
            for one, own_rows in zip(joints, np.split(rows, ends[:-1]), strict=True)
        }
        error_mm = float(max(np.linalg.norm(frame, axis=1).max() for frame in frames))
    kept = tuple(
        again.get(animation.name, animation)
        for animation in parts.animations
        if animation.name in again or set(animation.shapes) <= set(kept_shapes)
    )
    return kept, further, error_mm


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
        most = most_influences(rig.bones)
        if int(np.count_nonzero(skin.joint_weights, axis=1).max(initial=0)) > most:  # the largest, renormalised
            order = np.argsort(-np.asarray(skin.joint_weights), axis=1, kind="stable")[:, :most]
            weights = np.take_along_axis(np.asarray(skin.joint_weights, np.float64), order, axis=1)
            weights /= weights.sum(axis=1, keepdims=True)
            joints = np.where(weights > 0, np.take_along_axis(skin.joint_indices, order, axis=1), 0)
            skin = replace(skin, joint_indices=joints.astype(np.int32), joint_weights=weights)
    return replace(mesh, points=points, skin=skin, blendshapes=shapes)


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
