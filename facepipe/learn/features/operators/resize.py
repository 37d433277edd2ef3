"""Resize and Upsample: every axis that changes is a matrix (new, old) of weights.

Source: the ONNX operator specification, Resize 10 to 19; of its modes, those that exporters write.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from facepipe.learn.features.node import Node, Operator, whole

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
    for axis, (size, factor) in enumerate(zip(new, factors, strict=True)):
        if size != x.shape[axis] or factor != 1:
            node.room(size, x.shape[axis])
            place = torch.arange(size, dtype=torch.float64, device=x.device)
            where = coordinates(place, x.shape[axis], size, factor)
            x = (x.movedim(axis, -1) @ _weights(node, x, axis, where).T).movedim(-1, axis)
    return x


def _weights(node: Node, x: Tensor, axis: int, where: Tensor) -> Tensor:
    """(new, old) weights of the old cells around places `where` (new,), in cells."""
    where = where.clamp(0, x.shape[axis] - 1)  # the border cells stand for those outside
    if node.choice("mode", "nearest", ("nearest", "linear")) == "nearest":
        usual = "floor" if node.opset <= 10 else "round_prefer_floor"
        where = _ROUNDINGS[node.choice("nearest_mode", usual, _ROUNDINGS)](where)
    distance = (where[:, None] - torch.arange(x.shape[axis], device=x.device)).abs()
    return (1 - distance).clamp(min=0).to(x.dtype)


TABLE: dict[str, Operator] = {"Resize": _resize, "Upsample": _resize}
