"""Sliders and clips of a face with a neural rig: those that the rig makes of its controls, and what the face keeps."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.shape_basis import motion_basis
from facepipe.parts import Animation, Blendshape, FaceParts, Slider, SliderNetwork
from facepipe.rig import CHANNELS, build, sample_transforms, sample_weights
from facepipe.rig.neural_rig import Control, NeuralRig

_SAME = 2.0**-22  # of the largest coordinate: two roundings to float32
_MOST_SHAPES = 256  # that clips add
_MOST_FRAMES = 512  # that these are chosen by


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
        sliders.append(_as_before(slider, control, face_sliders.get(control.name)))
    return tuple(sliders)


def _as_before(slider: Slider, control: Control, before: Slider | None) -> Slider:
    """With the group, mirror and value that the face's slider of that name has."""
    if before is None:
        return slider
    value = before.value
    if value is not None and not control.minimum <= value <= control.maximum:
        value = None
    return replace(slider, group=before.group, mirror=before.mirror, value=value)


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


def kept_sliders(parts: FaceParts, rig: NeuralRig, shapes: Collection[str]) -> tuple[Slider, ...]:
    """Sliders that are no controls of the rig, and whose shapes and joints still move the face.

    :param shapes: that the face keeps
    """
    controls = {control.name for control in rig.controls}
    return tuple(
        slider
        for slider in parts.sliders
        if slider.name not in controls
        and all(shape in shapes for shape, _ in slider.shapes)
        and (rig.bones is not None or not slider.channels)
    )


def at_rest(shape: Blendshape, matrices: FloatArray) -> Blendshape:
    """A shape whose offsets are turned point by point.

    :param matrices: (n, 3, 3) of the points of its mesh
    """
    turns = matrices[shape.point_indices]

    def turned(offsets: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("kij,kj->ki", turns, offsets))

    return shape.changed(turned, turned)


@dataclass(frozen=True, kw_only=True)
class BakedClips:
    """Clips as weights of shapes."""

    animations: tuple[Animation, ...]
    shapes: FloatArray  # (k, n, 3) millimetres, that they play beside those of the rig
    error_mm: float  # the largest, of any point


def baked_clips(
    parts: FaceParts,
    attached: FaceParts,
    animations: Sequence[Animation],
    shapes: Mapping[str, FloatArray],
    spaces: Sequence[FloatArray],
    tolerance: float,
) -> BakedClips:
    """Clips that turn joints, for a face with another skin: weights of shapes for where its joints don't bring points.

    :param attached: the face with that skin, without shapes
    :param shapes: (n, 3) millimetres at a weight of 1 of the shapes that it has for its rig
    :param spaces: (3, 3) of every mesh from skeleton space at bind time to millimetres of the shapes
    :param tolerance: millimetres that weights and further shapes may leave, RMS
    """
    frames = np.stack(
        [moved for animation in animations for moved in _beyond_joints(parts, attached, spaces, animation)]
    )
    left = frames.reshape(len(frames), -1)  # in place: frames may be many
    rig_shapes = np.array(list(shapes.values())).reshape(len(shapes), left.shape[1])
    weights = np.linalg.lstsq(rig_shapes @ rig_shapes.T, rig_shapes.astype(np.float32) @ left.T, rcond=1e-9)[0].T
    left -= weights.astype(np.float32) @ rig_shapes.astype(np.float32)
    further = _further(frames, tolerance)
    amounts = left @ further.reshape(len(further), left.shape[1]).T.astype(np.float32)
    sizes = np.maximum(np.abs(amounts).max(axis=0, initial=0.0), np.finfo(np.float32).eps)
    further, amounts = further * sizes[:, None, None], amounts / sizes
    left -= amounts @ further.reshape(len(further), left.shape[1]).astype(np.float32)
    every = (*shapes, *map(clip_shape_name, range(len(further))))
    rows = np.concatenate([weights, amounts], axis=1)
    ends = np.cumsum([animation.samples for animation in animations])
    return BakedClips(
        animations=tuple(
            replace(one, shapes=every, shape_weights=own_rows)
            for one, own_rows in zip(animations, np.split(rows, ends[:-1]), strict=True)
        ),
        shapes=further,
        error_mm=float(max(np.linalg.norm(frame, axis=1).max() for frame in frames)),
    )


def _further(frames: FloatArray, tolerance: float) -> FloatArray:
    """(k, n, 3) orthonormal shapes that leave `tolerance` of frames (f, n, 3), RMS; none where that is all there is."""
    squares = sum(float(np.square(frame, dtype=np.float64).sum()) for frame in frames)
    if squares <= tolerance**2 * len(frames) * frames.shape[1]:
        return np.zeros((0, *frames.shape[1:]))
    return motion_basis(frames[:: max(1, -(-len(frames) // _MOST_FRAMES))], tolerance, _MOST_SHAPES)[0]


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
