"""The person of a face, and the face with this person as the neutral: what exports, viewers and hosts deliver."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.parts import (
    Animation,
    Blendshape,
    BoneLimits,
    Curve,
    FaceParts,
    Inbetween,
    Mesh,
    Skeleton,
    Slider,
    SliderNetwork,
)
from facepipe.rig.animation import local_transforms, places, sample_transforms, sample_weights
from facepipe.rig.bone_coefficients import (
    CHANNELS,
    coefficient_derivatives,
    coefficient_matrices,
    matrix_coefficients,
    rest_coefficients,
)
from facepipe.rig.rig import Rig, build, curves, inverse
from facepipe.rig.sliders import (
    channel_entries,
    clamped_value,
    mode_weights,
    network_resting_at,
    resting_at,
    shape_entries,
    slide,
    with_entries,
)
from facepipe.rig.trs import decompose

if TYPE_CHECKING:
    from facepipe.rig.set_error import SetError

POSES = ("set", "set-joints", "rest")  # what `--pose` takes beside the names of animations

_SLIDERS_NAMED = 3  # sliders of a description
_SAME_POSE = 1e-6
_CANCELLED = 1e-6  # of sums: sliders, whose values files hold in float32, that take what others add
_KNOTS_APART = 1e-6  # of weights: nearer knots are one
_NO_GAIN = 1e-9  # of gains
_EXACT_TRANSFORM = 1e-9
_FLAT_SIZE = 1e-12  # of a joint's size, in one direction beside the others: there is no way back
_STILL = 1e-7  # of matrices: joints are where they were bound, as weights in float32 sum to 1 but for 4.5e-8


@dataclass(frozen=True, kw_only=True)
class Person:
    """Bone coefficients and shape weights that move the template to the person."""

    description: str  # "rest", or what it was set by
    coefficients: FloatArray  # (j, 9) relative to the template's rest
    weights: Mapping[str, float]  # of shapes

    @property
    def is_rest(self) -> bool:
        """Whether it is the template itself."""
        at_rest = (self.coefficients == rest_coefficients(len(self.coefficients))).all()
        return bool(at_rest) and not any(self.weights.values())

    @property
    def matrices(self) -> FloatArray:
        """(j, 4, 4) M_j(person)."""
        return coefficient_matrices(self.coefficients)

    def under(self, expression: FloatArray) -> FloatArray:
        """(..., j, 4, 4) matrices M(person) M(expression) of (..., j, 9) bone coefficients."""
        return np.asarray(self.matrices @ coefficient_matrices(expression))

    def weights_under(self, expression: Mapping[str, float]) -> dict[str, float]:
        """Shape weights of the person and of an expression together."""
        names = {*self.weights, *expression}
        return {name: self.weights.get(name, 0.0) + expression.get(name, 0.0) for name in names}


def person_of(parts: FaceParts, pose: str = "set") -> Person:
    """Who the face is.

    :param pose: ``set`` (or ``set-joints``): what is set on the face; ``rest``: the template; else an animation of the
        face, whose first sample it is
    :raises InputError: no such animation, or one that doesn't fit the face
    """
    if pose == "rest":
        return Person(description="rest", coefficients=rest_coefficients(len(parts.skeleton.joints)), weights={})
    if pose not in POSES:
        return _posed(parts, pose, f"pose {pose}")
    if parts.person is not None:
        return _posed(parts, parts.person, f"set by pose {parts.person}")
    moved = [slider for slider in parts.sliders if slider.value is not None and slider.value != slider.default]
    if not moved:
        return person_of(parts, "rest")
    coefficients, weights = slide(parts.sliders, parts.skeleton.joints, network=parts.slider_network)
    if any(slider.modes for slider in parts.sliders):
        # of a person's own values what identity sliders take of measures is what these add
        rest = rest_coefficients(len(coefficients))
        coefficients = np.where(np.abs(coefficients - rest) < _CANCELLED, rest, coefficients)
        weights = {name: weight for name, weight in weights.items() if abs(weight) >= _CANCELLED}
    some = ", ".join(f"{slider.name}={slider.value:g}" for slider in moved[:_SLIDERS_NAMED])
    more = f" and {len(moved) - _SLIDERS_NAMED} more" if len(moved) > _SLIDERS_NAMED else ""
    return Person(description=f"set by sliders {some}{more}", coefficients=coefficients, weights=weights)


def is_person(parts: FaceParts, animation: Animation, person: Person) -> bool:
    """Whether an animation is a pose of the person without expression."""
    if animation.times is not None or not set(animation.joints) <= set(parts.skeleton.joints):
        return False
    weights, expected = sample_weights(animation), person.weights
    apart = [abs(weights.get(name, 0.0) - expected.get(name, 0.0)) for name in {*weights, *expected}]
    local = sample_transforms(parts.skeleton, animation)
    at = np.asarray(parts.skeleton.rest_transforms, dtype=np.float64) @ person.matrices
    tolerance = _SAME_POSE * max(1.0, float(np.abs(at).max(initial=0.0)))
    return max(apart, default=0.0) <= _SAME_POSE and bool((np.abs(local - at) <= tolerance).all())


def _posed(parts: FaceParts, name: str, description: str) -> Person:
    animation = next((candidate for candidate in parts.animations if candidate.name == name), None)
    if animation is None:
        raise InputError(
            parts.name, unknown(name, [*POSES, *(candidate.name for candidate in parts.animations)], "pose")
        )
    skeleton = parts.skeleton
    if animation.coefficients is not None:
        coefficients = rest_coefficients(len(skeleton.joints))
        coefficients[places(skeleton, animation)] = np.asarray(animation.coefficients)[0]
    else:
        rest = np.asarray(skeleton.rest_transforms, dtype=np.float64)
        try:
            change = np.linalg.solve(rest, sample_transforms(skeleton, animation))
        except np.linalg.LinAlgError:
            raise InputError(f"{parts.name} -> {skeleton.name}", "joints scaled to nothing at rest") from None
        coefficients = matrix_coefficients(change)
    return Person(description=description, coefficients=coefficients, weights=sample_weights(animation))


def _moved_points(
    mesh: Mesh, weights: Mapping[str, float], moved: FloatArray | None
) -> tuple[FloatArray, FloatArray | None]:
    """(n, 3) points of a mesh under shape weights and then affine matrices, and (n, 3, 3) how these turn what is there.

    :param weights: of the person, by shape
    :param moved: (n, 3, 4) matrices of the points in skeleton space at bind time; None leaves points where shapes take
        them
    :raises TopologyError: a singular bind transform
    """
    points = np.array(mesh.points, dtype=np.float64)
    for shape in mesh.blendshapes:
        if weights.get(shape.name):
            offsets = [sculpt.offsets for _, _, sculpt in shape.sculpts]
            points[shape.point_indices] += _blended(shape, weights[shape.name], offsets)
    if moved is None or mesh.skin is None:
        return points, None
    space = np.asarray(mesh.skin.geom_bind_transform, dtype=np.float64)
    back = inverse(space, f"{mesh.name} -> geomBindTransform")
    whole = np.zeros((len(points), 4, 4))
    whole[:, :3], whole[:, 3, 3] = moved, 1.0
    # points and offsets lie before geomBindTransform B, the matrices M after it: B^-1 M B
    whole = back @ whole @ space
    linear = whole[:, :3, :3]
    return np.einsum("nij,nj->ni", linear, points) + whole[:, :3, 3], linear


def set_mesh(mesh: Mesh, weights: Mapping[str, float], moved: FloatArray | None) -> Mesh:
    """The mesh with points as `_moved_points` has them, its shapes on top.

    :raises TopologyError: a singular bind transform
    """
    points, linear = _moved_points(mesh, weights, moved)
    if np.array_equal(points, mesh.points) and linear is None:
        return mesh
    # (n, 3, 3) what takes normals along: the cofactor of `linear`, then the turn that the surface makes beside it
    triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    before, after = point_normals(mesh.points, triangles), point_normals(points, triangles)
    cofactor = np.tile(np.eye(3), (len(points), 1, 1))
    if linear is not None:
        rows = [np.cross(linear[:, (i + 1) % 3], linear[:, (i + 2) % 3]) for i in range(3)]
        cofactor = np.stack(rows, axis=1)
    carried = np.einsum("nij,nj->ni", cofactor, before)
    length = np.linalg.norm(carried, axis=1, keepdims=True)
    carried /= np.where(length == 0, 1.0, length)
    sign = np.where(np.linalg.det(cofactor) < 0, -1.0, 1.0)  # a mirrored surface is wound the other way
    size = np.where(length == 0, 1.0, length)[:, :, None]
    turn = np.asarray(_rotations(carried, after * sign[:, None]) @ (cofactor / size))
    shapes = tuple(_on_top(shape, weights.get(shape.name, 0.0), linear, turn) for shape in mesh.blendshapes)
    normals = mesh.normals
    if normals is not None:
        per_point = len(normals) == len(turn)
        turns = turn if per_point else turn[np.asarray(mesh.face_vertex_indices, dtype=np.int64)]
        turned = np.einsum("nij,nj->ni", turns, np.asarray(normals, dtype=np.float64))
        length = np.linalg.norm(turned, axis=1, keepdims=True)
        normals = np.asarray(turned / np.where(length == 0, 1.0, length))
    return replace(mesh, points=points.astype(np.float32), normals=normals, blendshapes=shapes)


def _blended(shape: Blendshape, weight: float, sculpts: list[FloatArray]) -> FloatArray:
    """(k, 3) what a weight of the shape adds, through its inbetweens; `sculpts` as of `Blendshape.sculpts`."""
    by_weight = curves(tuple(inbetween.weight for inbetween in shape.inbetweens))
    amounts = [float(by_weight[at](weight)) for _, at, _ in shape.sculpts]
    total: FloatArray = np.zeros(np.shape(sculpts[0]))
    for amount, sculpt in zip(amounts, sculpts, strict=True):
        total = total + amount * np.asarray(sculpt, dtype=np.float64)
    return total


def _on_top(shape: Blendshape, weight: float, linear: FloatArray | None, turn: FloatArray) -> Blendshape:
    """The shape as what it adds to the person, who has `weight` of it already."""
    shape = _from(shape, weight)
    rows = np.asarray(shape.point_indices, dtype=np.int64)

    def moved(offsets: FloatArray) -> FloatArray:
        return np.asarray(offsets if linear is None else np.einsum("nij,nj->ni", linear[rows], offsets))

    return shape.changed(moved, lambda offsets: np.asarray(np.einsum("nij,nj->ni", turn[rows], offsets)))


def _from(shape: Blendshape, start: float) -> Blendshape:
    """The shape whose weight 0 is `start` of the old one: the same piecewise-linear way of its points from there."""
    if not start or not shape.inbetweens:
        return shape
    positions = [sculpt.offsets for _, _, sculpt in shape.sculpts]
    normals = [sculpt.normal_offsets for _, _, sculpt in shape.sculpts]
    known = [normal for normal in normals if normal is not None]
    filled = [np.zeros(np.shape(shape.offsets)) if normal is None else normal for normal in normals]

    def at(weight: float) -> tuple[FloatArray, FloatArray | None]:
        ends = [
            _blended(shape, start + weight, sculpts) - _blended(shape, start, sculpts)
            for sculpts in (positions, filled)
        ]
        return ends[0], ends[1] if known else None

    # the old 0 and 1 are knots as well: pieces end there, and the outermost ones go on beyond with the slope they have
    knots = sorted({0.0 - start, 1.0 - start, *(inbetween.weight - start for inbetween in shape.inbetweens)})
    knots = [knot for knot in knots if min(abs(knot), abs(knot - 1.0)) > _KNOTS_APART]
    names = {0.0 - start: "neutral", 1.0 - start: "full"}
    names |= {inbetween.weight - start: inbetween.name for inbetween in shape.inbetweens}
    inbetweens = []
    for knot in knots:
        offsets, normal_offsets = at(knot)
        inbetweens.append(Inbetween(name=names[knot], weight=knot, offsets=offsets, normal_offsets=normal_offsets))
    offsets, normal_offsets = at(1.0)
    return replace(shape, offsets=offsets, normal_offsets=normal_offsets, inbetweens=tuple(inbetweens))


def _rotations(start: FloatArray, end: FloatArray) -> FloatArray:
    """(n, 3, 3) the smallest rotation from each unit vector (n, 3) to another; none where they are opposed."""
    axis = np.cross(start, end)
    cosine = np.einsum("ni,ni->n", start, end)
    K = np.zeros((len(axis), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    K -= np.swapaxes(K, 1, 2)
    opposed = cosine < -1 + 1e-6
    factor = np.where(opposed, 0.0, 1 / np.where(opposed, 1.0, 1 + cosine))
    K[opposed] = 0.0
    return np.eye(3) + K + factor[:, None, None] * (K @ K)  # Rodrigues: sin = |axis|, (1 - cos) / sin^2 = 1 / (1 + cos)


def new_rest(rig: Rig, skeleton: Skeleton, person: Person, *, in_joints: bool) -> tuple[Skeleton, FloatArray]:
    """The skeleton with the person as its rest: without the person's scales, or with `in_joints` the transforms alone.

    :returns: and (j, 3, 3) scale of the person that the joints no longer have, in their own axes
    """
    local = rig.rest @ person.matrices
    if in_joints:
        return replace(skeleton, rest_transforms=local), np.tile(np.eye(3), (len(local), 1, 1))
    world = rig.joint_worlds(local, np.eye(4))
    before = _stretch(rig.joint_worlds(rig.rest.copy(), np.eye(4)))
    after = _stretch(world)
    stretch = np.linalg.solve(before, after)  # of the person alone, in each joint's own axes
    unscaled = world.copy()
    unscaled[:, :3, :3] = world[:, :3, :3] @ np.linalg.inv(stretch)
    above = np.array([np.eye(4) if parent < 0 else unscaled[parent] for parent in rig.parents]).reshape(-1, 4, 4)
    rest = np.linalg.solve(above, unscaled)
    return replace(skeleton, bind_transforms=unscaled, rest_transforms=rest), stretch


def _stretch(worlds: FloatArray) -> FloatArray:
    """(j, 3, 3) symmetric positive stretch K of the linear parts Q K (polar decomposition); mirrors stay in Q."""
    _, scale, Vt = np.linalg.svd(worlds[:, :3, :3])
    return np.asarray((np.swapaxes(Vt, -1, -2) * scale[:, None, :]) @ Vt)


def _animation_on(
    parts: FaceParts, animation: Animation, person: Person, new: Skeleton, stretch: FloatArray, *, holds_person: bool
) -> Animation:
    if holds_person:
        # a pose that holds the person, as the expression on top: ``inverse(M(person)) M``, weights less the person's
        skeleton, joints = parts.skeleton, parts.skeleton.joints
        count = animation.samples
        local = np.tile(np.asarray(skeleton.rest_transforms, dtype=np.float64), (count, 1, 1, 1))
        local[:, places(skeleton, animation)] = local_transforms(skeleton, animation)
        under = np.asarray(skeleton.rest_transforms, dtype=np.float64) @ person.matrices
        given = (
            np.zeros((count, 0)) if animation.shape_weights is None else np.asarray(animation.shape_weights, np.float64)
        )
        given_weights = dict(zip(animation.shapes, given.T, strict=False))
        names = tuple(sorted({*given_weights, *person.weights}))
        columns = [given_weights.get(name, np.zeros(count)) - person.weights.get(name, 0.0) for name in names]
        animation = replace(
            animation,
            joints=joints,
            coefficients=matrix_coefficients(np.linalg.solve(under, local)) if joints else None,
            shapes=names,
            shape_weights=np.stack(columns, axis=1) if names else None,
        )
    if not animation.joints or all(
        getattr(animation, field) is None for field in ("translations", "rotations", "scales", "coefficients")
    ):
        return animation
    rows = places(parts.skeleton, animation)
    if animation.coefficients is not None:
        coefficients: FloatArray = np.array(animation.coefficients, dtype=np.float64)
        coefficients[..., :3] = np.einsum("jab,tjb->tja", stretch[rows], coefficients[..., :3])
        return replace(animation, coefficients=coefficients, translations=None, rotations=None, scales=None)
    rest = np.asarray(parts.skeleton.rest_transforms, dtype=np.float64)[rows]
    expression: FloatArray = np.linalg.solve(rest, local_transforms(parts.skeleton, animation))
    expression[..., :3, 3] = np.einsum("jab,tjb->tja", stretch[rows], expression[..., :3, 3])
    coefficients = matrix_coefficients(expression)
    if np.allclose(
        coefficient_matrices(coefficients), expression, rtol=0, atol=_EXACT_TRANSFORM * max(1.0, np.abs(rest).max())
    ):
        return replace(animation, coefficients=coefficients, translations=None, rotations=None, scales=None)
    # between joints of uneven scale a turn becomes a shear, which nine coefficients do not hold; posed from rest it may
    # be a plain turn again
    posed = decompose(np.asarray(new.rest_transforms)[rows] @ expression)
    return replace(animation, translations=posed.translation, rotations=posed.rotation, scales=posed.scale)


def limits_on(limits: BoneLimits | None, person: Person, stretch: FloatArray) -> BoneLimits | None:
    """The limits that are left for expressions: less the person's translations and angles, by its scales.

    The person itself is always within them.
    """
    if limits is None:
        return None
    rest = rest_coefficients(len(person.coefficients))
    spread = np.ones_like(rest)
    spread[:, :3] = np.abs(np.diagonal(stretch, axis1=1, axis2=2))

    def left(values: FloatArray) -> FloatArray:
        values = np.asarray(values, dtype=np.float64)
        scales = person.coefficients[:, 6:]
        moved = (values - person.coefficients) * spread
        moved[:, 6:] = np.where(scales == 0, 1.0, values[:, 6:] / np.where(scales == 0, 1.0, scales))
        return moved

    one, other = left(limits.lower), left(limits.upper)  # a mirrored scale swaps them
    return BoneLimits(lower=np.minimum(np.minimum(one, other), rest), upper=np.maximum(np.maximum(one, other), rest))


def network_on(parts: FaceParts, change: _Changes) -> SliderNetwork | None:
    """The learned network of the sliders, adding nothing at the person's values."""
    network = parts.slider_network
    if network is None:
        return None
    network = network_resting_at(network, {slider.name: clamped_value(slider) for slider in parts.sliders})
    rows = [change.channels(joint, channel) for joint, channel in network.channels]
    channels = tuple(dict.fromkeys(key for row in rows for key in row))
    spread = np.zeros((len(channels) + len(network.shapes), len(rows) + len(network.shapes)))
    for column, row in enumerate(rows):
        for key, factor in row.items():
            spread[channels.index(key), column] = factor
    spread[len(channels) :, len(rows) :] = np.eye(len(network.shapes))
    # the last layer is straight: what channels become goes into its numbers
    return replace(
        network,
        channels=channels,
        weights=(*network.weights[:-1], spread @ network.weights[-1]),
        biases=(*network.biases[:-1], spread @ network.biases[-1]),
    )


