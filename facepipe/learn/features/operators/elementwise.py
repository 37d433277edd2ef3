"""Operators that work number by number, softmax and sums."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from facepipe.learn.features.node import Node, Operator

_TYPES = {1: torch.float32, 6: torch.int32, 7: torch.int64, 9: torch.bool, 11: torch.float64}  # of onnx.TensorProto


def _prelu(node: Node, x: Tensor, slope: Tensor) -> Tensor:
    """`slope` broadcasts to `x`; one slope, or one a channel, goes the fast way."""
    channels = x.shape[1] if x.ndim > 1 else 1
    per_channel = slope.ndim >= x.ndim - 1 and slope.numel() == channels and slope.shape[1 - x.ndim] == channels
    if slope.numel() == 1 or (x.ndim > 1 and per_channel):
        return functional.prelu(x, slope.reshape(-1))
    return torch.where(x < 0, slope * x, x)


def _softmax(node: Node, x: Tensor) -> Tensor:
    """Before operator set 13 the classes are all axes from `axis` on."""
    if node.opset >= 13:
        return torch.softmax(x, dim=node.get("axis", -1))
    axis = node.get("axis", 1)
    first = axis + x.ndim if axis < 0 else axis
    flat = x.flatten(first) if first < x.ndim else x[..., None]
    return torch.softmax(flat, dim=-1).reshape(x.shape)


def _clip(node: Node, x: Tensor, low: Tensor | None = None, high: Tensor | None = None) -> Tensor:
    if node.opset < 11:
        return x.clamp(node.get("min", -torch.inf), node.get("max", torch.inf))
    if low is not None:
        x = torch.maximum(x, low.to(x.dtype))
    return x if high is None else torch.minimum(x, high.to(x.dtype))


def _cast(node: Node, x: Tensor) -> Tensor:
    kind = node.get("to", 0)
    if kind not in _TYPES:
        raise node.refuse(f"to type {kind}, expected floats, integers or booleans")
    return x.to(_TYPES[kind])


def _reduction(reduce: Operator) -> Operator:
    def operator(node: Node, x: Tensor, axes: Tensor | None = None) -> Tensor:
        chosen = node.given("axes", axes)
        if not chosen:
            if node.get("noop_with_empty_axes", 0):
                return x
            chosen = tuple(range(x.ndim))
        return reduce(x, chosen, bool(node.get("keepdims", 1)))

    return operator


TABLE: dict[str, Operator] = {
    "Add": lambda node, a, b: a + b,
    "Sub": lambda node, a, b: a - b,
    "Mul": lambda node, a, b: a * b,
    "Div": lambda node, a, b: a / b if a.dtype.is_floating_point else torch.div(a, b, rounding_mode="trunc"),
    "Pow": lambda node, base, exponent: torch.pow(base, exponent).to(base.dtype),
    "Sqrt": lambda node, x: torch.sqrt(x),
    "Clip": _clip,
    "Relu": lambda node, x: torch.relu(x),
    "LeakyRelu": lambda node, x: functional.leaky_relu(x, node.get("alpha", 0.01)),
    "PRelu": _prelu,
    "Sigmoid": lambda node, x: torch.sigmoid(x),
    "HardSigmoid": lambda node, x: (node.get("alpha", 0.2) * x + node.get("beta", 0.5)).clamp(0, 1),
    "HardSwish": lambda node, x: x * (x / 6 + 0.5).clamp(0, 1),
    "Tanh": lambda node, x: torch.tanh(x),
    "Softmax": _softmax,
    "Cast": _cast,
    "Identity": lambda node, x: x,
    "Dropout": lambda node, x, *options: x,  # the network is not being trained
    "ReduceMean": _reduction(lambda x, axes, keep: x.mean(axes, keepdim=keep)),
    "ReduceSum": _reduction(lambda x, axes, keep: x.sum(axes, keepdim=keep)),
    "ReduceL2": _reduction(lambda x, axes, keep: torch.linalg.vector_norm(x, dim=axes, keepdim=keep)),
}
