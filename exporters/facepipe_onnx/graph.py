"""From a rig to an ONNX graph.

Inputs, where the face has what they move: ``weights`` [batch, shapes]; ``coefficients`` [batch, joints, 9] or
``joint_transforms`` [batch, joints, 4, 4]; ``parent`` [batch, 4, 4] by option. Outputs: ``points`` [batch, points, 3],
world space, stage units, in the order of `Rig.points`; ``joint_matrices`` [batch, joints, 4, 4] and ``normals``
[batch, points, 3] by option. Matrices are for column vectors, row by row (the translation is the last column).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy import sparse

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import ExportError
from facepipe.core.names import select
from facepipe.onnx_graph import Nodes
from facepipe.rig import Rig
from facepipe_onnx.deform import (
    OFFSET_BYTES,
    WEIGHT_BYTES,
    Ends,
    Partition,
    block_size,
    joint_columns,
    morph_nodes,
    moved_lengths,
    normal_nodes,
    partition,
    skin_nodes,
    skinning_nodes,
    tree_order,
    world_nodes,
)
from facepipe_onnx.options import Options


def select_shapes(rig: Rig, names: tuple[str, ...]) -> Rig:
    """The rig with only the shapes `names`."""
    number = {name: i for i, name in enumerate(names)}
    kept = [t for t in rig.targets if rig.shapes[t.shape] in number]
    targets = tuple(dataclasses.replace(t, shape=number[rig.shapes[t.shape]]) for t in kept)
    return dataclasses.replace(rig, shapes=names, targets=targets)


def build(rig: Rig, options: Options | None = None, *, triangles: IntArray | None = None) -> Any:
    """The graph of a rig as an `onnx.ModelProto`, without metadata.

    :param triangles: (t, 3) point indices; needed for the `normals` option
    :raises InputError: an option out of range, or a shape glob that matches nothing
    :raises ExportError: nothing that deforms, or more than the 2 GB that a file can hold
    """
    options = options or Options()
    options.check()
    rig = select_shapes(rig, select(rig.shapes, options.shapes, "shapes"))
    if not len(rig.points):
        raise ExportError(rig.name, "no points, expected a mesh")
    if not (rig.shapes or rig.joints or options.parent):
        raise ExportError(rig.name, "no blendshapes and no joints, expected something that deforms the points")
    if options.joint_matrices and not rig.joints:
        raise ExportError(rig.name, "no joints, expected some for the output joint_matrices")
    nodes = Nodes()
    worlds = ""
    if rig.joints:
        matrices = options.inputs == "matrices"
        worlds = world_nodes(nodes, rig, matrices=matrices, parent=options.parent, batch=options.batch)
    if rig.joints or options.parent:
        order = tree_order(rig.parents)[0]

        def ends(constants: FloatArray) -> str:
            return nodes.add("MatMul", worlds, nodes.constant("inverse_bind", constants[order]))

        skinned(nodes, rig, ends if worlds else None, options)
    else:
        rigid(nodes, rig, options.batch)
    if worlds and options.joint_matrices:
        # made by depth, one product a level; callers count joints as the stage does
        nodes.add(
            "Gather", worlds, nodes.indices(np.argsort(tree_order(rig.parents)[0])), axis=1, name="joint_matrices"
        )
    if options.normals:
        normal_nodes(nodes, "points", len(rig.points), checked_triangles(rig, triangles), options.batch)
    return nodes.model("deformer", rig.name, *signature(rig, options))


def checked_triangles(rig: Rig, triangles: IntArray | None) -> IntArray:
    if triangles is None or not len(triangles):
        raise ExportError(rig.name, "no faces, expected some for the output normals")
    return triangles


def rigid(nodes: Nodes, rig: Rig, batch: int, activations: str | None = None) -> None:
    """`points` of a face that only blendshapes move: the skeleton's place is part of the constants.

    :param activations: of the targets; None: those of the input ``weights``
    """
    linear, offset = rig.parent_world[:3, :3], rig.parent_world[:3, 3]
    targets = tuple(dataclasses.replace(t, offsets=t.offsets @ linear.T) for t in rig.targets)
    world = dataclasses.replace(rig, targets=targets)
    moved = moved_lengths(world)
    parts = partition(moved, block_size([(moved, OFFSET_BYTES)], len(rig.points)), OFFSET_BYTES)
    blocks = morph_nodes(nodes, world, rig.points @ linear.T + offset, parts, batch, activations)
    _in_point_order(nodes, _reorder(nodes, blocks, parts.position), parts, batch)


def skinned(nodes: Nodes, rig: Rig, ends: Ends | None, options: Options, activations: str | None = None) -> None:
    """`points` of a face that joints or a parent move, in two orders: the morph's groups, then the skin's.

    :param activations: of the targets; None: those of the input ``weights``
    """
    batch = options.batch
    centre = (rig.points.min(axis=0) + rig.points.max(axis=0)) / 2
    moved = moved_lengths(rig)
    influences = sparse.csr_array(rig.influences[:, joint_columns(rig)])
    size = block_size([(moved, OFFSET_BYTES), (influences, WEIGHT_BYTES)], len(rig.points))
    parts = partition(influences, size, WEIGHT_BYTES)
    # [batch, 4, points] morphed points with a 1 each, in the order of the skin's groups
    order, neutral = np.concatenate([parts.members(group) for group in parts.groups]), rig.points - centre
    ones = np.ones((1, 1, len(order)))
    if rig.targets:
        morphs = partition(moved, size, OFFSET_BYTES)
        morphed = morph_nodes(nodes, rig, neutral, morphs, batch, activations)
        # morphs are blocked by which shapes move points, the skin by which joints: their orders differ
        morphed = _reorder(nodes, morphed, morphs.position[parts.order])
        turned = nodes.add("Transpose", nodes.reshape(morphed, batch, len(order), 3), perm=[0, 2, 1])
        homogeneous = nodes.concat([turned, nodes.constant("ones", np.tile(ones, (batch, 1, 1)))], 1)
    else:
        homogeneous = nodes.constant("neutral", np.concatenate([neutral[order].T[None], ones], axis=1))
    matrices = skinning_nodes(nodes, rig, ends, centre, parent=options.parent, batch=batch)
    planes = skin_nodes(nodes, rig, matrices, homogeneous, parts, batch)
    rows = nodes.add("Transpose", planes, perm=[0, 2, 1])
    blocks = nodes.reshape(rows, batch, len(parts.order), 3 * size)
    _in_point_order(nodes, _reorder(nodes, blocks, parts.position), parts, batch)


def _reorder(nodes: Nodes, blocks: str, indices: IntArray) -> str:
    if np.array_equal(indices, np.arange(len(indices))):
        return blocks
    return nodes.gather(blocks, 1, indices)


def _in_point_order(nodes: Nodes, blocks: str, parts: Partition, batch: int) -> None:
    """`points` from blocks in their own order: the filling of the last one is cut off."""
    total = len(parts.order) * parts.size
    if total == parts.points:
        nodes.reshape(blocks, batch, total, 3, name="points")
        return
    rows = nodes.reshape(blocks, batch, total, 3)
    bounds = [nodes.indices([value]) for value in (0, parts.points, 1)]
    nodes.add("Slice", rows, *bounds, name="points")


def signature(rig: Rig, options: Options) -> tuple[dict[str, tuple[int, ...]], dict[str, tuple[int, ...]]]:
    """Names and shapes of the graph's inputs and of its outputs; `rig` holds the exported shapes only."""
    joints, points = len(rig.joints), len(rig.points)
    inputs: dict[str, tuple[int, ...]] = {}
    if rig.shapes:
        inputs["weights"] = (options.batch, len(rig.shapes))
    if joints and options.inputs == "coefficients":
        inputs["coefficients"] = (options.batch, joints, 9)
    if joints and options.inputs == "matrices":
        inputs["joint_transforms"] = (options.batch, joints, 4, 4)
    if options.parent:
        inputs["parent"] = (options.batch, 4, 4)
    outputs: dict[str, tuple[int, ...]] = {"points": (options.batch, points, 3)}
    if options.joint_matrices:
        outputs["joint_matrices"] = (options.batch, joints, 4, 4)
    if options.normals:
        outputs["normals"] = (options.batch, points, 3)
    return inputs, outputs