class _Changes:
    """Changes of one bone coefficient of a joint, relative to the person's rest.

    They are those of the coefficients of ``inverse(M(person)) M(person + change)``, to first order.
    """

    def __init__(self, parts: FaceParts, person: Person, stretch: FloatArray) -> None:
        self.index = {joint: i for i, joint in enumerate(parts.skeleton.joints)}
        inverse = np.linalg.pinv(coefficient_matrices(person.coefficients))
        by = inverse[:, None] @ coefficient_derivatives(person.coefficients)  # (j, 9, 4, 4)
        turns = by[..., :3, :3]
        angles = np.stack([turns[..., i - 1, i - 2] - turns[..., i - 2, i - 1] for i in range(3)], axis=-1) / 2
        moves = np.einsum("jab,jkb->jka", stretch, by[..., :3, 3])
        self.by = np.concatenate([moves, angles, np.diagonal(turns, axis1=-2, axis2=-1)], axis=-1)  # (j, 9, 9)

    def channels(self, joint: str, channel: str) -> dict[tuple[str, str], float]:
        """Factor of every channel that a change of one becomes."""
        row = self.by[self.index[joint], CHANNELS.index(channel)].tolist()
        return {(joint, name): by for name, by in zip(CHANNELS, row, strict=True) if abs(by) > _NO_GAIN}

    def slider(self, slider: Slider) -> Slider:
        """The slider with the person's value as its default, which then adds nothing."""
        value = clamped_value(slider)
        gains: dict[tuple[str, str, Curve | None], float] = defaultdict(float)
        for (joint, channel, gain), curve in channel_entries(slider):
            for (moved_joint, name), factor in self.channels(joint, channel).items():
                gains[moved_joint, name, curve] += gain * factor
        entries = [((joint, channel, gain), curve) for (joint, channel, curve), gain in gains.items()]
        return resting_at(with_entries(slider, entries, list(shape_entries(slider))), value)


