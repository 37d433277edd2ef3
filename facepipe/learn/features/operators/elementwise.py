"""Operators that work number by number."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from facepipe.learn.features.node import Node, Operator


def _leaky_relu(node: Node, x: Tensor) -> Tensor:
    return functional.leaky_relu(x, node.number("alpha", 0.01))


def _prelu(node: Node, x: Tensor, slope: Tensor) -> Tensor:
    """`slope` broadcasts to `x`; one slope, or one a channel, goes the fast way."""
    channels = x.shape[1] if x.ndim > 1 else 1
    per_channel = slope.ndim >= x.ndim - 1 and slope.numel() == channels and slope.shape[1 - x.ndim] == channels
    if slope.numel() == 1 or (x.ndim > 1 and per_channel):
        return functional.prelu(x, slope.reshape(-1))
    return torch.where(x < 0, slope * x, x)


def _elu(node: Node, x: Tensor) -> Tensor:
    return functional.elu(x, node.number("alpha", 1.0))


def _celu(node: Node, x: Tensor) -> Tensor:
    return functional.celu(x, node.number("alpha", 1.0))


def _selu(node: Node, x: Tensor) -> Tensor:
    gamma, alpha = node.number("gamma", 1.0507009873554805), node.number("alpha", 1.6732632423543772)
    return gamma * torch.where(x > 0, x, alpha * torch.expm1(x.clamp(max=0)))


def _thresholded_relu(node: Node, x: Tensor) -> Tensor:
    return torch.where(x > node.number("alpha", 1.0), x, torch.zeros_like(x))


def _hard_sigmoid(node: Node, x: Tensor) -> Tensor:
    return (node.number("alpha", 0.2) * x + node.number("beta", 0.5)).clamp(0, 1)


def _hard_swish(node: Node, x: Tensor) -> Tensor:
    return x * (x / 6 + 0.5).clamp(0, 1)


def _gelu(node: Node, x: Tensor) -> Tensor:
    return functional.gelu(x, approximate=node.text("approximate", "none"))


def _softmax(node: Node, x: Tensor) -> Tensor:
    return _over_classes(node, x, torch.softmax)


def _log_softmax(node: Node, x: Tensor) -> Tensor:
    return _over_classes(node, x, torch.log_softmax)


def _over_classes(node: Node, x: Tensor, function: Operator) -> Tensor:
    """Before operator set 13 the classes are all axes from `axis` on."""
    axis = node.integer("axis", -1 if node.opset >= 13 else 1)
    if node.opset >= 13:
        return function(x, dim=axis)
    first = axis + x.ndim if axis < 0 else axis
    flat = x.flatten(first) if first < x.ndim else x[..., None]
    return function(flat, dim=-1).reshape(x.shape)


def _clip(node: Node, x: Tensor, low: Tensor | None = None, high: Tensor | None = None) -> Tensor:
    if node.opset < 11:
        return x.clamp(node.number("min", -torch.inf), node.number("max", torch.inf))
    if low is not None:
        x = torch.maximum(x, low.to(x.dtype))
    return x if high is None else torch.minimum(x, high.to(x.dtype))


def _div(node: Node, a: Tensor, b: Tensor) -> Tensor:
    return a / b if a.dtype.is_floating_point else torch.div(a, b, rounding_mode="trunc")


def _mod(node: Node, a: Tensor, b: Tensor) -> Tensor:
    return torch.fmod(a, b) if node.integer("fmod") else torch.remainder(a, b)


def _pow(node: Node, base: Tensor, exponent: Tensor) -> Tensor:
    return torch.pow(base, exponent).to(base.dtype)


def _sum(node: Node, *terms: Tensor) -> Tensor:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


def _mean(node: Node, *terms: Tensor) -> Tensor:
    return _sum(node, *terms) / len(terms)


def _max(node: Node, *terms: Tensor) -> Tensor:
    most = terms[0]
    for term in terms[1:]:
        most = torch.maximum(most, term)
    return most


def _min(node: Node, *terms: Tensor) -> Tensor:
    least = terms[0]
    for term in terms[1:]:
        least = torch.minimum(least, term)
    return least


def _where(node: Node, condition: Tensor, x: Tensor, y: Tensor) -> Tensor:
    return torch.where(condition, x, y)


def _identity(node: Node, x: Tensor) -> Tensor:
    return x


def _dropout(node: Node, x: Tensor, *options: Tensor | None) -> tuple[Tensor, Tensor]:
    """Of a network that is not being trained: nothing is dropped."""
    return x, torch.ones_like(x, dtype=torch.bool)


_TYPES = {
    1: torch.float32,
    2: torch.uint8,
    3: torch.int8,
    5: torch.int16,
    6: torch.int32,
    7: torch.int64,
    9: torch.bool,
    10: torch.float16,
    11: torch.float64,
}  # of onnx.TensorProto


def _cast(node: Node, x: Tensor) -> Tensor:
    kind = node.integer("to")
    if kind not in _TYPES:
        raise node.refuse(f"to type {kind}, expected floats, integers or booleans")
    return x.to(_TYPES[kind])


def _cast_like(node: Node, x: Tensor, other: Tensor) -> Tensor:
    return x.to(other.dtype)


def _unary(function: Operator) -> Operator:
    """An operator without attributes from torch's function of the same meaning."""

    def operator(node: Node, x: Tensor) -> Tensor:
        return function(x)

    return operator


def _binary(function: Operator) -> Operator:
    def operator(node: Node, a: Tensor, b: Tensor) -> Tensor:
        return function(a, b)

    return operator


TABLE: dict[str, Operator] = {
    **{
        name: _unary(function)
        for name, function in {
            "Abs": torch.abs,
            "Neg": torch.neg,
            "Exp": torch.exp,
            "Log": torch.log,
            "Sqrt": torch.sqrt,
            "Reciprocal": torch.reciprocal,
            "Floor": torch.floor,
            "Ceil": torch.ceil,
            "Round": torch.round,
            "Sign": torch.sign,
            "Sin": torch.sin,
            "Cos": torch.cos,
            "Tan": torch.tan,
            "Tanh": torch.tanh,
            "Atan": torch.atan,
            "Erf": torch.erf,
            "Sigmoid": torch.sigmoid,
            "Relu": torch.relu,
            "Softplus": functional.softplus,
            "Softsign": functional.softsign,
            "Mish": functional.mish,
            "Not": torch.logical_not,
        }.items()
    },
    **{
        name: _binary(function)
        for name, function in {
            "Add": torch.add,
            "Sub": torch.sub,
            "Mul": torch.mul,
            "Equal": torch.eq,
            "Less": torch.lt,
            "Greater": torch.gt,
            "LessOrEqual": torch.le,
            "GreaterOrEqual": torch.ge,
            "And": torch.logical_and,
            "Or": torch.logical_or,
            "Xor": torch.logical_xor,
        }.items()
    },
    "LeakyRelu": _leaky_relu,
    "PRelu": _prelu,
    "Elu": _elu,
    "Celu": _celu,
    "Selu": _selu,
    "Clip": _clip,
    "ThresholdedRelu": _thresholded_relu,
    "HardSigmoid": _hard_sigmoid,
    "HardSwish": _hard_swish,
    "Gelu": _gelu,
    "Softmax": _softmax,
    "LogSoftmax": _log_softmax,
    "Div": _div,
    "Mod": _mod,
    "Pow": _pow,
    "Where": _where,
    "Sum": _sum,
    "Mean": _mean,
    "Max": _max,
    "Min": _min,
    "Identity": _identity,
    "Dropout": _dropout,
    "Cast": _cast,
    "CastLike": _cast_like,
}
