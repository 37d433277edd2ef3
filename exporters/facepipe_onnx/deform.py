"""A face as nodes: joints (bone coefficients or local transforms -> world matrices, DESIGN section 7), blendshapes
(shape weights -> activations -> points), linear blend skinning, and normals.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import sparse

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.onnx_graph import Nodes
from facepipe.rig import Rig

Mask = npt.NDArray[np.bool_]
# (j, 4, 4) constants at the joints -> [batch, joints, 4, 4] world matrices times them, joints sorted by depth
Ends = Callable[[FloatArray], str]

_ORDER = (2, 0, 1)  # axes of Rz Rx Ry
_SMALLEST = 1e-18  # of a squared length: shorter sums stay as they are, and give (near) zero normals

# Costs in bytes of stored tensors that could be read meanwhile, at 25 GB/s.
_GROUP_BYTES = 50_000  # two small nodes
_BLOCK_BYTES = 80  # one row of a Gather
_TRIM_BYTES = 250_000  # cutting the points that fill the last block up
_BLOCK_SIZES = range(1, 17)
_MAX_GROUPS = 256
_MAX_PATTERNS = 2048
OFFSET_BYTES = 12  # one offset
WEIGHT_BYTES = 4  # one skin weight


def _local_nodes(nodes: Nodes, coefficients: str, rest: FloatArray, batch: int) -> str:
    """[batch, j, 4, 4] ``rest T(t) Rz(rz) Rx(rx) Ry(ry) S(s)`` of [batch, j, 9] coefficients.

    Each entry of the 4x4 is a sum of products of one sine, cosine or 1 for each axis, and a scale: all products of all
    joints are made at once, column by column.

    :param rest: (j, 4, 4) constants
    """
    count = len(rest)
    rows = nodes.reshape(coefficients, batch * count, 9)
    angles = nodes.slice(rows, 1, 3, 6)
    waves = nodes.concat([nodes.add("Sin", angles), nodes.add("Cos", angles)], 1)
    # the products i k m j that are not zero: R[i, j] sums Rz[i, k] Rx[k, m] Ry[m, j]
    turns = []
    for axis in _ORDER:  # a rotation about it is ``[sin x y z, cos x y z] @ linear + fixed``
        after, last = (axis + 1) % 3, (axis + 2) % 3
        linear, fixed = np.zeros((6, 3, 3)), np.zeros((3, 3))
        linear[axis, after, last], linear[axis, last, after] = -1.0, 1.0
        linear[3 + axis, after, after] = linear[3 + axis, last, last] = 1.0
        fixed[axis, axis] = 1.0
        turns.append((linear, fixed))
    first, second, third = (np.abs(linear).sum(axis=0) + fixed != 0 for linear, fixed in turns)
    indices = itertools.product(range(3), repeat=4)
    products = [(i, k, m, j) for i, k, m, j in indices if first[i, k] and second[k, m] and third[m, j]]
    # (9, p + 3): the scale in every product, then the translations, out of the coefficients
    columns = [6 + j for *_, j in products] + [0, 1, 2]
    scale, entries = np.eye(9)[:, columns], np.eye(16)[[4 * i + j for i, *_, j in products] + [3, 7, 11]]
    product = nodes.add("MatMul", rows, nodes.constant("scales", scale))
    for place, (axis, (turn, still)) in enumerate(zip(_ORDER, turns, strict=True)):
        # the factor of one axis in every product, and a 1 for each translation
        i, j = np.array([product[place : place + 2] for product in products]).T
        linear, fixed = np.hstack([turn[:, i, j], np.zeros((6, 3))]), np.append(still[i, j], np.ones(3))
        factor = nodes.add("Gemm", waves, nodes.constant(f"turns_{axis}", linear), nodes.constant("fixed_turns", fixed))
        product = nodes.add("Mul", product, factor)
    # the 1 at the end of a matrix depends on nothing: it is the bias of the product
    corner = nodes.constant("corner", np.eye(16)[15])
    matrices = nodes.add("Gemm", product, nodes.constant("entries", entries), corner)
    return nodes.add("MatMul", nodes.constant("rest", rest), nodes.reshape(matrices, batch, count, 4, 4))


def tree_order(parents: IntArray) -> tuple[IntArray, IntArray]:
    """Joint numbers sorted by depth, and the first position (levels + 1,) of every depth."""
    depth = np.zeros(len(parents), dtype=np.int64)
    for joint, parent in enumerate(parents):
        depth[joint] = 0 if parent < 0 else depth[parent] + 1
    order = np.argsort(depth, kind="stable")
    return order, np.searchsorted(depth[order], np.arange(depth.max(initial=-1) + 2))


def world_nodes(nodes: Nodes, rig: Rig, *, matrices: bool, parent: bool, batch: int) -> str:
    """[batch, joints, 4, 4] world matrices, joints sorted by depth (`tree_order`).

    :param matrices: local transforms are the input, not bone coefficients
    :param parent: the matrix that roots hang under is an input
    """
    order, starts = tree_order(rig.parents)
    source = nodes.gather("joint_transforms" if matrices else "coefficients", 1, order)
    local = source if matrices else _local_nodes(nodes, source, rig.rest[order], batch)
    root = nodes.reshape("parent", batch, 1, 4, 4) if parent else nodes.constant("parent_world", rig.parent_world)
    above = np.argsort(order, kind="stable")[rig.parents[order]]
    return _level_nodes(nodes, local, above, starts, root)


def _level_nodes(nodes: Nodes, local: str, above: IntArray, starts: IntArray, root: str | None) -> str:
    """[batch, rows, 4, 4] products down a tree whose rows are sorted by depth: one MatMul a level.

    :param local: [batch, rows, 4, 4]
    :param above: (rows,) the row above, in the level before; not read on level 0
    :param starts: (levels + 1,) first row of each level, and their count
    :param root: what level 0 hangs under, None for nothing
    """
    levels: list[str] = []
    for depth, (start, end) in enumerate(itertools.pairwise(starts)):
        level = nodes.slice(local, 1, int(start), int(end))
        if depth > 0:
            level = nodes.add("MatMul", nodes.gather(levels[-1], 1, above[start:end] - starts[depth - 1]), level)
        elif root is not None:
            level = nodes.add("MatMul", root, level)
        levels.append(level)
    return nodes.concat(levels, 1)


class Chains(NamedTuple):
    """Rows: the joints that move, sorted by depth among themselves; last on level 0 one that stays at rest."""

    joints: IntArray  # (n,) joint of each row, -1 for the one at rest
    rows: IntArray  # (j,) row with the coefficients of each joint
    above: IntArray  # (n,) row that each row hangs under, of the level before
    levels: IntArray  # (levels + 1,) first row of each level, and their count
    rest: FloatArray  # (n, 4, 4) from the row above, or from what roots hang under, to each row at rest
    anchors: IntArray  # (j,) row that carries each joint: its own, the nearest above, or the one at rest
    ends: FloatArray  # (j, 4, 4) from that row to the joint


def chains_of(rig: Rig, moving: npt.NDArray[np.bool_], root: FloatArray) -> Chains:
    """The chains of a rig.

    :param moving: (j,) which joints move
    :param root: (4, 4) what roots hang under
    """
    count = len(rig.joints)
    anchor, above = np.full(count, -1), np.full(count, -1)
    ends, starts = np.zeros((count, 4, 4)), np.zeros((count, 4, 4))
    for joint, parent in enumerate(rig.parents):
        before, path = (-1, root) if parent < 0 else (anchor[parent], ends[parent])
        reached = path @ rig.rest[joint]
        # a joint that no slider moves is no product at run time: its rest is part of the next constant below
        if moving[joint]:
            above[joint], starts[joint], anchor[joint], ends[joint] = before, reached, joint, np.eye(4)
        else:
            anchor[joint], ends[joint] = before, reached
    movers = np.flatnonzero(moving)
    place = np.searchsorted(movers, above[movers])
    order, levels = tree_order(np.where(above[movers] < 0, -1, place))
    still = int(levels[1]) if len(levels) > 1 else 0
    joints = np.insert(movers[order], still, -1)
    levels = np.concatenate([[0], levels[1:] + 1]) if len(movers) else np.array([0, 1])
    row = np.full(count + 1, still)  # the last entry stands for joint -1
    row[joints] = np.arange(len(joints))
    row[-1] = still
    at_rest = np.where((joints < 0)[:, None, None], np.eye(4), starts[joints])
    hanging = row[np.where(joints < 0, -1, above[joints])]
    return Chains(joints, row[:count], hanging, levels, at_rest, row[anchor], ends)


def chain_nodes(nodes: Nodes, chains: Chains, coefficients: str, *, parent: bool, batch: int) -> str:
    """[batch, n, 4, 4] world matrices of the rows of `chains`, from their [batch, n, 9] coefficients.

    :param parent: the matrix that roots hang under is an input
    """
    local = _local_nodes(nodes, coefficients, chains.rest, batch)
    root = nodes.reshape("parent", batch, 1, 4, 4) if parent else None
    return _level_nodes(nodes, local, chains.above, chains.levels, root)


def end_nodes(
    nodes: Nodes, chains: Chains, worlds: str, ends: FloatArray, order: IntArray, name: str | None = None
) -> str:
    """[batch, joints, 4, 4] ``world @ ends`` of the joints in `order`.

    :param worlds: of `chain_nodes`
    :param ends: (j, 4, 4) constants at the joints, such as inverse bind transforms
    """
    carried = worlds
    if not np.array_equal(chains.anchors[order], np.arange(len(chains.joints))):
        carried = nodes.gather(worlds, 1, chains.anchors[order])
    constants = nodes.constant("chain_ends", (chains.ends @ ends)[order])
    return nodes.add("MatMul", carried, constants, name=name)


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
    costs, entries = [], [(*_entries(matrix), matrix.shape[1], cost) for matrix, cost in matrices]
    for size in _BLOCK_SIZES:
        filled = 0
        for rows, columns, width, cost in entries:
            mask = np.zeros(-(-points // size) * width, dtype=bool)
            mask[rows // size * width + columns] = True
            filled += cost * size * int(np.count_nonzero(mask))
        blocks = -(-points // size)
        costs.append(1.2 * filled + _BLOCK_BYTES * blocks + (_TRIM_BYTES if points % size else 0))
    return _BLOCK_SIZES[int(np.argmin(costs))]


def partition(matrix: sparse.csr_array, size: int, entry_bytes: int) -> Partition:
    """Groups of the rows of a (points, columns) sparse matrix, in blocks of `size`.

    :param entry_bytes: bytes stored for one entry of the matrix
    """
    mask = _block_mask(matrix, size)
    # distinct rows (p, columns), the one that each row of the mask belongs to, and how often each occurs
    packed = np.packbits(mask, axis=1)
    patterns, pattern_of = mask[:1], np.zeros(len(mask), np.int64)
    if packed.shape[1]:
        rows = np.ascontiguousarray(packed).view(f"V{packed.shape[1]}").ravel()
        _, first, pattern_of = np.unique(rows, return_index=True, return_inverse=True)
        patterns = mask[first]
        if len(patterns) > _MAX_PATTERNS:  # thinned by uniting neighbours in sorted order
            bucket = np.arange(len(patterns)) * _MAX_PATTERNS // len(patterns)
            patterns = np.maximum.reduceat(patterns, np.searchsorted(bucket, np.arange(_MAX_PATTERNS)), axis=0)
            pattern_of = bucket[pattern_of]
    counts = np.bincount(pattern_of, minlength=len(patterns))
    labels = _merge(patterns, counts * size * entry_bytes)[pattern_of]
    groups = [np.flatnonzero(labels == label) for label in np.unique(labels)]
    groups.sort(key=lambda blocks: int(blocks[0]))
    return Partition(
        size, matrix.shape[0], tuple(Group(np.flatnonzero(mask[blocks].any(axis=0)), blocks) for blocks in groups)
    )


def _block_mask(matrix: sparse.csr_array, size: int) -> Mask:
    """(blocks, columns) whether any point of a block has an entry."""
    rows, columns = _entries(matrix)
    mask = np.zeros((-(-matrix.shape[0] // size), matrix.shape[1]), dtype=bool)
    mask[rows // size, columns] = True
    return mask


def _entries(matrix: sparse.csr_array) -> tuple[IntArray, IntArray]:
    """Rows and columns of the entries that are not 0."""
    coo = matrix.tocoo()
    rows, columns = coo.coords
    there = np.flatnonzero(coo.data != 0)
    return rows.take(there), columns.take(there)


def _merge(patterns: Mask, weight: FloatArray | IntArray) -> IntArray:
    """(p,) labels of patterns merged greedily, the pair with the least fill first.

    The bytes of a group are ``|union of its patterns| * weight``.
    """
    # whole numbers, which float32 holds exactly: a pattern has few thousand columns
    union, weight = patterns.astype(np.float32), weight.astype(np.float64)
    labels, alive = np.arange(len(union)), np.ones(len(union), dtype=bool)
    width = union.sum(axis=1, dtype=np.float64)
    united = width + width[:, None] - union @ union.T
    fill = united * (weight + weight[:, None]) - width * weight - (width * weight)[:, None]
    np.fill_diagonal(fill, np.inf)
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
        # (p,) zeros in bytes that merging it with each other group brings; infinite where there is none
        united = width + width[keep] - union @ union[keep]
        row = united * (weight + weight[keep]) - width * weight - width[keep] * weight[keep]
        row[~alive] = np.inf
        row[keep] = np.inf
        fill[keep], fill[:, keep] = row, row
        # only rows that the merge concerns: all pairs anew each time would be cubic in the patterns
        stale = np.flatnonzero(alive & ((nearest == keep) | (nearest == gone) | (row < least)))
        rows = fill.take(stale, axis=0)
        nearest[stale] = rows.argmin(axis=1)
        least[stale] = rows[np.arange(len(stale)), nearest[stale]]
    return labels


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