@dataclass(frozen=True, kw_only=True)
class SetFace:
    """A face as it is delivered."""

    parts: FaceParts  # its rest is the person; shapes, joints and animations play on top
    pose: str  # who that is, for reports
    stretch: FloatArray | None = None  # (j, 3, 3) that translations of coefficients made for the template take
    judged: Callable[[], SetError] | None = None  # what finds `error`, which takes four times as long as all else

    @cached_property
    def error(self) -> SetError | None:
        """Of expressions on top; None where the person is the template."""
        return None if self.judged is None else self.judged()

    def carried(self, coefficients: FloatArray) -> FloatArray:
        """(..., j, 9) bone coefficients made for the template, for this face: a person's scales left the joints."""
        result: FloatArray = np.array(coefficients, dtype=np.float64)
        if self.stretch is not None:
            result[..., :3] = np.einsum("jab,...jb->...ja", self.stretch, result[..., :3])
        return result


def _check_sizes(rig: Rig, parts: FaceParts, person: Person) -> None:
    """:raises InputError: joints of no size, or of one beyond measure, at rest or with the person"""
    by_person = f"by the person ({person.description})"
    for local, who in ((rig.rest, "at rest"), (rig.rest @ person.matrices, by_person)):
        worlds = rig.joint_worlds(local.copy(), np.eye(4))[:, :3, :3]
        finite = np.asarray(np.isfinite(worlds).all(axis=(1, 2)))
        sizes = np.linalg.svd(np.where(finite[:, None, None], worlds, 0.0), compute_uv=False)
        large = ~finite | (sizes[:, 0] > 1.0 / _FLAT_SIZE)
        flat = np.flatnonzero(large | (sizes[:, 2] < _FLAT_SIZE * np.maximum(sizes[:, 0], 1.0)))
        if flat.size:
            what = f"scaled {'beyond measure' if large[flat[0]] else 'to nothing'} {who}, expected scales near 1"
            raise InputError(f"{parts.name} -> {rig.joints[flat[0]]}", what)


