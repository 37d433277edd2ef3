"""Operators that give values another shape or order, or put them together."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from facepipe.learn.features.node import Node, Operator, positive, whole


def _reshape(node: Node, x: Tensor, shape: Tensor) -> Tensor:
    """0 keeps an axis, -1 takes what is left."""
    sizes = whole(shape)
    if not node.integer("allowzero"):
        sizes = tuple(x.shape[axis] if size == 0 else size for axis, size in enumerate(sizes))
    return x.reshape(sizes)


def _flatten(node: Node, x: Tensor) -> Tensor:
    axis = node.integer("axis", 1)
    axis = axis + x.ndim if axis < 0 else axis
    return x.reshape(math.prod(x.shape[:axis]), math.prod(x.shape[axis:]))


def _transpose(node: Node, x: Tensor) -> Tensor:
    return x.permute(node.integers("perm", range(x.ndim - 1, -1, -1)))


def _squeeze(node: Node, x: Tensor, axes: Tensor | None = None) -> Tensor:
    chosen = node.given("axes", axes)
    if chosen is None:
        return x.squeeze()
    gone = {positive(axis, x.ndim) for axis in chosen}
    if any(x.shape[axis] != 1 for axis in gone):
        raise ValueError(f"axes {sorted(gone)} of shape {tuple(x.shape)}, expected size 1")
    return x.reshape([size for axis, size in enumerate(x.shape) if axis not in gone])


def _unsqueeze(node: Node, x: Tensor, axes: Tensor | None = None) -> Tensor:
    chosen = node.given("axes", axes) or ()
    for axis in sorted(positive(axis, x.ndim + len(chosen)) for axis in chosen):
        x = x.unsqueeze(axis)
    return x


def _concat(node: Node, *parts: Tensor) -> Tensor:
    return torch.cat(parts, dim=node.integer("axis"))


def _split(node: Node, x: Tensor, sizes: Tensor | None = None) -> tuple[Tensor, ...]:
    axis = positive(node.integer("axis"), x.ndim)
    chosen = node.given("split", sizes)
    if chosen is None:
        count = node.integer("num_outputs", len(node.outputs))
        each = math.ceil(x.shape[axis] / count)
        chosen = (*[each] * (count - 1), x.shape[axis] - each * (count - 1))
    return tuple(torch.split(x, list(chosen), dim=axis))


def _expand(node: Node, x: Tensor, shape: Tensor) -> Tensor:
    sizes = torch.broadcast_shapes(tuple(x.shape), whole(shape))
    node.room(*sizes)
    return x.expand(sizes)


def _tile(node: Node, x: Tensor, repeats: Tensor) -> Tensor:
    counts = whole(repeats)
    node.room(*(size * count for size, count in zip(x.shape, counts, strict=True)))
    return x.repeat(counts)


def _depth_to_space(node: Node, x: Tensor) -> Tensor:
    block, (batch, channels, height, width) = node.integer("blocksize"), x.shape
    left = channels // block**2
    if node.text("mode", "DCR") == "DCR":
        parts = x.reshape(batch, block, block, left, height, width).permute(0, 3, 4, 1, 5, 2)
    else:
        parts = x.reshape(batch, left, block, block, height, width).permute(0, 1, 4, 2, 5, 3)
    return parts.reshape(batch, left, height * block, width * block)


def _space_to_depth(node: Node, x: Tensor) -> Tensor:
    block, (batch, channels, height, width) = node.integer("blocksize"), x.shape
    parts = x.reshape(batch, channels, height // block, block, width // block, block).permute(0, 3, 5, 1, 2, 4)
    return parts.reshape(batch, channels * block**2, height // block, width // block)


def _shape(node: Node, x: Tensor) -> Tensor:
    end = node.attributes.get("end")
    return torch.tensor(x.shape[node.integer("start") : end], dtype=torch.int64, device=x.device)


def _size(node: Node, x: Tensor) -> Tensor:
    return torch.tensor(x.numel(), dtype=torch.int64, device=x.device)


def _constant_of_shape(node: Node, shape: Tensor) -> Tensor:
    sizes = whole(shape)
    node.room(*sizes)
    value = torch.as_tensor(node.attributes.get("value", torch.zeros(1)))
    return value.to(shape.device).reshape(()).expand(sizes).clone()


def _range(node: Node, start: Tensor, limit: Tensor, delta: Tensor) -> Tensor:
    first, last, step = (one.item() for one in (start, limit, delta))
    node.room(math.ceil((last - first) / step))
    return torch.arange(first, last, step, dtype=start.dtype, device=start.device)


TABLE: dict[str, Operator] = {
    "Reshape": _reshape,
    "Flatten": _flatten,
    "Transpose": _transpose,
    "Squeeze": _squeeze,
    "Unsqueeze": _unsqueeze,
    "Concat": _concat,
    "Split": _split,
    "Expand": _expand,
    "Tile": _tile,
    "DepthToSpace": _depth_to_space,
    "SpaceToDepth": _space_to_depth,
    "Shape": _shape,
    "Size": _size,
    "ConstantOfShape": _constant_of_shape,
    "Range": _range,
}
