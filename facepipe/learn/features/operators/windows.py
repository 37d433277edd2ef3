"""Where the windows of convolutions and pooling lie, as the attributes of ONNX tell it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor
from torch.nn import functional

from facepipe.learn.features.node import Node


@dataclass(frozen=True, kw_only=True)
class Windows:
    """Windows over the last axes of a value, one number an axis."""

    size: tuple[int, ...]
    stride: tuple[int, ...]
    dilation: tuple[int, ...]
    begin: tuple[int, ...]  # cells of padding before the first
    end: tuple[int, ...]  # cells of padding behind the last
    overhang: tuple[int, ...]  # further cells behind, which make the last window of ceil_mode whole

    @property
    def around(self) -> list[int]:
        """The padding as `torch.nn.functional.pad` takes it."""
        return _pairs(self.begin, self.end)

    @property
    def beyond(self) -> list[int]:
        """The overhang as `torch.nn.functional.pad` takes it."""
        return _pairs([0] * len(self.overhang), self.overhang)


def windows(node: Node, x: Tensor, size: Sequence[int]) -> Windows:
    """Those of a node over a value (b, c, ...), for windows of `size` cells."""
    count = len(size)
    if x.ndim != count + 2 or not 1 <= count <= 3:
        raise node.refuse(f"a value of shape {tuple(x.shape)}, expected (b, c) and {count} axes of 1 to 3")
    stride, dilation = node.integers("strides", [1] * count), node.integers("dilations", [1] * count)
    reach = [step * (cells - 1) + 1 for step, cells in zip(dilation, size, strict=True)]
    begin, end = _padding(node, x.shape[2:], stride, reach)
    overhang = [0] * count
    if node.integer("ceil_mode"):
        lengths = zip(x.shape[2:], begin, end, reach, stride, strict=True)
        overhang = [_overhang(*length) for length in lengths]
    return Windows(size=tuple(size), stride=stride, dilation=dilation, begin=begin, end=end, overhang=tuple(overhang))


def padded(x: Tensor, pads: list[int], value: float = 0.0) -> Tensor:
    """`x` with cells around it, itself where there are none."""
    return functional.pad(x, pads, value=value) if any(pads) else x


def _padding(
    node: Node, lengths: Sequence[int], stride: Sequence[int], reach: Sequence[int]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    mode, count = node.text("auto_pad", "NOTSET"), len(reach)
    if mode in ("NOTSET", "VALID"):
        pads = node.integers("pads", [0] * (2 * count)) if mode == "NOTSET" else (0,) * (2 * count)
        return pads[:count], pads[count:]
    if mode not in ("SAME_UPPER", "SAME_LOWER"):
        raise node.refuse(f"auto_pad {mode}, expected NOTSET, VALID, SAME_UPPER or SAME_LOWER")
    total = [
        max((math.ceil(length / step) - 1) * step + cells - length, 0)
        for length, step, cells in zip(lengths, stride, reach, strict=True)
    ]
    less, more = tuple(one // 2 for one in total), tuple(one - one // 2 for one in total)
    return (less, more) if mode == "SAME_UPPER" else (more, less)


def _overhang(length: int, begin: int, end: int, reach: int, stride: int) -> int:
    """A last window counts only where it starts inside the value or the padding before it."""
    span = length + begin + end - reach
    steps = math.ceil(span / stride)
    if steps * stride >= length + begin:
        steps -= 1
    return max(steps * stride - span, 0)


def _pairs(begin: Sequence[int], end: Sequence[int]) -> list[int]:
    return [amount for pair in zip(reversed(begin), reversed(end), strict=True) for amount in pair]