def _in_neutral(parts: FaceParts, given: FaceParts, person: Person) -> FaceParts:
    """The face whose neutral is the person already, as modes of sliders made it; the sliders start there."""
    animations = tuple(one for one in parts.animations if not is_person(parts, one, person))
    network = parts.slider_network
    if network is not None:
        network = network_resting_at(network, {slider.name: clamped_value(slider) for slider in parts.sliders})
    return replace(
        parts,
        sliders=tuple(resting_at(slider, clamped_value(slider)) for slider in given.sliders),
        slider_network=network,
        animations=animations,
        played=parts.played if parts.played in {animation.name for animation in animations} else None,
        person=None,
    )


def _matrices(rig: Rig, parts: FaceParts, person: Person) -> FloatArray | None:
    """(n, 3, 4) matrices of points under a person; None where it is of shapes alone: joints and offsets stay as they
    are, which saves a pass over all of them.

    :raises InputError: shapes that the face lacks, or joints of no size, at rest or with the person
    """
    rig.weight_vector(person.weights)  # refuses shapes that the face lacks
    _check_sizes(rig, parts, person)
    moved = rig.blended(rig.skinning_matrices(rig.rest @ person.matrices, np.eye(4)))
    still = np.array_equal(person.matrices, np.broadcast_to(np.eye(4), person.matrices.shape))
    return None if still and np.abs(moved - np.eye(4)[:3]).max(initial=0.0) < _STILL else moved


