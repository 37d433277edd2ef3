"""Operators that give values another shape or order, take parts of them or put them together."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from facepipe.photo.features.node import Node, Operator, whole


def _reshape(node: Node, x: Tensor, shape: Tensor) -> Tensor:
    """0 keeps an axis, -1 takes what is left."""
    sizes = whole(shape)
    if not node.get("allowzero", 0):
        sizes = tuple(x.shape[axis] if size == 0 else size for axis, size in enumerate(sizes))
    return x.reshape(sizes)


def _flatten(node: Node, x: Tensor) -> Tensor:
    axis = node.get("axis", 1)
    return x.reshape(math.prod(x.shape[:axis]), math.prod(x.shape[axis:]))


def _squeeze(node: Node, x: Tensor, axes: Tensor | None = None) -> Tensor:
    chosen = node.given("axes", axes)
    if chosen is None:
        return x.squeeze()
    if any(x.shape[axis] != 1 for axis in chosen):
        raise ValueError(f"axes {chosen} of shape {tuple(x.shape)}, expected size 1")
    return x.squeeze(chosen)


def _unsqueeze(node: Node, x: Tensor, axes: Tensor | None = None) -> Tensor:
    chosen = node.given("axes", axes) or ()
    for axis in sorted(range(x.ndim + len(chosen))[axis] for axis in chosen):
        x = x.unsqueeze(axis)
    return x


def _split(node: Node, x: Tensor, sizes: Tensor | None = None) -> tuple[Tensor, ...]:
    """Parts of those sizes, or one of the same size for each output, the last one smaller."""
    axis, chosen = node.get("axis", 0), node.given("split", sizes)
    parts = torch.split(x, list(chosen) if chosen else math.ceil(x.shape[axis] / len(node.outputs)), dim=axis)
    if len(parts) != len(node.outputs):
        raise node.refuse(f"{len(parts)} parts, expected {len(node.outputs)}")
    return tuple(parts)


def _expand(node: Node, x: Tensor, shape: Tensor) -> Tensor:
    sizes = torch.broadcast_shapes(tuple(x.shape), whole(shape))
    node.room(*sizes)
    return x.expand(sizes)


def _shape(node: Node, x: Tensor) -> Tensor:
    return torch.tensor(x.shape[node.get("start", 0) : node.get("end", None)], dtype=torch.int64, device=x.device)


def _constant_of_shape(node: Node, shape: Tensor) -> Tensor:
    sizes = whole(shape)
    node.room(*sizes)
    value = torch.as_tensor(node.get("value", torch.zeros(1)))
    return value.to(shape.device).reshape(()).expand(sizes).clone()


def _gather(node: Node, x: Tensor, index: Tensor) -> Tensor:
    axis = range(x.ndim)[node.get("axis", 0)]
    flat = index.reshape(-1).long()
    taken = x.index_select(axis, torch.where(flat < 0, flat + x.shape[axis], flat))
    return taken.reshape([*x.shape[:axis], *index.shape, *x.shape[axis + 1 :]])


def _slice(node: Node, x: Tensor, *parts: Tensor | None) -> Tensor:
    """By starts, ends, axes and steps: inputs, but attributes before operator set 10."""
    named = zip(("starts", "ends", "axes", "steps"), parts, strict=False)
    bounds = {**node.attributes, **{name: whole(part) for name, part in named if part is not None}}
    starts = bounds["starts"]
    axes, steps = bounds.get("axes", range(len(starts))), bounds.get("steps", [1] * len(starts))
    for start, end, axis, step in zip(starts, bounds["ends"], axes, steps, strict=True):
        place = range(x.ndim)[axis]
        if step > 0:
            x = x[(slice(None),) * place + (slice(start, end, step),)]
        else:
            chosen = range(x.shape[place])[slice(start, end, step)]
            x = x.index_select(place, torch.tensor(list(chosen), dtype=torch.int64, device=x.device))
    return x


def _pad(node: Node, x: Tensor, pads: Tensor | None = None, value: Tensor | None = None) -> Tensor:
    """Begins of all axes, then their ends; below 0 takes away."""
    amounts = node.given("pads", pads) or ()
    around = list(zip(amounts[: x.ndim], amounts[x.ndim :], strict=True))
    node.room(*(size + sum(one) for size, one in zip(x.shape, around, strict=True)))
    node.choice("mode", "constant", ("constant",))
    fill = node.get("value", 0.0) if value is None else value.item()
    return functional.pad(x, [amount for one in reversed(around) for amount in one], value=fill)


TABLE: dict[str, Operator] = {
    "Reshape": _reshape,
    "Flatten": _flatten,
    "Transpose": lambda node, x: x.permute(tuple(node.get("perm", range(x.ndim - 1, -1, -1)))),
    "Squeeze": _squeeze,
    "Unsqueeze": _unsqueeze,
    "Concat": lambda node, *parts: torch.cat(parts, dim=node.get("axis", 0)),
    "Split": _split,
    "Expand": _expand,
    "Shape": _shape,
    "ConstantOfShape": _constant_of_shape,
    "Gather": _gather,
    "Slice": _slice,
    "Pad": _pad,
}
