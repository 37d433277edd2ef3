"""Points as nodes: blendshapes (shape weights -> activations -> points), linear blend skinning, and normals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import sparse

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.onnx_graph import Nodes
from facepipe.rig import Rig
from facepipe_onnx.joints import tree_order

Mask = npt.NDArray[np.bool_]

# Costs in bytes of stored tensors that could be read meanwhile, at 25 GB/s.
_GROUP_BYTES = 50_000  # two small nodes
_BLOCK_BYTES = 80  # one row of a Gather
_TRIM_BYTES = 250_000  # cutting the points that fill the last block up
_BLOCK_SIZES = range(1, 17)
_MAX_GROUPS = 256
_MAX_PATTERNS = 2048
OFFSET_BYTES = 12  # one offset
WEIGHT_BYTES = 4  # one skin weight
# (j, 4, 4) constants at the joints -> [batch, joints, 4, 4] world matrices times them, joints sorted by depth
Ends = Callable[[FloatArray], str]
_SMALLEST = 1e-18  # of a squared length: shorter sums stay as they are, and give (near) zero normals


class Group(NamedTuple):
    """Blocks of points and the columns that act on at least one of them, both ascending."""

    columns: IntArray  # (k,)
    blocks: IntArray  # (m,)


class Partition(NamedTuple):
    """All blocks in groups. A block is `size` consecutive points; the last one repeats the last point as filling."""

    size: int
    points: int
    groups: tuple[Group, ...]

    @property
    def order(self) -> IntArray:
        """(blocks,) block numbers in the order of the groups."""
        return np.concatenate([group.blocks for group in self.groups])

    @property
    def position(self) -> IntArray:
        """(blocks,) where each block stands in the order of the groups."""
        return np.argsort(self.order, kind="stable")

    def members(self, group: Group) -> IntArray:
        """(m * size,) point indices of a group."""
        indices = group.blocks[:, None] * self.size + np.arange(self.size)
        return np.asarray(np.minimum(indices, self.points - 1).ravel())


def block_size(matrices: Sequence[tuple[sparse.csr_array, int]], points: int) -> int:
    """The number of consecutive points that are best kept together.

    :param matrices: (points, columns) sparse matrices, each with the bytes stored for one of its entries
    """
    costs = []
    for size in _BLOCK_SIZES:
        filled = sum(cost * size * int(_block_mask(matrix, size).sum()) for matrix, cost in matrices)
        blocks = -(-points // size)
        costs.append(1.2 * filled + _BLOCK_BYTES * blocks + (_TRIM_BYTES if points % size else 0))
    return _BLOCK_SIZES[int(np.argmin(costs))]


def partition(matrix: sparse.csr_array, size: int, entry_bytes: int) -> Partition:
    """Groups of the rows of a (points, columns) sparse matrix, in blocks of `size`.

    :param entry_bytes: bytes stored for one entry of the matrix
    """
    mask = _block_mask(matrix, size)
    patterns, pattern_of, counts = _patterns(mask)
    labels = _merge(patterns, counts * size * entry_bytes)[pattern_of]
    groups = [np.flatnonzero(labels == label) for label in np.unique(labels)]
    groups.sort(key=lambda blocks: int(blocks[0]))
    return Partition(
        size, matrix.shape[0], tuple(Group(np.flatnonzero(mask[blocks].any(axis=0)), blocks) for blocks in groups)
    )


def _block_mask(matrix: sparse.csr_array, size: int) -> Mask:
    """(blocks, columns) whether any point of a block has an entry."""
    coo = matrix.tocoo()
    rows, columns = coo.coords
    mask = np.zeros((-(-matrix.shape[0] // size), matrix.shape[1]), dtype=bool)
    mask[rows[coo.data != 0] // size, columns[coo.data != 0]] = True
    return mask


def _patterns(mask: Mask) -> tuple[Mask, IntArray, IntArray]:
    """Distinct rows (p, columns), the row that each row of `mask` belongs to, and how often each occurs.

    More than `_MAX_PATTERNS` are thinned by uniting neighbours in sorted order.
    """
    packed = np.packbits(mask, axis=1)
    if not packed.shape[1]:
        return mask[:1], np.zeros(len(mask), np.int64), np.array([len(mask)])
    rows = np.ascontiguousarray(packed).view(f"V{packed.shape[1]}").ravel()
    _, first, pattern_of = np.unique(rows, return_index=True, return_inverse=True)
    patterns = mask[first]
    if len(patterns) > _MAX_PATTERNS:
        bucket = np.arange(len(patterns)) * _MAX_PATTERNS // len(patterns)
        patterns = np.maximum.reduceat(patterns, np.searchsorted(bucket, np.arange(_MAX_PATTERNS)), axis=0)
        pattern_of = bucket[pattern_of]
    return patterns, pattern_of, np.bincount(pattern_of, minlength=len(patterns))


def _merge(patterns: Mask, weight: FloatArray | IntArray) -> IntArray:
    """(p,) labels of patterns merged greedily, the pair with the least fill first.

    The bytes of a group are ``|union of its patterns| * weight``.
    """
    union, weight = patterns.astype(np.float64), weight.astype(np.float64)
    labels, alive = np.arange(len(union)), np.ones(len(union), dtype=bool)
    width = union.sum(axis=1)
    fill = np.empty((len(union), len(union)))
    for i in range(len(union)):
        fill[i] = _fill(union, width, weight, alive, i)
    nearest, least = fill.argmin(axis=1), fill.min(axis=1)
    for groups in range(len(union), 1, -1):
        keep = int(least.argmin())
        gone = int(nearest[keep])
        if least[keep] >= _GROUP_BYTES and groups <= _MAX_GROUPS:
            break
        labels[labels == gone] = keep
        union[keep] = np.maximum(union[keep], union[gone])
        width[keep], weight[keep] = union[keep].sum(), weight[keep] + weight[gone]
        alive[gone] = False
        fill[gone], fill[:, gone], least[gone] = np.inf, np.inf, np.inf
        row = _fill(union, width, weight, alive, keep)
        fill[keep], fill[:, keep] = row, row
        # only rows that the merge concerns: all pairs anew each time would be cubic in the patterns
        stale = np.flatnonzero(alive & (np.isin(nearest, (keep, gone)) | (row < least)))
        nearest[stale], least[stale] = fill[stale].argmin(axis=1), fill[stale].min(axis=1)
    return labels


def _fill(union: FloatArray, width: FloatArray, weight: FloatArray, alive: Mask, group: int) -> FloatArray:
    """(p,) zeros in bytes that merging `group` with each other group brings; infinite where there is none."""
    united = width + width[group] - union @ union[group]
    fill = united * (weight + weight[group]) - width * weight - width[group] * weight[group]
    fill[~alive] = np.inf
    fill[group] = np.inf
    return np.asarray(fill)


def moved_lengths(rig: Rig) -> sparse.csr_array:
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

    A curve is ``base + slope * w + sum(change * relu(w - at))`` (`facepipe.rig.rig.Curve.hinges`).
    """
    shapes = np.array([target.shape for target in rig.targets], dtype=np.int64)
    if all(target.curve.is_identity for target in rig.targets):
        if not np.array_equal(shapes, np.arange(len(rig.shapes))):
            return nodes.add("Gather", weights, nodes.indices(shapes), axis=1, name=name)
        return nodes.concat([weights], 1, name)
    curves = [target.curve.hinges() for target in rig.targets]
    # as a set: curves of neighbouring inbetweens bend at the same weight, and share its relu
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
    pieces = []
    for group in parts.groups:  # the few activations of each times its own small dense matrix
        points = parts.members(group)
        rest = neutral[points].reshape(1, -1)
        if not len(group.columns):
            pieces.append(nodes.constant("still_points", np.tile(rest, (batch, 1))))
            continue
        rows = (3 * points[:, None] + np.arange(3)).ravel()
        dense = rig.deltas[rows][:, group.columns].toarray().T
        own = nodes.gather(activations, 1, [*group.columns.tolist(), rig.deltas.shape[1]])
        pieces.append(nodes.add("MatMul", own, nodes.constant("shape_offsets", np.concatenate([dense, rest]))))
    blocks = sum(len(group.blocks) for group in parts.groups)
    return nodes.reshape(nodes.concat(pieces, 1), batch, blocks, 3 * parts.size)


