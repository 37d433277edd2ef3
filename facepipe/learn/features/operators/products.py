"""Convolutions and matrix products."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from facepipe.learn.features.node import Node, Operator, along
from facepipe.learn.features.operators.windows import padded, windows

_CONVOLUTIONS = {1: functional.conv1d, 2: functional.conv2d, 3: functional.conv3d}
_TRANSPOSED = {1: functional.conv_transpose1d, 2: functional.conv_transpose2d, 3: functional.conv_transpose3d}


def _conv(node: Node, x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    window = windows(node, x, weight.shape[2:])
    same = window.begin == window.end
    x = x if same else padded(x, window.around)
    padding = window.begin if same else 0
    convolve = _CONVOLUTIONS[x.ndim - 2]
    return convolve(x, weight, bias, window.stride, padding, window.dilation, node.integer("group", 1))


def _conv_transpose(node: Node, x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """The whole result without padding, then cut, or prolonged, to the one that is asked for."""
    count = weight.ndim - 2
    if x.ndim != weight.ndim or not 1 <= count <= 3:
        raise node.refuse(f"a value of shape {tuple(x.shape)}, expected (b, c) and {count} axes of 1 to 3")
    stride, dilation = node.integers("strides", [1] * count), node.integers("dilations", [1] * count)
    whole = _TRANSPOSED[count](x, weight, None, stride, 0, 0, node.integer("group", 1), dilation)
    pads = _transposed_padding(node, x.shape[2:], whole.shape[2:], stride)
    cut = padded(whole, [amount for pair in reversed(pads) for amount in pair])
    return cut if bias is None else cut + along(bias, 1, cut)


def _transposed_padding(
    node: Node, lengths: torch.Size, whole: torch.Size, stride: tuple[int, ...]
) -> list[tuple[int, int]]:
    """Cells to add before and behind each axis, below 0 to cut away."""
    count, mode = len(lengths), node.text("auto_pad", "NOTSET")
    further = node.integers("output_padding", [0] * count)
    wanted = node.integers("output_shape")[-count:]
    if mode in ("SAME_UPPER", "SAME_LOWER") and not wanted:
        wanted = tuple(length * step for length, step in zip(lengths, stride, strict=True))
    if not wanted:
        pads = node.integers("pads", [0] * (2 * count)) if mode == "NOTSET" else (0,) * (2 * count)
        return [(-pads[axis], further[axis] - pads[count + axis]) for axis in range(count)]
    found = []
    for axis in range(count):
        surplus = whole[axis] + further[axis] - wanted[axis]
        begin = max(surplus, 0) // 2 if mode == "SAME_UPPER" else max(surplus, 0) - max(surplus, 0) // 2
        found.append((-begin, wanted[axis] - whole[axis] + begin))
    return found


def _gemm(node: Node, a: Tensor, b: Tensor, c: Tensor | None = None) -> Tensor:
    left = a.mT if node.integer("transA") else a
    right = b.mT if node.integer("transB") else b
    alpha, beta = node.number("alpha", 1.0), node.number("beta", 1.0)
    product = left @ right if alpha == 1 else alpha * (left @ right)
    return product if c is None or beta == 0 else product + (c if beta == 1 else beta * c)


def _matmul(node: Node, a: Tensor, b: Tensor) -> Tensor:
    return a @ b


def _einsum(node: Node, *parts: Tensor) -> Tensor:
    return torch.einsum(node.text("equation"), *parts)


TABLE: dict[str, Operator] = {
    "Conv": _conv,
    "ConvTranspose": _conv_transpose,
    "Gemm": _gemm,
    "MatMul": _matmul,
    "Einsum": _einsum,
}
