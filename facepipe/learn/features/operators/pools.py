"""Pooling, local and global."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from facepipe.learn.features.node import Node, Operator
from facepipe.learn.features.operators.windows import Windows, padded, windows

_MAXIMA = {1: functional.max_pool1d, 2: functional.max_pool2d, 3: functional.max_pool3d}
_MEANS = {1: functional.avg_pool1d, 2: functional.avg_pool2d, 3: functional.avg_pool3d}
_CONVOLUTIONS = {1: functional.conv1d, 2: functional.conv2d, 3: functional.conv3d}


def _max_pool(node: Node, x: Tensor) -> Tensor:
    """Padding never wins."""
    window = windows(node, x, node.integers("kernel_shape"))
    x = padded(padded(x, window.around, -torch.inf), window.beyond, -torch.inf)
    return _MAXIMA[x.ndim - 2](x, window.size, window.stride, 0, window.dilation)


def _average_pool(node: Node, x: Tensor) -> Tensor:
    """Padding counts where ``count_include_pad`` says so; what hangs over in ceil_mode never does."""
    window = windows(node, x, node.integers("kernel_shape"))
    total = _sums(padded(padded(x, window.around), window.beyond), window)
    ones = torch.ones_like(x[:1, :1])
    counted = padded(ones, window.around, 1.0 if node.integer("count_include_pad") else 0.0)
    return total / _sums(padded(counted, window.beyond), window)


def _sums(x: Tensor, window: Windows) -> Tensor:
    """The sum of each window; with gaps in it, as a convolution of every channel by itself with ones."""
    if set(window.dilation) == {1}:
        return _MEANS[x.ndim - 2](x, window.size, window.stride) * math.prod(window.size)
    flat = x.reshape(-1, 1, *x.shape[2:])
    ones = x.new_ones(1, 1, *window.size)
    sums = _CONVOLUTIONS[x.ndim - 2](flat, ones, None, window.stride, 0, window.dilation)
    return sums.reshape(*x.shape[:2], *sums.shape[2:])


def _global_average(node: Node, x: Tensor) -> Tensor:
    return x.mean(tuple(range(2, x.ndim)), keepdim=True)


def _global_max(node: Node, x: Tensor) -> Tensor:
    return x.amax(tuple(range(2, x.ndim)), keepdim=True)


def _global_lp(node: Node, x: Tensor) -> Tensor:
    flat = x.reshape(*x.shape[:2], math.prod(x.shape[2:]))
    norm = torch.linalg.vector_norm(flat, ord=node.integer("p", 2), dim=-1)
    return norm.reshape(*x.shape[:2], *[1] * (x.ndim - 2))


TABLE: dict[str, Operator] = {
    "MaxPool": _max_pool,
    "AveragePool": _average_pool,
    "GlobalAveragePool": _global_average,
    "GlobalMaxPool": _global_max,
    "GlobalLpPool": _global_lp,
}