def skinning_nodes(nodes: Nodes, rig: Rig, ends: Ends | None, centre: FloatArray, *, parent: bool, batch: int) -> str:
    """[batch, 12, joints + 1] matrices from centred skeleton space to world, entry ``3 * column + row``.

    Joints are sorted by depth, the skeleton's own matrix is last.

    :param ends: None if there are no joints
    :param centre: (3,) skeleton-space origin of the points; keeps products of float32 small
    """
    shift = np.eye(4)
    shift[:3, 3] = centre
    matrices = [] if ends is None else [ends(rig.inverse_bind @ shift)]
    if parent:
        shifted = nodes.add("MatMul", "parent", nodes.constant("centre", shift))
        matrices.append(nodes.reshape(shifted, batch, 1, 4, 4))
    else:
        own = np.tile(rig.parent_world @ shift, (batch, 1, 1, 1))
        matrices.append(nodes.constant("skeleton_world", own))
    # the last row of an affine matrix is 0 0 0 1: nothing to multiply by
    rows = nodes.slice(nodes.concat(matrices, 1), 2, 0, 3)
    count = len(rig.joints) + 1
    return nodes.reshape(nodes.add("Transpose", rows, perm=[0, 3, 2, 1]), batch, 12, count)


def skin_nodes(nodes: Nodes, rig: Rig, matrices: str, points: str, parts: Partition, batch: int) -> str:
    """[batch, 3, points] world points in the order of the partition's groups.

    :param matrices: [batch, 12, joints + 1] of `skinning_nodes`
    :param points: [batch, 4, points] homogeneous centred points in the same order, or 1 instead of batch
    """
    influences = rig.influences[:, joint_columns(rig)]
    pieces = []
    for group in parts.groups:
        own, weights = nodes.gather(matrices, 2, group.columns), influences[parts.members(group)][:, group.columns]
        pieces.append(nodes.add("MatMul", own, nodes.constant("skin_weights", weights.toarray().T)))
    blended = nodes.concat(pieces, 2)
    total = sum(len(group.blocks) for group in parts.groups) * parts.size
    blended = nodes.reshape(blended, batch, 4, 3, total)
    products = nodes.add("Mul", blended, nodes.reshape(points, -1, 4, 1, total))
    flat = nodes.reshape(products, batch, 4, 3 * total)
    summed = nodes.add("MatMul", nodes.constant("sum_of_columns", np.ones((1, 4))), flat)
    return nodes.reshape(summed, batch, 3, total)


