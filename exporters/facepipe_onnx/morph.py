"""Blendshapes as nodes: shape weights -> activations -> points."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from facepipe.core.arrays import FloatArray
from facepipe.onnx_graph import Nodes
from facepipe.rig import Rig
from facepipe_onnx.partition import Group, Partition

ENTRY_BYTES = 12  # one offset


def moved(rig: Rig) -> sparse.csr_array:
    """(points, targets) length of the float32 offset by which a target moves a point."""
    shape = (len(rig.points), len(rig.targets))
    if not rig.targets:
        return sparse.csr_array(shape)
    with np.errstate(over="ignore"):  # refused when they are stored
        lengths = [np.abs(t.offsets.astype(np.float32)).max(axis=1, initial=0.0) for t in rig.targets]
    columns = [np.full(len(t.point_indices), i) for i, t in enumerate(rig.targets)]
    entries = (np.concatenate([t.point_indices for t in rig.targets]), np.concatenate(columns))
    matrix = sparse.csr_array((np.concatenate(lengths), entries), shape=shape)
    matrix.eliminate_zeros()
    return matrix


def activation_nodes(nodes: Nodes, rig: Rig, weights: str = "weights", name: str | None = None) -> str:
    """[batch, targets] activations of the targets under [batch, shapes] `weights`.

    A curve is ``base + slope * w + sum(change * relu(w - at))`` (`facepipe.rig.activation.Curve.hinges`).
    """
    shapes = np.array([target.shape for target in rig.targets], dtype=np.int64)
    if all(target.curve.is_identity for target in rig.targets):
        if not np.array_equal(shapes, np.arange(len(rig.shapes))):
            return nodes.add("Gather", weights, nodes.indices(shapes), axis=1, name=name)
        return nodes.concat([weights], 1, name)
    curves = [target.curve.hinges() for target in rig.targets]
    bends = sorted(
        {(target.shape, at) for target, curve in zip(rig.targets, curves, strict=True) for at, _ in curve[2]}
    )
    mix = np.zeros((len(rig.shapes) + len(bends), len(rig.targets)))
    for i, (target, (_, slope, changes)) in enumerate(zip(rig.targets, curves, strict=True)):
        mix[target.shape, i] = slope
        for at, change in changes:
            mix[len(rig.shapes) + bends.index((target.shape, at)), i] = change
    features = weights
    if bends:
        starts = nodes.constant("bend_weights", np.array([[at for _, at in bends]]))
        past = nodes.add("Relu", nodes.add("Sub", nodes.gather(weights, 1, [shape for shape, _ in bends]), starts))
        features = nodes.concat([weights, past], 1)
    base = nodes.constant("curve_base", np.array([curve[0] for curve in curves]))
    return nodes.add("Gemm", features, nodes.constant("curve_mix", mix), base, name=name)


def morph_nodes(
    nodes: Nodes, rig: Rig, neutral: FloatArray, parts: Partition, batch: int, activations: str | None = None
) -> str:
    """[batch, blocks, 3 * block size] morphed points in the order of the partition's groups.

    :param neutral: (n, 3) points in the space of the targets' offsets
    :param activations: of `activation_nodes`; None: those of the input ``weights``
    """
    # the 1 multiplies the neutral points
    one = nodes.constant("one", np.ones((batch, 1)))
    activations = nodes.concat([activations or activation_nodes(nodes, rig), one], 1)
    pieces = [_group(nodes, activations, rig.deltas, neutral, parts, group, batch) for group in parts.groups]
    blocks = sum(len(group.blocks) for group in parts.groups)
    return nodes.reshape(nodes.concat(pieces, 1), batch, blocks, 3 * parts.size)


def _group(
    nodes: Nodes,
    activations: str,
    deltas: sparse.csr_array,
    neutral: FloatArray,
    parts: Partition,
    group: Group,
    batch: int,
) -> str:
    """[batch, 3 * points] of one group: its few activations times its own small dense matrix."""
    points = parts.members(group)
    rest = neutral[points].reshape(1, -1)
    if not len(group.columns):
        return nodes.constant("still_points", np.tile(rest, (batch, 1)))
    rows = (3 * points[:, None] + np.arange(3)).ravel()
    dense = deltas[rows][:, group.columns].toarray().T
    own = nodes.gather(activations, 1, [*group.columns.tolist(), deltas.shape[1]])
    return nodes.add("MatMul", own, nodes.constant("shape_offsets", np.concatenate([dense, rest])))
