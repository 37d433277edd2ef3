"""The skeleton as glTF nodes and a skin, poses and animations as glTF animations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Animation, Skeleton, exact
from facepipe.records import Json
from facepipe.rig.animation import TICK, local_transforms
from facepipe.rig.trs import Trs, accumulate, decompose
from facepipe_gltf.baking import Sculpt
from facepipe_gltf.buffers import Buffers
from facepipe_gltf.placement import Space, numbers

_INHERITED_SHEAR_TOLERANCE = 1e-4
_UNEVEN = 1e-5  # of scales along the axes of a joint
_NEAR = 1e-5  # seconds
_SAME = 1e-7  # joints nearer to rest than this (metres, quaternion and scale units) get no channel


@dataclass(frozen=True)
class JointNodes:
    """The nodes of a skeleton.

    A joint whose rest transform is sheared, or a root under a scaled or mirrored placement, gets a node above it that
    takes what no TRS can hold: `offsets` takes it off that joint's local matrices, and is the identity for all others.
    """

    nodes: list[Json]
    roots: list[int]  # node indices at the top
    of_joint: list[int]  # node index of each joint
    offsets: FloatArray  # (j, 4, 4) inverse of the node above each joint that is no joint
    rest: Trs  # of the joints' own nodes
    warnings: list[str]


def joint_nodes(skeleton: Skeleton, space: Space, first: int, *, person: bool = False) -> JointNodes:
    """Nodes numbered from `first`, joints in skeleton order, each at rest.

    :param person: rest is a person: uneven scales go to a node above too, since a joint that turns under them is no TRS
    """
    parents = skeleton.parents
    local = space.local(np.asarray(skeleton.rest_transforms, dtype=np.float64), parents < 0)
    turned = space.local(np.asarray(skeleton.rest_transforms, dtype=np.float64), np.zeros(len(local), np.bool_))
    at_rest = decompose(turned)
    sizes = np.abs(at_rest.scale)
    uneven = np.ptp(sizes, axis=-1) > _UNEVEN * sizes.max(axis=-1)
    linear = space.placement[:3, :3]
    rigid = np.allclose(linear.T @ linear, np.eye(3), rtol=0, atol=1e-9) and np.linalg.det(linear) > 0
    unholdable: dict[int, FloatArray] = {}  # joints that need a node above them, with the matrix that it must take
    for joint, parent in enumerate(parents):
        if at_rest.sheared[joint] or (person and uneven[joint]):
            unholdable[joint] = local[joint]
        elif parent < 0 and not rigid:
            unholdable[joint] = space.placement
    above = np.tile(np.eye(4), (len(local), 1, 1))
    for joint, matrix in unholdable.items():
        # T U S of ``matrix = T U S V``: what is left of it is the rotation V, so both are TRS
        U, scale, Vt = np.linalg.svd(matrix[:3, :3])
        above[joint, :3, :3] = (-U if np.linalg.det(Vt) < 0 else U) * scale
        above[joint, :3, 3] = matrix[:3, 3]
    offsets = np.linalg.inv(above)
    # an animated node is TRS and holds no shear: a node above takes that, and offsets take it out again
    rest = decompose(offsets @ local)
    names = list(skeleton.joint_names)
    if not names:  # the last part of each path, or the whole path where that is ambiguous
        times = Counter(skeleton.names)
        pairs = zip(skeleton.names, skeleton.joints, strict=True)
        names = [leaf if times[leaf] == 1 else joint.replace("/", "_") for leaf, joint in pairs]
    nodes = [_node(name, rest, i) for i, name in enumerate(names)]
    top = list(range(first, first + len(nodes)))  # node that stands for each joint among its siblings
    for joint in unholdable:
        top[joint] = first + len(nodes)
        helper = _node(f"{names[joint]}_parent", decompose(above[joint][None]), 0)
        nodes.append(helper | {"children": [first + joint]})
    for joint, parent in enumerate(parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(top[joint])
    roots = [top[joint] for joint in np.flatnonzero(parents < 0)]
    if len(roots) > 1:  # joints of one skin need a common root
        nodes.append({"name": skeleton.name, "children": roots})
        roots = [first + len(nodes) - 1]
    helped = [] if person else list(unholdable)
    warnings = [f"{skeleton.joints[joint]}: sheared at rest, held by an extra node above" for joint in helped]
    mirrored = np.flatnonzero((rest.scale < 0).any(axis=-1))
    warnings += [f"{skeleton.joints[joint]}: negative scale at rest; not every engine keeps it" for joint in mirrored]
    inherited = np.flatnonzero(_has_shear(accumulate(local, parents)))
    if len(inherited):
        example = skeleton.joints[inherited[0]]
        warnings.append(
            f"{example}: shear inherited from scaled parents ({len(inherited)} joints); not every engine keeps it"
        )
    return JointNodes(nodes, roots, list(range(first, first + len(local))), offsets, rest, warnings)


def _has_shear(worlds: FloatArray) -> FloatArray:
    """(...,) whether the axes of (..., 4, 4) matrices are not at right angles."""
    linear = worlds[..., :3, :3]
    length = np.linalg.norm(linear, axis=-2, keepdims=True)
    axes = linear / np.where(length == 0, 1.0, length)
    gram = np.abs(np.swapaxes(axes, -1, -2) @ axes) * (1 - np.eye(3))
    return np.asarray(gram.max(axis=(-1, -2)) > _INHERITED_SHEAR_TOLERANCE)


def _node(name: str, trs: Trs, i: int) -> Json:
    node: Json = {"name": name}
    if trs.translation[i].any():
        node["translation"] = numbers(trs.translation[i])
    rotation = numbers(trs.rotation[i])
    if rotation != [0.0, 0.0, 0.0, 1.0]:
        node["rotation"] = rotation
    scale = numbers(trs.scale[i])
    if scale != [1.0, 1.0, 1.0]:
        node["scale"] = scale
    return node


@dataclass(frozen=True)
class AnimationWriter:
    """Writes animations for the joints and morph targets that are in the file."""

    skeleton: Skeleton
    space: Space
    joints: JointNodes | None  # None: no joints in the file
    targets: Mapping[int, Sequence[Sculpt]]  # mesh node -> its morph targets
    buffers: Buffers
    warnings: list[str]

    def write(self, animation: Animation) -> Json | None:
        """The glTF animation; None where the file has nothing that it moves."""
        times = np.zeros(1) if animation.times is None else np.asarray(animation.times, dtype=np.float64)
        if len(times) and times[0] < 0:
            self.warnings.append(f"{animation.name}: starts at {times[0]:g} s, moved to 0 s: glTF has no negative time")
            times = times - times[0]
        result: Json = {"name": exact(animation), "channels": [], "samplers": []}
        if self.joints is not None and animation.joints:
            self._joint_channels(result, animation, times, self.joints)
        column = {shape: i for i, shape in enumerate(animation.shapes)}
        weights = np.asarray(animation.shape_weights, dtype=np.float64)
        for node, sculpts in self.targets.items():
            if animation.shape_weights is None or not any(one.shape in column for one in sculpts):
                continue
            # between the keys activations bend where a shape passes an inbetween: keys there too
            all_keys = [times]
            for sculpt in sculpts:
                if sculpt.is_inbetween and sculpt.shape in column:
                    track = weights[:, column[sculpt.shape]]
                    before, after = track[:-1], track[1:]
                    for knot, _ in sculpt.knots[1:-1]:
                        crossed = np.flatnonzero((before - knot) * (after - knot) < 0)
                        part = (knot - before[crossed]) / (after[crossed] - before[crossed])
                        all_keys.append(times[crossed] + part * np.diff(times)[crossed])
            keys = np.concatenate(all_keys)
            keys = keys[np.unique(keys.astype(np.float32), return_index=True)[1]]
            values = np.zeros((len(keys), len(sculpts)))
            for i, sculpt in enumerate(sculpts):
                if sculpt.shape in column:
                    # the target's activation at its shape's weights: piecewise linear, the ends extended
                    at_keys = np.interp(keys, times, weights[:, column[sculpt.shape]])
                    x, y = np.array(sculpt.knots, dtype=np.float64).T
                    piece = np.clip(np.searchsorted(x, at_keys, side="right") - 1, 0, len(x) - 2)
                    slope = (y[piece + 1] - y[piece]) / (x[piece + 1] - x[piece])
                    values[:, i] = y[piece] + slope * (at_keys - x[piece])
            keyed = self.buffers.add(keys.astype(np.float32), "keys", bounds=True)
            _channel(result, self.buffers, keys, keyed, values, node, "weights")
        return result if result["channels"] else None

    def _joint_channels(self, result: Json, animation: Animation, times: FloatArray, joints: JointNodes) -> None:
        number = {joint: i for i, joint in enumerate(self.skeleton.joints)}
        rows = [i for i, joint in enumerate(animation.joints) if joint in number]
        if len(rows) < len(animation.joints):
            missing = next(joint for joint in animation.joints if joint not in number)
            self.warnings.append(f"{animation.name}: joint '{missing}' is not in the skeleton")
        if not rows:
            return
        used = np.array([number[animation.joints[i]] for i in rows])
        local = local_transforms(self.skeleton, animation, np.array(rows))
        nodes = joints.offsets[used] @ self.space.local(local, self.skeleton.parents[used] < 0)
        trs = decompose(nodes)
        for joint in used[np.flatnonzero(trs.sheared.any(axis=0))]:
            self.warnings.append(
                f"{animation.name} -> {self.skeleton.joints[joint]}: sheared local transform, nearest TRS kept"
            )
        at_rest = self.space.local(
            np.asarray(self.skeleton.rest_transforms, dtype=np.float64), self.skeleton.parents < 0
        )
        every = np.repeat((joints.offsets @ at_rest)[None], len(nodes), axis=0)
        every[:, used] = nodes
        inherited = _has_shear(accumulate(np.linalg.inv(joints.offsets) @ every, self.skeleton.parents)).any(axis=0)
        if inherited.any():
            example = self.skeleton.joints[int(np.argmax(inherited))]
            self.warnings.append(
                f"{animation.name} -> {example}: shear inherited from scaled parents; not every engine keeps it"
            )
        keyed = self.buffers.add(times.astype(np.float32), "keys", bounds=True)
        rest = joints.rest
        # (j, 3) which of translation, rotation and scale leave rest at any key
        flipped = np.where((trs.rotation * rest.rotation[used]).sum(axis=-1, keepdims=True) < 0, -1.0, 1.0)
        differences = (
            trs.translation - rest.translation[used],
            trs.rotation * flipped - rest.rotation[used],
            trs.scale - rest.scale[used],
        )
        changed = np.stack([(np.abs(difference) > _SAME).any(axis=(0, 2)) for difference in differences], axis=1)
        if not changed.any():
            changed[0, 0] = True  # a pose at rest keeps its name
        # q and -q turn alike, but a reader that blends their numbers passes through 0 between them
        rotations = trs.rotation
        # (T, j, 4) quaternions, signs chosen so that neighbouring keys lie on the same side
        steps = np.where(np.einsum("tjk,tjk->tj", rotations[1:], rotations[:-1]) < 0, -1.0, 1.0)
        signs = np.cumprod(np.concatenate([np.ones((1, rotations.shape[1])), steps]), axis=0)
        values = (trs.translation, np.asarray(rotations * signs[..., None]), trs.scale)
        for i, joint in enumerate(used):
            for path, name in enumerate(("translation", "rotation", "scale")):
                if changed[i, path]:
                    _channel(result, self.buffers, times, keyed, values[path][:, i], joints.of_joint[joint], name)


def _channel(
    result: Json, buffers: Buffers, times: FloatArray, keyed: int, values: FloatArray, node: int, path: str
) -> None:
    """Add a channel: (t, width) values at `times`, which are the accessor `keyed`."""
    # a track that changes only within ticks, as imports write STEP, is STEP again: of its keys, those that hold
    changes = (np.diff(values, axis=0) != 0).any(axis=1)
    ticks = np.abs(np.diff(times) - TICK) < _NEAR
    held = changes.any() and not (changes & ~ticks).any() and not (changes[1:] & changes[:-1]).any()
    if held:
        kept = np.concatenate([[True], ~changes[1:], [True]])
        keyed, values = buffers.add(times[kept].astype(np.float32), "keys", bounds=True), values[kept]
    output = buffers.add((values.ravel() if path == "weights" else values).astype(np.float32), "keys")
    result["channels"].append({"sampler": len(result["samplers"]), "target": {"node": node, "path": path}})
    result["samplers"].append({"input": keyed, "output": output, "interpolation": "STEP" if held else "LINEAR"})
