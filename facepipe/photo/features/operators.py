"""What each ONNX operator does to tensors of torch, one small function an operator.

They are those that exports of face recognition (ArcFace, MobileFaceNet), face parsing (BiSeNet) and heads of
attributes or landmarks use. Source: the ONNX operator specification (onnx.ai/onnx/operators); tests compare each with
onnxruntime.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from facepipe.core.errors import InputError

# (node, *inputs) -> a tensor or a tuple of them; an input that was left out is None
Operator = Callable[..., Any]

_MOST_ELEMENTS = 1 << 26  # of one value that a shape in the file asks for
_TYPES = {1: torch.float32, 6: torch.int32, 7: torch.int64, 9: torch.bool, 11: torch.float64}  # of onnx.TensorProto


OPERATORS: dict[str, Operator] = {}  # by name; filled in this file


def _operator(*names: str) -> Callable[[Operator], Operator]:
    """A function as what the operators of some names do."""

    def kept(function: Operator) -> Operator:
        OPERATORS.update(dict.fromkeys(names, function))
        return function

    return kept


@dataclass(frozen=True, kw_only=True)
class Node:
    """What an operator gets besides its inputs."""

    name: str
    op_type: str
    opset: int
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any] = field(default_factory=dict)  # numbers, texts, lists and arrays

    def get(self, name: str, default: Any) -> Any:
        """An attribute, or its default."""
        return self.attributes.get(name, default)

    def choice(self, name: str, default: str, known: Collection[str]) -> str:
        """A text that is one of those known.

        :raises InputError: another one
        """
        value = str(self.get(name, default))
        if value not in known:
            raise self.refuse(f"{name} {value}, expected {', '.join(known)}")
        return value

    def given(self, name: str, value: Tensor | None) -> tuple[int, ...] | None:
        """Whole numbers that newer operator sets give as an input and older ones as an attribute; None: neither."""
        if value is not None:
            return whole(value)
        return tuple(self.attributes[name]) if name in self.attributes else None

    def refuse(self, what: str) -> InputError:
        """The error that this node has `what`."""
        return InputError(f"node {self.name or ', '.join(self.outputs)!r}", f"operator {self.op_type}: {what}")

    def room(self, *shape: int) -> None:
        """Refuse a shape that no feature has, before memory is taken for it."""
        count = math.prod(max(int(size), 0) for size in shape)
        if count > _MOST_ELEMENTS:
            raise self.refuse(f"a value of {count} numbers, expected at most {_MOST_ELEMENTS}")


def whole(value: Tensor) -> tuple[int, ...]:
    """The whole numbers in a tensor of any shape."""
    return tuple(int(one) for one in value.reshape(-1).tolist())


# values that get another shape or order, or are taken in parts


@_operator("Reshape")
def _reshape(node: Node, x: Tensor, shape: Tensor) -> Tensor:
    """0 keeps an axis, -1 takes what is left."""
    sizes = whole(shape)
    if not node.get("allowzero", 0):
        sizes = tuple(x.shape[axis] if size == 0 else size for axis, size in enumerate(sizes))
    return x.reshape(sizes)


@_operator("Flatten")
def _flatten(node: Node, x: Tensor) -> Tensor:
    axis = node.get("axis", 1)
    return x.reshape(math.prod(x.shape[:axis]), math.prod(x.shape[axis:]))


@_operator("Squeeze")
def _squeeze(node: Node, x: Tensor, axes: Tensor | None = None) -> Tensor:
    chosen = node.given("axes", axes)
    if chosen is None:
        return x.squeeze()
    if any(x.shape[axis] != 1 for axis in chosen):
        raise ValueError(f"axes {chosen} of shape {tuple(x.shape)}, expected size 1")
    return x.squeeze(chosen)


@_operator("Unsqueeze")
def _unsqueeze(node: Node, x: Tensor, axes: Tensor | None = None) -> Tensor:
    chosen = node.given("axes", axes) or ()
    for axis in sorted(range(x.ndim + len(chosen))[axis] for axis in chosen):
        x = x.unsqueeze(axis)
    return x


@_operator("Split")
def _split(node: Node, x: Tensor, sizes: Tensor | None = None) -> tuple[Tensor, ...]:
    """Parts of those sizes, or one of the same size for each output, the last one smaller."""
    axis, chosen = node.get("axis", 0), node.given("split", sizes)
    parts = torch.split(x, list(chosen) if chosen else math.ceil(x.shape[axis] / len(node.outputs)), dim=axis)
    if len(parts) != len(node.outputs):
        raise node.refuse(f"{len(parts)} parts, expected {len(node.outputs)}")
    return tuple(parts)


@_operator("Expand")
def _expand(node: Node, x: Tensor, shape: Tensor) -> Tensor:
    sizes = torch.broadcast_shapes(tuple(x.shape), whole(shape))
    node.room(*sizes)
    return x.expand(sizes)


@_operator("Shape")
def _shape(node: Node, x: Tensor) -> Tensor:
    return torch.tensor(x.shape[node.get("start", 0) : node.get("end", None)], dtype=torch.int64, device=x.device)


@_operator("ConstantOfShape")
def _constant_of_shape(node: Node, shape: Tensor) -> Tensor:
    sizes = whole(shape)
    node.room(*sizes)
    value = torch.as_tensor(node.get("value", torch.zeros(1)))
    return value.to(shape.device).reshape(()).expand(sizes).clone()


@_operator("Gather")
def _gather(node: Node, x: Tensor, index: Tensor) -> Tensor:
    axis = range(x.ndim)[node.get("axis", 0)]
    flat = index.reshape(-1).long()
    taken = x.index_select(axis, torch.where(flat < 0, flat + x.shape[axis], flat))
    return taken.reshape([*x.shape[:axis], *index.shape, *x.shape[axis + 1 :]])


@_operator("Slice")
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


@_operator("Pad")
def _pad(node: Node, x: Tensor, pads: Tensor | None = None, value: Tensor | None = None) -> Tensor:
    """Begins of all axes, then their ends; below 0 takes away."""
    amounts = node.given("pads", pads) or ()
    around = list(zip(amounts[: x.ndim], amounts[x.ndim :], strict=True))
    node.room(*(size + sum(one) for size, one in zip(x.shape, around, strict=True)))
    node.choice("mode", "constant", ("constant",))
    fill = node.get("value", 0.0) if value is None else value.item()
    return functional.pad(x, [amount for one in reversed(around) for amount in one], value=fill)


# each value for itself, the layers of networks, and resizing of images


@_operator("PRelu")
def _prelu(node: Node, x: Tensor, slope: Tensor) -> Tensor:
    """`slope` broadcasts to `x`; one slope, or one a channel, goes the fast way."""
    channels = x.shape[1] if x.ndim > 1 else 1
    per_channel = slope.ndim >= x.ndim - 1 and slope.numel() == channels and slope.shape[1 - x.ndim] == channels
    if slope.numel() == 1 or (x.ndim > 1 and per_channel):
        return functional.prelu(x, slope.reshape(-1))
    return torch.where(x < 0, slope * x, x)


@_operator("Softmax")
def _softmax(node: Node, x: Tensor) -> Tensor:
    """Before operator set 13 the classes are all axes from `axis` on."""
    if node.opset >= 13:
        return torch.softmax(x, dim=node.get("axis", -1))
    axis = node.get("axis", 1)
    first = axis + x.ndim if axis < 0 else axis
    flat = x.flatten(first) if first < x.ndim else x[..., None]
    return torch.softmax(flat, dim=-1).reshape(x.shape)


@_operator("Clip")
def _clip(node: Node, x: Tensor, low: Tensor | None = None, high: Tensor | None = None) -> Tensor:
    if node.opset < 11:
        return x.clamp(node.get("min", -torch.inf), node.get("max", torch.inf))
    if low is not None:
        x = torch.maximum(x, low.to(x.dtype))
    return x if high is None else torch.minimum(x, high.to(x.dtype))


@_operator("Cast")
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


_PLAIN = {"antialias": 0, "axes": [], "exclude_outside": 0, "keep_aspect_ratio_policy": "stretch"}

_COORDINATES: dict[str, Callable[[Tensor, int, int, float], Tensor]] = {
    "half_pixel": lambda place, old, new, scale: (place + 0.5) / scale - 0.5,
    "pytorch_half_pixel": lambda place, old, new, scale: (place + 0.5) / scale - 0.5 if new > 1 else place,
    "align_corners": lambda place, old, new, scale: place * (old - 1) / max(new - 1, 1),
    "asymmetric": lambda place, old, new, scale: place / scale,
}

_ROUNDINGS: dict[str, Callable[[Tensor], Tensor]] = {
    "round_prefer_floor": lambda where: torch.ceil(where - 0.5),
    "floor": torch.floor,
}


@_operator("Resize", "Upsample")
def _resize(node: Node, x: Tensor, *inputs: Tensor | None) -> Tensor:
    """Until operator set 10 there are scales alone, and old cells are by their begin, the nearest floored."""
    early = node.opset <= 10
    scales, sizes = (*inputs, None, None)[:2] if early else (*inputs[1:], None, None)[:2]
    for name, plain in _PLAIN.items():
        if node.get(name, plain) != plain:
            raise node.refuse(f"{name} {node.get(name, plain)}, expected {plain or 'none'}")
    usual = "asymmetric" if early else "half_pixel"
    coordinates = _COORDINATES[node.choice("coordinate_transformation_mode", usual, _COORDINATES)]
    factors = node.get("scales", []) if scales is None else scales.tolist()
    if sizes is not None and sizes.numel():
        new = whole(sizes)
        factors = [size / length for size, length in zip(new, x.shape, strict=True)]
    elif factors:
        new = tuple(math.floor(size * factor) for size, factor in zip(x.shape, factors, strict=True))
    else:
        raise node.refuse("neither scales nor sizes, expected one")
    node.room(*new)
    # axis by axis: the weights of linear interpolation are products of those of each axis
    for axis, (size, factor) in enumerate(zip(new, factors, strict=True)):
        if size != x.shape[axis] or factor != 1:
            node.room(size, x.shape[axis])
            place = torch.arange(size, dtype=torch.float64, device=x.device)
            # places in old cells, of which those at the border stand for those outside
            where = coordinates(place, x.shape[axis], size, factor).clamp(0, x.shape[axis] - 1)
            if node.choice("mode", "nearest", ("nearest", "linear")) == "nearest":
                rounding = node.choice("nearest_mode", "floor" if early else "round_prefer_floor", _ROUNDINGS)
                where = _ROUNDINGS[rounding](where)
            distance = (where[:, None] - torch.arange(x.shape[axis], device=x.device)).abs()
            weights = (1 - distance).clamp(min=0).to(x.dtype)
            x = (x.movedim(axis, -1) @ weights.T).movedim(-1, axis)
    return x


_Ints = Sequence[int]


@_operator("Conv")
def _conv(node: Node, x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    x, stride, padding, dilation = _windows(node, x, weight.shape[2:])
    return functional.conv2d(x, weight, bias, stride, padding, dilation, node.get("group", 1))


@_operator("MaxPool")
def _max_pool(node: Node, x: Tensor) -> Tensor:
    """Padding never wins."""
    size = node.get("kernel_shape", ())
    x, stride, padding, dilation = _windows(node, x, size, -torch.inf)
    return functional.max_pool2d(x, size, stride, padding, dilation, bool(node.get("ceil_mode", 0)))


@_operator("AveragePool")
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
    # cells before and behind each axis
    mode = node.choice("auto_pad", "NOTSET", ("NOTSET", "VALID", "SAME_UPPER"))
    if mode == "SAME_UPPER":
        sides = zip(x.shape[2:], stride, reach, strict=True)
        total = [max((math.ceil(length / step) - 1) * step + cells - length, 0) for length, step, cells in sides]
        begin: _Ints = [one // 2 for one in total]
        end: _Ints = [one - one // 2 for one in total]
    else:
        pads = node.get("pads", (0,) * 4) if mode == "NOTSET" else (0,) * 4
        begin, end = pads[:2], pads[2:]
    if begin == end and all(2 * pad <= cells for pad, cells in zip(begin, reach, strict=True)):
        return x, stride, begin, dilation
    if node.get("ceil_mode", 0):
        raise node.refuse(f"ceil_mode with pads {(*begin, *end)}, expected both ends alike, half a window at most")
    return functional.pad(x, [begin[1], end[1], begin[0], end[0]], value=fill), stride, (0, 0), dilation


@_operator("BatchNormalization")
def _batch(node: Node, x: Tensor, scale: Tensor, shift: Tensor, mean: Tensor, variance: Tensor) -> Tensor:
    if node.get("training_mode", 0) or not node.get("spatial", 1):
        raise node.refuse("training_mode 1 or spatial 0, expected a trained network with statistics by channel")
    return functional.batch_norm(x, mean, variance, scale, shift, eps=node.get("epsilon", 1e-5))


@_operator("Gemm")
def _gemm(node: Node, a: Tensor, b: Tensor, c: Tensor | None = None) -> Tensor:
    left = a.mT if node.get("transA", 0) else a
    right = b.mT if node.get("transB", 0) else b
    alpha, beta = node.get("alpha", 1.0), node.get("beta", 1.0)
    product = left @ right if alpha == 1 else alpha * (left @ right)
    return product if c is None or beta == 0 else product + (c if beta == 1 else beta * c)


OPERATORS.update(
    {
        "Transpose": lambda node, x: x.permute(tuple(node.get("perm", range(x.ndim - 1, -1, -1)))),
        "Concat": lambda node, *parts: torch.cat(parts, dim=node.get("axis", 0)),
        "Add": lambda node, a, b: a + b,
        "Sub": lambda node, a, b: a - b,
        "Mul": lambda node, a, b: a * b,
        "Div": lambda node, a, b: a / b if a.dtype.is_floating_point else torch.div(a, b, rounding_mode="trunc"),
        "Pow": lambda node, base, exponent: torch.pow(base, exponent).to(base.dtype),
        "Sqrt": lambda node, x: torch.sqrt(x),
        "Relu": lambda node, x: torch.relu(x),
        "LeakyRelu": lambda node, x: functional.leaky_relu(x, node.get("alpha", 0.01)),
        "Sigmoid": lambda node, x: torch.sigmoid(x),
        "HardSigmoid": lambda node, x: (node.get("alpha", 0.2) * x + node.get("beta", 0.5)).clamp(0, 1),
        "HardSwish": lambda node, x: x * (x / 6 + 0.5).clamp(0, 1),
        "Tanh": lambda node, x: torch.tanh(x),
        "Identity": lambda node, x: x,
        "Dropout": lambda node, x, *options: x,  # the network is not being trained
        "ReduceMean": _reduction(lambda x, axes, keep: x.mean(axes, keepdim=keep)),
        "ReduceSum": _reduction(lambda x, axes, keep: x.sum(axes, keepdim=keep)),
        "ReduceL2": _reduction(lambda x, axes, keep: torch.linalg.vector_norm(x, dim=axes, keepdim=keep)),
        "GlobalAveragePool": lambda node, x: x.mean(tuple(range(2, x.ndim)), keepdim=True),
        "InstanceNormalization": lambda node, x, scale, shift: functional.instance_norm(
            x, weight=scale, bias=shift, eps=node.get("epsilon", 1e-5)
        ),
        "MatMul": lambda node, a, b: a @ b,
    }
)
