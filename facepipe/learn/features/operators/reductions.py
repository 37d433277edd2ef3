"""Operators that sum up axes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from facepipe.learn.features.node import Node, Operator, positive

Reduce = Callable[[Tensor, tuple[int, ...], bool], Tensor]


def _reduction(reduce: Reduce) -> Operator:
    def operator(node: Node, x: Tensor, axes: Tensor | None = None) -> Tensor:
        chosen = node.given("axes", axes)
        if not chosen:
            if node.integer("noop_with_empty_axes"):
                return x
            chosen = tuple(range(x.ndim))
        return reduce(x, tuple(positive(axis, x.ndim) for axis in chosen), bool(node.integer("keepdims", 1)))

    return operator


def _product(x: Tensor, axes: tuple[int, ...], keep: bool) -> Tensor:
    for axis in sorted(axes, reverse=True):
        x = x.prod(axis, keepdim=keep)
    return x


def _root_of_squares(x: Tensor, axes: tuple[int, ...], keep: bool) -> Tensor:
    return torch.linalg.vector_norm(x, dim=axes, keepdim=keep)


def _lp_normalization(node: Node, x: Tensor) -> Tensor:
    """Zero stays zero."""
    order = node.integer("p", 2)
    norm = torch.linalg.vector_norm(x, ord=order, dim=node.integer("axis", -1), keepdim=True)
    return x / torch.where(norm == 0, torch.ones_like(norm), norm)


def _extreme_place(node: Node, x: Tensor, function: Callable[..., Tensor]) -> Tensor:
    axis, keep = positive(node.integer("axis"), x.ndim), bool(node.integer("keepdims", 1))
    if node.integer("select_last_index"):
        return x.shape[axis] - 1 - function(x.flip(axis), dim=axis, keepdim=keep)
    return function(x, dim=axis, keepdim=keep)


def _arg_max(node: Node, x: Tensor) -> Tensor:
    return _extreme_place(node, x, torch.argmax)


def _arg_min(node: Node, x: Tensor) -> Tensor:
    return _extreme_place(node, x, torch.argmin)


TABLE: dict[str, Operator] = {
    "ReduceMean": _reduction(lambda x, axes, keep: x.mean(axes, keepdim=keep)),
    "ReduceSum": _reduction(lambda x, axes, keep: x.sum(axes, keepdim=keep)),
    "ReduceMax": _reduction(lambda x, axes, keep: x.amax(axes, keepdim=keep)),
    "ReduceMin": _reduction(lambda x, axes, keep: x.amin(axes, keepdim=keep)),
    "ReduceProd": _reduction(_product),
    "ReduceL1": _reduction(lambda x, axes, keep: x.abs().sum(axes, keepdim=keep)),
    "ReduceL2": _reduction(_root_of_squares),
    "ReduceSumSquare": _reduction(lambda x, axes, keep: (x * x).sum(axes, keepdim=keep)),
    "ReduceLogSum": _reduction(lambda x, axes, keep: x.sum(axes, keepdim=keep).log()),
    "ReduceLogSumExp": _reduction(lambda x, axes, keep: x.logsumexp(axes, keepdim=keep)),
    "LpNormalization": _lp_normalization,
    "ArgMax": _arg_max,
    "ArgMin": _arg_min,
}