def set_points(parts: FaceParts, rig: Rig | None = None) -> FaceParts:
    """The face with the points that `set_face` gives its meshes, without shapes and normals, as payloads take it.

    :param rig: of the face, where it is at hand and no slider moves modes
    :raises FacepipeError: as `set_face` does
    """
    person = person_of(parts)
    if mode_weights(parts.sliders):
        from facepipe.rig.identity import with_identity

        parts, rig = with_identity(parts), None
    moved, ends = None, np.cumsum([len(mesh.points) for mesh in parts.meshes]).tolist()
    if not person.is_rest:
        moved = _matrices(rig or build(parts), parts, person)
    meshes = []
    for mesh, end in zip(parts.meshes, ends, strict=True):
        own = None if moved is None else moved[end - len(mesh.points) : end]
        points, linear = _moved_points(mesh, person.weights, own)
        still = linear is None and np.array_equal(points, mesh.points)
        points = mesh.points if still else points.astype(np.float32)
        meshes.append(replace(mesh, points=points, normals=None, blendshapes=()))
    return replace(parts, meshes=tuple(meshes))


def set_face(parts: FaceParts, pose: str = "set") -> SetFace:
    """The face with the person as its rest.

    ``set`` (and the name of a pose) puts the person into points, offsets of shapes, bind and rest transforms, and
    takes its scales off the joints, so that every engine poses them right. With W the joints' worlds under the person,
    a point becomes ``sum_i w_i W_i inverse(bind_i) p`` and an offset follows the linear part of that. Expressions on
    top are exact where a point's joints carry one transform; elsewhere they are off by `SetFace.error`. ``set-joints``
    leaves points, offsets and binds, and moves the rest transforms alone: exact, for engines that keep scaled joints.

    :param pose: ``set``, ``set-joints``, ``rest`` or an animation of the face, whose first sample is the person
    :raises InputError: no such animation, a person of shapes that the face lacks, or joints of no size, at rest or with
        the person
    :raises TopologyError: indices and counts that don't fit
    """
    given, person = parts, person_of(parts, pose)
    if pose != "rest" and mode_weights(parts.sliders):
        from facepipe.rig.identity import with_identity

        parts = with_identity(parts)  # the neutral that all else is on top of
    if person.is_rest:
        found = parts if parts is given else _in_neutral(parts, given, person)
        return SetFace(parts=found, pose=person.description)
    in_joints = pose == "set-joints"
    rig = build(parts)
    moved = _matrices(rig, parts, person)
    skeleton, stretch = new_rest(rig, parts.skeleton, person, in_joints=in_joints)
    if moved is None and not in_joints:
        skeleton = parts.skeleton
    moved = None if in_joints else moved
    bounds = rig.mesh_offsets
    # poses of photos hold the person, which is taken off them; a pose that is the person itself is left out. All others
    # are expressions already.
    of_photos = {photo.animation for photo in parts.photos}
    animations = tuple(
        _animation_on(parts, animation, person, skeleton, stretch, holds_person=animation.name in of_photos)
        for animation in parts.animations
        if not is_person(parts, animation, person)
    )
    change = _Changes(parts, person, stretch)
    result = replace(
        parts,
        meshes=tuple(
            set_mesh(mesh, person.weights, None if moved is None else moved[bounds[i] : bounds[i + 1]])
            for i, mesh in enumerate(parts.meshes)
        ),
        skeleton=skeleton,
        animations=animations,
        played=parts.played if parts.played in {animation.name for animation in animations} else None,
        sliders=tuple(
            replace(change.slider(slider), modes=own.modes)
            for slider, own in zip(parts.sliders, given.sliders, strict=True)
        ),
        slider_network=network_on(parts, change),
        bone_limits=limits_on(parts.bone_limits, person, stretch),
        person=None,
    )
    where = " in the joints" if in_joints else ""
    from facepipe.rig.set_error import Side, set_error  # a module that exports of a face as it is do without

    before, after = Side(rig, person.weights, person.matrices), Side(build(result), {})
    judged = partial(set_error, before, after, stretch, parts, result)
    return SetFace(parts=result, pose=person.description + where, stretch=stretch, judged=judged)