def joint_columns(rig: Rig) -> npt.NDArray[np.integer]:
    """(joints + 1,) joints in the column order of `skinning_nodes`."""
    return np.append(tree_order(rig.parents)[0], len(rig.joints))


def normal_nodes(nodes: Nodes, points: str, count: int, triangles: IntArray, batch: int) -> str:
    """Adds [batch, points, 3] `normals` of [batch, points, 3] points; (0, 1, 0) where a point has no triangle.

    :param triangles: (t, 3) point indices
    """
    degree = np.bincount(triangles.ravel(), minlength=count)
    pieces = []
    if len(triangles):
        corners = [nodes.gather(points, 1, triangles[:, i]) for i in range(3)]
        first = nodes.add("Sub", corners[1], corners[0])
        second = nodes.add("Sub", corners[2], corners[0])
        turned = [[nodes.gather(one, 2, axes) for axes in ((1, 2, 0), (2, 0, 1))] for one in (first, second)]
        ahead, behind = nodes.add("Mul", turned[0][0], turned[1][1]), nodes.add("Mul", turned[0][1], turned[1][0])
        areas = nodes.add("Sub", ahead, behind)
        around = np.argsort(triangles.ravel(), kind="stable") // 3  # triangles, point by point
        starts = np.cumsum(degree) - degree
        sums = []
        for size in np.unique(degree[degree > 0]):  # points of one number of triangles at a time
            members = np.flatnonzero(degree == size)
            own = nodes.gather(areas, 1, around[starts[members, None] + np.arange(size)].ravel())
            grouped = nodes.reshape(own, batch, len(members), int(size), 3)
            total = nodes.add("MatMul", nodes.constant(f"sum_{size}", np.ones((1, size))), grouped)
            sums.append(nodes.reshape(total, batch, len(members), 3))
        vectors = nodes.concat(sums, 1)
        squares = nodes.add(
            "MatMul", nodes.add("Mul", vectors, vectors), nodes.constant("sum_of_axes", np.ones((3, 1)))
        )
        smallest = nodes.constant("smallest", np.array(_SMALLEST))
        pieces.append(nodes.add("Div", vectors, nodes.add("Sqrt", nodes.add("Clip", squares, smallest))))
    if not degree.all():
        up = np.tile([0.0, 1.0, 0.0], (batch, int(np.count_nonzero(degree == 0)), 1))
        pieces.append(nodes.constant("loose_normals", up))  # not scaled: some runtimes' roots of 1 are not 1
    order = np.argsort(np.where(degree == 0, len(triangles) * 3 + 1, degree), kind="stable")
    position = nodes.indices(np.argsort(order, kind="stable"))
    return nodes.add("Gather", nodes.concat(pieces, 1), position, axis=1, name="normals")
