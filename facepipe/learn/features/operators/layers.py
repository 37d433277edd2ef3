"""Layers of networks on pictures: convolutions, pooling, normalisation and matrix products."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from facepipe.learn.features.node import Node, Operator

_Ints = Sequence[int]


def _conv(node: Node, x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    x, stride, padding, dilation = _windows(node, x, weight.shape[2:])
    return functional.conv2d(x, weight, bias, stride, padding, dilation, node.get("group", 1))


def _max_pool(node: Node, x: Tensor) -> Tensor:
    """Padding never wins."""
    size = node.get("kernel_shape", ())
    x, stride, padding, dilation = _windows(node, x, size, -torch.inf)
    return functional.max_pool2d(x, size, stride, padding, dilation, bool(node.get("ceil_mode", 0)))


def _average_pool(node: Node, x: Tensor) -> Tensor:
    """Padding counts where ``count_include_pad`` says so; what hangs over in ceil_mode never does."""
    size, include = node.get("kernel_shape", ()), bool(node.get("count_include_pad", 0))
    whole, stride, padding, dilation = _windows(node, x, size)
    if set(dilation) != {1}:
        raise node.refuse(f"dilations {dilation}, expected 1")
    mean = functional.avg_pool2d(whole, size, stride, padding, bool(node.get("ceil_mode", 0)), include)
    if whole is x or include:
        return mean
    inside = _windows(node, torch.ones_like(x[:1, :1]), size)[0]
    return mean / functional.avg_pool2d(inside, size, stride)


def _windows(node: Node, x: Tensor, size: _Ints, fill: float = 0.0) -> tuple[Tensor, _Ints, _Ints, _Ints]:
    """The value (b, c, h, w) with stride, padding and dilation, as torch takes them, of windows of `size` over it.

    Torch pads both ends alike, by at most half a window: other padding is put around the value, as cells of `fill`.
    """
    if x.ndim != 4 or len(size) != 2:
        raise node.refuse(f"a value of shape {tuple(x.shape)}, windows {tuple(size)}, expected (b, c, h, w) and (h, w)")
    stride, dilation = node.get("strides", (1, 1)), node.get("dilations", (1, 1))
    reach = [gap * (cells - 1) + 1 for gap, cells in zip(dilation, size, strict=True)]
    begin, end = _padding(node, x, stride, reach)
    if begin == end and all(2 * pad <= cells for pad, cells in zip(begin, reach, strict=True)):
        return x, stride, begin, dilation
    if node.get("ceil_mode", 0):
        raise node.refuse(f"ceil_mode with pads {(*begin, *end)}, expected both ends alike, half a window at most")
    return functional.pad(x, [begin[1], end[1], begin[0], end[0]], value=fill), stride, (0, 0), dilation


def _padding(node: Node, x: Tensor, stride: _Ints, reach: _Ints) -> tuple[_Ints, _Ints]:
    """Cells before and behind each axis."""
    mode = node.choice("auto_pad", "NOTSET", ("NOTSET", "VALID", "SAME_UPPER"))
    if mode != "SAME_UPPER":
        pads = node.get("pads", (0,) * 4) if mode == "NOTSET" else (0,) * 4
        return pads[:2], pads[2:]
    total = [
        max((math.ceil(length / step) - 1) * step + cells - length, 0)
        for length, step, cells in zip(x.shape[2:], stride, reach, strict=True)
    ]
    return [one // 2 for one in total], [one - one // 2 for one in total]


def _batch(node: Node, x: Tensor, scale: Tensor, shift: Tensor, mean: Tensor, variance: Tensor) -> Tensor:
    if node.get("training_mode", 0) or not node.get("spatial", 1):
        raise node.refuse("training_mode 1 or spatial 0, expected a trained network with statistics by channel")
    return functional.batch_norm(x, mean, variance, scale, shift, eps=node.get("epsilon", 1e-5))


def _gemm(node: Node, a: Tensor, b: Tensor, c: Tensor | None = None) -> Tensor:
    left = a.mT if node.get("transA", 0) else a
    right = b.mT if node.get("transB", 0) else b
    alpha, beta = node.get("alpha", 1.0), node.get("beta", 1.0)
    product = left @ right if alpha == 1 else alpha * (left @ right)
    return product if c is None or beta == 0 else product + (c if beta == 1 else beta * c)


TABLE: dict[str, Operator] = {
    "Conv": _conv,
    "MaxPool": _max_pool,
    "AveragePool": _average_pool,
    "GlobalAveragePool": lambda node, x: x.mean(tuple(range(2, x.ndim)), keepdim=True),
    "BatchNormalization": _batch,
    "InstanceNormalization": lambda node, x, scale, shift: functional.instance_norm(
        x, weight=scale, bias=shift, eps=node.get("epsilon", 1e-5)
    ),
    "Gemm": _gemm,
    "MatMul": lambda node, a, b: a @ b,
}
