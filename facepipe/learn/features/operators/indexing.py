"""Operators that take parts of values, or put borders around them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from facepipe.learn.features.node import Node, Operator, positive, whole


def _gather(node: Node, x: Tensor, index: Tensor) -> Tensor:
    axis = positive(node.integer("axis"), x.ndim)
    flat = index.reshape(-1).long()
    taken = x.index_select(axis, torch.where(flat < 0, flat + x.shape[axis], flat))
    return taken.reshape([*x.shape[:axis], *index.shape, *x.shape[axis + 1 :]])


def _gather_elements(node: Node, x: Tensor, index: Tensor) -> Tensor:
    axis = positive(node.integer("axis"), x.ndim)
    return torch.gather(x, axis, torch.where(index < 0, index + x.shape[axis], index))


def _slice(
    node: Node,
    x: Tensor,
    starts: Tensor | None = None,
    ends: Tensor | None = None,
    axes: Tensor | None = None,
    steps: Tensor | None = None,
) -> Tensor:
    first, last = node.given("starts", starts) or (), node.given("ends", ends) or ()
    along = node.given("axes", axes) or tuple(range(len(first)))
    strides = whole(steps) if steps is not None else (1,) * len(first)
    for start, end, axis, step in zip(first, last, along, strides, strict=True):
        place = positive(axis, x.ndim)
        if step > 0:
            x = x[(slice(None),) * place + (slice(start, end, step),)]
        else:
            chosen = range(x.shape[place])[slice(start, end, step)]
            x = x.index_select(place, torch.tensor(list(chosen), dtype=torch.int64, device=x.device))
    return x


def _pad(
    node: Node, x: Tensor, pads: Tensor | None = None, value: Tensor | None = None, axes: Tensor | None = None
) -> Tensor:
    """Begins of all axes, then their ends; below 0 takes away."""
    amounts = node.given("pads", pads) or ()
    chosen = whole(axes) if axes is not None else range(x.ndim)
    places = [positive(axis, x.ndim) for axis in chosen]
    begins, ends = amounts[: len(places)], amounts[len(places) :]
    around = [(0, 0)] * x.ndim
    for place, begin, end in zip(places, begins, ends, strict=True):
        around[place] = (begin, end)
    node.room(*(size + sum(one) for size, one in zip(x.shape, around, strict=True)))
    mode = node.text("mode", "constant")
    if mode == "constant":
        fill = value.item() if value is not None else node.number("value")
        return functional.pad(x, [amount for one in reversed(around) for amount in one], value=fill)
    if mode not in _BORDERS:
        raise node.refuse(f"mode {mode}, expected constant, {', '.join(_BORDERS)}")
    for place, (begin, end) in enumerate(around):
        if begin or end:
            wanted = torch.arange(-begin, x.shape[place] + end, device=x.device)
            x = x.index_select(place, _BORDERS[mode](wanted, x.shape[place]))
    return x


def _reflected(index: Tensor, size: int) -> Tensor:
    period = max(2 * (size - 1), 1)
    folded = index % period
    return torch.where(folded < size, folded, period - folded)


_BORDERS: dict[str, Callable[[Tensor, int], Tensor]] = {
    "edge": lambda index, size: index.clamp(0, size - 1),
    "reflect": _reflected,
    "wrap": lambda index, size: index % size,
}

TABLE: dict[str, Operator] = {"Gather": _gather, "GatherElements": _gather_elements, "Slice": _slice, "Pad": _pad}
