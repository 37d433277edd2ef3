"""glTF animations of joints and morph weights as animations of the face.

All channels of an animation are resampled at the union of their key times; between those times the result is
linear (rotations: slerp), which is what LINEAR channels are anyway.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.importers.gltf_document import Document
from facepipe.importers.gltf_json import Value
from facepipe.importers.gltf_morphs import Role
from facepipe.importers.gltf_names import Names
from facepipe.importers.gltf_nodes import Nodes, Trs, decompose, local_trs, trs_matrix
from facepipe.importers.gltf_samplers import Sampler, read_sampler, sample
from facepipe.importers.gltf_skins import Joints
from facepipe.parts import Animation, FloatArray

_PATHS = {"translation": ("VEC3", 3), "rotation": ("VEC4", 4), "scale": ("VEC3", 3)}


@dataclass(frozen=True)
class _Channel:
    node: int
    path: str
    sampler: Sampler


def read_animations(
    document: Document, nodes: Nodes, joints: Joints, shapes: Mapping[int, Sequence[Role]]
) -> tuple[Animation, ...]:
    """All animations that move joints or shapes.

    :param shapes: roles of the morph targets of every node that shows a mesh with some
    :raises InputError: samplers whose times or values don't fit
    """
    names = Names()
    found = []
    for value in document.entries("animations"):
        channels = _channels(document, value, joints, shapes)
        if channels:
            name = value.get("name")
            identifier = names.new("" if name is None else name.text(), "Animation")
            found.append(_animation(document, value, identifier, channels, nodes, joints, shapes))
    return tuple(found)


def _channels(document: Document, value: Value, joints: Joints, shapes: Mapping[int, Sequence[Role]]) -> list[_Channel]:
    samplers = value.require("samplers").items()
    found: dict[tuple[int, str], _Channel] = {}
    left_out = 0
    for channel in value.require("channels").items():
        target = channel.require("target")
        path, node = target.require("path").text(), target.get("node")
        index = -1 if node is None else document.index("nodes", node)
        moves_joint = path in _PATHS and index in joints.of_node
        if not moves_joint and not (path == "weights" and index in shapes):
            left_out += 1
            continue
        if (index, path) in found:
            raise channel.error(f"a second channel for {path} of nodes[{index}]")
        reference = channel.require("sampler")
        number = reference.integer()
        if number >= len(samplers):
            raise reference.error(f"{number}, but there are {len(samplers)} samplers")
        kind, width = _PATHS[path] if path in _PATHS else ("SCALAR", len(shapes[index]))
        found[index, path] = _Channel(index, path, read_sampler(document, samplers[number], kind, width))
    if left_out:
        document.warn(value, f"{left_out} channels move neither a joint nor a shape: left out")
    if any(channel.sampler.mode != "LINEAR" for channel in found.values()):
        document.warn(value, "STEP and CUBICSPLINE keys are sampled at the key times and linear between them")
    return list(found.values())


def _animation(
    document: Document,
    value: Value,
    name: str,
    channels: list[_Channel],
    nodes: Nodes,
    joints: Joints,
    shapes: Mapping[int, Sequence[Role]],
) -> Animation:
    times = np.unique(np.concatenate([channel.sampler.times for channel in channels]))
    moved = sorted({joints.of_node[channel.node] for channel in channels if channel.path in _PATHS})
    weights = [channel for channel in channels if channel.path == "weights"]
    width = 24 * len(moved) + 2 * sum(len(shapes[channel.node]) for channel in weights)
    document.budget.spend(8 * len(times) * width, value)
    motion = _joint_motion(document, value, times, channels, moved, nodes, joints) if moved else None
    shape_names, shape_weights = _shape_motion(document, value, times, weights, shapes)
    return Animation(
        name=name,
        times=times,
        joints=tuple(joints.skeleton.joints[joint] for joint in moved),
        translations=None if motion is None else motion.translation.astype(np.float32),
        rotations=None if motion is None else motion.rotation.astype(np.float32),
        scales=None if motion is None else motion.scale.astype(np.float32),
        shapes=shape_names,
        shape_weights=shape_weights,
    )


def _joint_motion(
    document: Document,
    value: Value,
    times: FloatArray,
    channels: list[_Channel],
    moved: list[int],
    nodes: Nodes,
    joints: Joints,
) -> Trs:
    """Local transforms (t, j, ...) of the joints `moved`; what no channel moves stays as the node has it."""
    by_target = {(channel.node, channel.path): channel.sampler for channel in channels}
    node_of = {joint: node for node, joint in joints.of_node.items()}
    tracks = []
    for joint in moved:
        node = node_of[joint]
        still = local_trs(nodes.values[node])
        parts = []
        for path, rest in zip(_PATHS, (still.translation, still.rotation, still.scale), strict=True):
            sampler = by_target.get((node, path))
            constant = np.tile(rest, (len(times), 1))
            parts.append(constant if sampler is None else sample(sampler, times, path == "rotation"))
        tracks.append(_under(document, value, joints.above[joint], Trs(*parts)))
    return Trs(
        np.stack([track.translation for track in tracks], axis=1),
        np.stack([track.rotation for track in tracks], axis=1),
        np.stack([track.scale for track in tracks], axis=1),
    )


def _under(document: Document, value: Value, above: FloatArray, track: Trs) -> Trs:
    """`track` below the fixed nodes `above`, as one transform."""
    if np.array_equal(above, np.eye(4)):
        return track
    matrices = above @ trs_matrix(track.translation, track.rotation, track.scale)
    folded, lost = decompose(matrices)
    if lost > 1e-5 * max(1.0, float(np.abs(matrices).max())):
        document.warn(value, f"scaled nodes between joints shear them: lost up to {lost:.2g}")
    return folded


def _shape_motion(
    document: Document,
    value: Value,
    times: FloatArray,
    channels: list[_Channel],
    shapes: Mapping[int, Sequence[Role]],
) -> tuple[tuple[str, ...], FloatArray | None]:
    """Shape names and weights (t, s). A shape's weight is the sum of its targets' activations times their weights:
    this undoes the activation curves of inbetweens, which are piecewise linear."""
    found: dict[str, FloatArray] = {}
    for channel in channels:
        values = sample(channel.sampler, times)
        own: dict[str, FloatArray] = {}
        for role, column in zip(shapes[channel.node], values.T, strict=True):
            own[role.shape] = own.get(role.shape, 0.0) + role.weight * column
        for shape, weights in own.items():
            if shape in found and np.abs(found[shape] - weights).max() > 1e-6:
                document.warn(value, f"the meshes move the shape {shape} differently: the first is kept")
            found.setdefault(shape, weights)
    if not found:
        return (), None
    return tuple(found), np.stack(list(found.values()), axis=1).astype(np.float32)
