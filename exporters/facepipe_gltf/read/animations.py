"""glTF animations of joints and morph weights as animations of the face.

All channels of an animation are resampled at the union of their key times and of those that `_times` adds for
STEP and CUBICSPLINE; between these the result is linear (rotations: slerp), which is what LINEAR channels are anyway.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.names import first_names, handles
from facepipe.parts import Animation
from facepipe.rig.animation import ON_FRAME, TICK, between, whole_frames, with_exact_scales
from facepipe.rig.trs import compose, decompose, slerp
from facepipe_gltf.read import accessors
from facepipe_gltf.read.document import Document, Value, given_name
from facepipe_gltf.read.meshes import Role
from facepipe_gltf.read.skins import Joints, Nodes, animated_property, local_trs

_RATES = (24.0, 25.0, 30.0, 50.0, 60.0, 120.0)  # frames per second that files are made at
_TOLERANCE = {"translation": 5e-5, "rotation": 5e-4, "scale": 5e-4, "weights": 5e-4}  # of curves: metres, radians, 1
_UNITS = {"translation": (1e3, " mm"), "rotation": (1.0, " rad"), "scale": (1.0, ""), "weights": (1.0, "")}
_NONE = 1e-6  # an error below this is that of float32
_MOST = 64  # lines that stand for the curve between two keys
_WITHIN = 4  # points of a line where its distance from the curve is measured
_AT_ONCE = 1 << 20  # numbers
_ALIKE = 1e-3  # weights of two meshes at one time: keys between those of the other are float32 too
_TYPES = {"translation": "VEC3", "rotation": "VEC4", "scale": "VEC3"}  # of accessors; of morph weights SCALAR


@dataclass(frozen=True)
class Channel:
    """The track of one property of a node."""

    node: int
    path: str  # translation, rotation, scale, weights
    value: Value  # of its sampler
    mode: str  # STEP, LINEAR or CUBICSPLINE
    times: FloatArray  # (k,) seconds, ascending
    keys: FloatArray  # (k, width)
    tangents: tuple[FloatArray, FloatArray] | None  # (k, width) in and out, for CUBICSPLINE
    weight: int | None = None  # of the node's morph weights this one alone

    def at(self, times: FloatArray) -> FloatArray:
        """(t, width) values at `times` (t,), held before the first key and after the last; rotations of unit length."""
        rotation = self.path == "rotation"
        left, right, share = between(self.times, times)
        span, share = self.times[right] - self.times[left], share[:, None]
        a, b = self.keys[left], self.keys[right]
        if self.mode == "STEP" or len(self.times) == 1:
            values = a
        elif self.tangents is not None:
            # Hermite's cubic of glTF 2.0, appendix C.5: tangents are per second, so times the length of the span
            arrive, leave = self.tangents
            out = span[:, None] * leave[left]
            into = span[:, None] * arrive[right]
            s2, s3 = share * share, share * share * share
            values = np.asarray(
                (2 * s3 - 3 * s2 + 1) * a + (s3 - 2 * s2 + share) * out + (3 * s2 - 2 * s3) * b + (s3 - s2) * into
            )
        elif rotation:
            values = slerp(self._unit(a), self._unit(b), share)
        else:
            values = np.where(share == 0.0, a, a + share * (b - a))
        return self._unit(values) if rotation else values

    def _unit(self, quaternions: FloatArray) -> FloatArray:
        length = np.linalg.norm(quaternions, axis=1, keepdims=True)
        if length.min() < 1e-6:
            raise self.value.require("output").error("a rotation of length 0, expected unit quaternions")
        return np.asarray(quaternions / length)


def lines_error(channels: Sequence[Channel], times: FloatArray) -> str:
    """Largest distances of the lines between samples at `times` from the channels, as text."""
    largest: dict[str, float] = {}
    for channel in channels:
        off = float(_deviation(channel, times[:-1], times[1:], 1).max(initial=0.0))
        largest[channel.path] = max(largest.get(channel.path, 0.0), off)
    shown = [(path, *_UNITS[path]) for path in _UNITS if largest.get(path, 0.0) > _NONE]
    return ", ".join(f"{path} {largest[path] * factor:.2g}{unit}" for path, factor, unit in shown) or "nothing"


def _frames_off(times: FloatArray, rate: float) -> FloatArray:
    return np.asarray(np.abs(times * rate - np.rint(times * rate)))


def _deviation(channel: Channel, start: FloatArray, end: FloatArray, lines: int) -> FloatArray:
    """(k,) largest distance of a channel from `lines` straight lines between each `start` and `end` (k,)."""
    points, rotation = lines * _WITHIN, channel.path == "rotation"
    step = max(1, _AT_ONCE // ((points + 1) * channel.keys.shape[1]))
    distances: list[FloatArray] = [np.zeros(0)]
    for first in range(0, len(start), step):
        begin, span = start[first : first + step, None], (end - start)[first : first + step, None]
        times = begin + span * (np.arange(points + 1) / points)
        values = channel.at(times.ravel()).reshape(*times.shape, -1)
        # from the lines through every `_WITHIN`th value
        ends = values[:, ::_WITHIN]
        a, b = ends[:, :-1, None], ends[:, 1:, None]
        if rotation:
            b = np.where((a * b).sum(axis=-1, keepdims=True) < 0.0, -b, b)
        line = a + (np.arange(_WITHIN) / _WITHIN)[:, None] * (b - a)
        curve = values[:, :-1].reshape(line.shape)
        if not rotation:
            distances.append(np.abs(curve - line).max(axis=(1, 2, 3)))
            continue
        # the angle of a turn by its chord on the sphere of quaternions, where q and -q turn alike
        line = line / np.maximum(np.linalg.norm(line, axis=-1, keepdims=True), 1e-9)
        chord = np.minimum(np.linalg.norm(curve - line, axis=-1), np.linalg.norm(curve + line, axis=-1))
        distances.append(4.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)).max(axis=(1, 2)))
    return np.concatenate(distances)


def read_animations(
    document: Document,
    nodes: Nodes,
    joints: Joints,
    shapes: Mapping[int, Sequence[Role]],
    fps: float | None = None,
) -> tuple[tuple[Animation, ...], float]:
    """All animations that move joints or shapes, and the frames per second that their keys fall on.

    One with a single key is a pose.

    :param shapes: roles of the morph targets of every node that shows a mesh with some
    :param fps: frames per second to sample at; None: the keys, as they are
    :raises InputError: samplers whose times or values don't fit
    """
    read = []
    for value in document.entries("animations"):
        channels = _channels(document, value, joints, shapes)
        if channels:
            read.append((value, channels))
    defaults = default_weights(document, nodes, shapes)
    keys = [channel.times for _, channels in read for channel in channels]
    # whole frames of the keys of all animations, as a stage has one timeCodesPerSecond; film's where no rate fits
    every = np.concatenate(keys) if keys else np.zeros(0)
    fitting = (rate for rate in _RATES if _frames_off(every, rate).max(initial=0.0) < ON_FRAME)
    rate = fps or next(fitting, _RATES[0])
    names = handles([given_name(value) or "" for value, _ in read], "Animation")
    animations = []
    for name, (value, channels) in zip(names, read, strict=True):
        sampled = _times(document, value, channels, fps)
        animation = _animation(document, value, name, channels, nodes, joints, shapes, sampled, defaults)
        if (times := animation.times) is not None:
            # whole frames where float32 makes no difference, unless two times would become one
            rounded = np.where(_frames_off(times, rate) < ON_FRAME, np.rint(times * rate) / rate, times)
            animation = replace(animation, times=rounded if (np.diff(rounded) > 0).all() else times)
        animations.append(animation)
    pose = _default_pose(document, nodes, shapes, defaults, names)
    return (*animations, *([] if pose is None else [pose])), rate


def _times(document: Document, value: Value, channels: Sequence[Channel], fps: float | None) -> FloatArray:
    """(t,) seconds to sample an animation at: its keys and times added between them, or whole frames of `fps`.

    Warns of what this does to its keys.
    """
    if fps is not None:
        first = min(channel.times[0] for channel in channels)
        last = max(channel.times[-1] for channel in channels)
        document.budget.spend(int(min(8.0 * fps * float(last - first), 1e15)), value.error)
        times = whole_frames(first, last, fps)
        document.budget.spend(8 * len(times), value.error)
        document.warn(value, f"sampled at {fps:g} frames per second: off by at most {lines_error(channels, times)}")
        return times
    held = [channel for channel in channels if channel.mode == "STEP"]
    curves = [channel for channel in channels if channel.mode == "CUBICSPLINE"]
    times_of_all = [channel.times for channel in channels]
    for channel in held:  # just before each key whose value differs from the one before
        changes = (np.diff(channel.keys, axis=0) != 0).any(axis=1)
        span = np.diff(channel.times)
        times_of_all.append((channel.times[1:] - np.minimum(TICK, span / 2))[changes])
    for channel in curves:  # keys that make lines of each curve, more where it bends more
        start, end, lines = channel.times[:-1], channel.times[1:], 1
        while len(start) and lines < _MOST:
            bent = _deviation(channel, start, end, lines) > _TOLERANCE[channel.path]
            start, end, lines = start[bent], end[bent], 2 * lines
            times_of_all.append((start[:, None] + (end - start)[:, None] * (np.arange(1, lines) / lines)).ravel())
    times = np.concatenate(times_of_all)
    times = times[np.unique(times.astype(np.float32), return_index=True)[1]]  # the first of those alike: a key
    document.budget.spend(8 * len(times), value.error)
    if held:
        document.warn(value, f"STEP keys are held until {TICK * 1000:.2g} ms before the next")
    if curves:
        document.warn(value, f"CUBICSPLINE keys became lines: off by at most {lines_error(curves, times)}")
    return times


def _read_channel(document: Document, value: Value, node: int, path: str, width: int) -> Channel:
    """The channel of a node's property, by the sampler at `value` of `width` numbers a key.

    :raises InputError: times that don't ascend, or keys that don't fit them
    """
    mode = value.get_or("interpolation", "LINEAR").text()
    if mode not in ("STEP", "LINEAR", "CUBICSPLINE"):
        raise value.error(f"interpolation {ascii(mode)[:40]}, expected STEP, LINEAR or CUBICSPLINE")
    times = accessors.floats(document, value.require("input"), "SCALAR")[:, 0].astype(np.float64)
    if np.any(np.diff(times) <= 0.0):
        raise value.require("input").error("key times that don't ascend")
    output = value.require("output")
    read = accessors.floats(document, output, _TYPES.get(path, "SCALAR")).astype(np.float64)
    rows = 3 if mode == "CUBICSPLINE" else 1
    if read.size != len(times) * width * rows:
        raise output.error(f"{read.size} numbers for {len(times)} keys, expected {len(times) * width * rows}")
    # a cubic key is three rows: in-tangent, value, out-tangent
    keys = read.reshape(len(times), rows, width)
    tangents = (keys[:, 0], keys[:, 2]) if rows == 3 else None
    return Channel(node, path, value, mode, times, keys[:, rows // 2], tangents)


def _channels(
    document: Document, value: Value, joints: Joints, shapes: Mapping[int, Sequence[Role]], *, quiet: bool = False
) -> list[Channel]:
    samplers = value.require("samplers").items()
    channels: dict[tuple[int, str, int | None], Channel] = {}
    left_out = 0
    for channel in value.require("channels").items():
        found = animated_property(document, channel.require("target"))
        nodes, path, weight = ((-1,), "", None) if found is None else found
        for index in nodes:
            moves_joint = path in _TYPES and index in joints.of_node
            moves_shape = path == "weights" and index in shapes and (weight is None or weight < len(shapes[index]))
            if not moves_joint and not moves_shape:
                left_out += 1
                continue
            # glTF 2.0 forbids two channels of one target: which one wins would depend on the reader
            if (index, path, weight) in channels:
                raise channel.error(f"a second channel for {path} of nodes[{index}]")
            reference = channel.require("sampler")
            number = reference.integer()
            if number >= len(samplers):
                raise reference.error(f"{number}, but there are {len(samplers)} samplers")
            own = 1 if weight is not None else len(shapes[index]) if path == "weights" else 0
            width = own or int(_TYPES[path][-1])
            read = _read_channel(document, samplers[number], index, path, width)
            channels[index, path, weight] = replace(read, weight=weight)
    if left_out and not quiet:
        document.warn(value, f"{left_out} channels move neither a joint nor a shape: left out")
    return list(channels.values())


def _animation(
    document: Document,
    value: Value,
    name: str,
    channels: list[Channel],
    nodes: Nodes,
    joints: Joints,
    shapes: Mapping[int, Sequence[Role]],
    times: FloatArray,
    defaults: Mapping[int, Mapping[str, float]],
) -> Animation:
    moved = sorted({joints.of_node[channel.node] for channel in channels if channel.path in _TYPES})
    weights = [channel for channel in channels if channel.path == "weights"]
    width = 24 * len(moved) + 2 * sum(channel.keys.shape[1] for channel in weights)
    # before sampling: a few keys far apart ask for more frames than memory holds
    document.budget.spend(8 * len(times) * width, value.error)
    motion = _joint_motion(document, value, times, channels, moved, nodes, joints) if moved else None
    shape_names, shape_weights = _shape_motion(document, value, times, weights, shapes, defaults)
    label = given_name(value)
    animation = Animation(
        name=name,
        label=label if label != name else None,
        times=times if len(times) > 1 else None,
        joints=tuple(joints.skeleton.joints[joint] for joint in moved),
        translations=None if motion is None else motion[0].astype(np.float32),
        rotations=None if motion is None else motion[1].astype(np.float32),
        scales=None if motion is None else motion[2].astype(np.float32),
        shapes=shape_names,
        shape_weights=shape_weights,
    )
    animation, lost = with_exact_scales(joints.skeleton, animation)
    if lost:
        document.warn(value, lost)
    return animation


def _joint_motion(
    document: Document,
    value: Value,
    times: FloatArray,
    channels: list[Channel],
    moved: list[int],
    nodes: Nodes,
    joints: Joints,
) -> list[FloatArray]:
    """Translations (t, j, 3), rotations (t, j, 4) and scales (t, j, 3) of the joints `moved`; what no channel moves
    stays as the node has it."""
    by_target = {(channel.node, channel.path): channel for channel in channels}
    node_of = {joint: node for node, joint in joints.of_node.items()}
    tracks = []
    for joint in moved:
        node = node_of[joint]
        parts = []
        for path, rest in zip(_TYPES, local_trs(nodes.values[node]), strict=True):
            channel = by_target.get((node, path))
            constant = np.tile(rest, (len(times), 1))
            parts.append(constant if channel is None else channel.at(times))
        # nodes between two joints are none on the stage: what they do goes into the lower joint's track
        above = joints.above[joint]
        if not np.array_equal(above, np.eye(4)):
            matrices = above @ compose(*parts)
            if not np.isfinite(matrices).all():
                raise value.error("joint transforms that are not finite")
            parts = [*decompose(matrices)[:3]]
            lost = float(np.abs(compose(*parts) - matrices).max(initial=0.0))
            if lost > 1e-5 * max(1.0, float(np.abs(matrices).max())):
                document.warn(value, f"scaled nodes between joints shear them: lost up to {lost:.2g}")
        tracks.append(parts)
    return [np.stack(parts, axis=1) for parts in zip(*tracks, strict=True)]


def _shape_motion(
    document: Document,
    value: Value,
    times: FloatArray,
    channels: list[Channel],
    shapes: Mapping[int, Sequence[Role]],
    defaults: Mapping[int, Mapping[str, float]],
) -> tuple[tuple[str, ...], FloatArray | None]:
    """Shape names and weights (t, s); of meshes that move one shape differently the first.

    Shapes that no channel moves stay at the default weights of their nodes, as viewers show them.
    """
    by_shape: dict[str, FloatArray] = {}
    for of_node in _by_node(channels, times, shapes).values():
        for shape, weights in of_node.items():
            if shape in by_shape and np.abs(by_shape[shape] - weights).max() > _ALIKE:
                document.warn(value, f"the meshes move the shape {shape} differently: the first is kept")
            by_shape.setdefault(shape, weights)
    for still in defaults.values():
        for shape, weight in still.items():
            if weight and shape not in by_shape:
                by_shape[shape] = np.full(len(times), weight)
    if not by_shape:
        return (), None
    document.budget.spend(8 * len(times) * len(by_shape), value.error)
    return tuple(by_shape), np.stack(list(by_shape.values()), axis=1).astype(np.float32)


def _by_node(
    channels: Sequence[Channel], times: FloatArray, shapes: Mapping[int, Sequence[Role]]
) -> dict[int, dict[str, FloatArray]]:
    """(t,) weights of the shapes of each node. A shape's weight is the sum of its targets' activations times their
    weights: this undoes the activation curves of inbetweens, which are piecewise linear."""
    found: dict[int, dict[str, FloatArray]] = {}
    for channel in channels:
        own = shapes[channel.node] if channel.weight is None else [shapes[channel.node][channel.weight]]
        of_node = found.setdefault(channel.node, {})
        for role, column in zip(own, channel.at(times).T, strict=True):
            # w = sum_i weight_i activation_i(w), exact as activations are linear between the weights of sculpts
            of_node[role.shape] = of_node.get(role.shape, 0.0) + role.weight * column
    return found


def nodes_apart(
    document: Document, nodes: Nodes, joints: Joints, shapes: Mapping[int, Sequence[Role]]
) -> dict[int, tuple[str, ...]]:
    """Shapes of nodes that an animation plays, or default weights show, otherwise than those of an earlier node.

    A node that shows the mesh of another and that no channel moves stands still; one with a mesh of its own follows the
    shapes of its names, as teeth do the jaw, and a warning says so. Default weights count where nodes share a mesh.
    """
    apart: dict[int, dict[str, None]] = {}
    meshes = {node: nodes.values[node].require("mesh").integer() for node in shapes}
    following: dict[int, dict[str, None]] = {}
    for value in document.entries("animations"):
        channels = [one for one in _channels(document, value, joints, shapes, quiet=True) if one.path == "weights"]
        if not channels:
            continue
        times = np.unique(np.concatenate([channel.times for channel in channels]))
        document.budget.spend(8 * len(times) * sum(channel.keys.shape[1] for channel in channels), value.error)
        played = _by_node(channels, times, shapes)
        first: dict[str, FloatArray] = {}
        moved = {shape for of_node in played.values() for shape, weights in of_node.items() if weights.any()}
        players = Counter(meshes[node] for node in played)
        for node in shapes:
            own, still = played.get(node, {}), players[meshes[node]] > (node in played)
            if node not in played and not still:
                followed = [role.shape for role in shapes[node] if role.shape in moved]
                following.setdefault(node, {}).update(dict.fromkeys(followed))
            zeros = dict.fromkeys([role.shape for role in shapes[node]] if still else (), np.zeros(len(times)))
            for shape, weights in {**zeros, **own}.items():
                if np.abs(first.setdefault(shape, weights) - weights).max() > _ALIKE:
                    apart.setdefault(node, {})[shape] = None
    for node, names in following.items():
        if names:
            what = f"no channel plays its shapes ({first_names([*names], 4)}): they follow those of their names"
            document.warn(nodes.values[node], what)
    shown: dict[tuple[int, str], float] = {}
    for node, still_of in default_weights(document, nodes, shapes).items():
        for shape, weight in still_of.items():
            if abs(shown.setdefault((meshes[node], shape), weight) - weight) > _ALIKE:
                apart.setdefault(node, {})[shape] = None
    return {node: tuple(names) for node, names in apart.items()}


def default_weights(
    document: Document, nodes: Nodes, shapes: Mapping[int, Sequence[Role]]
) -> dict[int, dict[str, float]]:
    """The weights of the shapes of each node where nothing plays: 0 where neither it nor its mesh has some.

    A node's weights win over those of its mesh (glTF 2.0 section 3.7.2.2).
    """
    found: dict[int, dict[str, float]] = {}
    for node, own in shapes.items():
        value = nodes.values[node]
        given = value.get("weights") or document.entry("meshes", value.require("mesh")).get("weights")
        numbers = (0.0,) * len(own) if given is None or len(given.items()) != len(own) else given.numbers()
        of_node = found.setdefault(node, {})
        for role, weight in zip(own, numbers, strict=True):
            of_node[role.shape] = of_node.get(role.shape, 0.0) + role.weight * weight
    return found


def _default_pose(
    document: Document,
    nodes: Nodes,
    shapes: Mapping[int, Sequence[Role]],
    defaults: Mapping[int, Mapping[str, float]],
    taken: Sequence[str],
) -> Animation | None:
    """The default morph weights of a file as a pose; None where all are 0."""
    found: dict[str, float] = {}
    for node, of_node in defaults.items():
        value = nodes.values[node]
        given = value.get("weights") or document.entry("meshes", value.require("mesh")).get("weights")
        if given is not None and len(given.items()) != len(shapes[node]):
            document.warn(given, f"{len(given.items())} default weights of {len(shapes[node])} targets: left out")
        others = [shape for shape, weight in of_node.items() if abs(found.setdefault(shape, weight) - weight) > _ALIKE]
        if others:
            what = f"shows {first_names(others, 4)} otherwise than an earlier node of these shapes: that is kept"
            document.warn(value, what)
    moved = {shape: weight for shape, weight in found.items() if weight}
    if not moved:
        return None
    name = handles([*taken, "default"], "Animation")[-1]
    weights = np.array([[*moved.values()]], np.float32)
    return Animation(name=name, shapes=tuple(moved), shape_weights=weights)
