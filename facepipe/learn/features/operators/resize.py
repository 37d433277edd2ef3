"""Resize and Upsample: every axis that changes is a matrix (new, old) of weights.

Modes, coordinates and roundings are those of the ONNX operator specification, Resize 10 to 19.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facepipe.learn.features.node import Node, Operator, positive, whole

FloatArray = npt.NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class _Axis:
    """One axis that changes."""

    place: int
    old: int
    new: int
    scale: float


def _upsample(node: Node, x: Tensor, scales: Tensor | None = None) -> Tensor:
    """Deprecated since operator set 10: old cells by their begin, nearest ones floored."""
    factors = node.attributes.get("scales", ()) if scales is None else scales.tolist()
    axes = [
        _Axis(place=place, old=size, new=math.floor(size * factor), scale=float(factor))
        for place, (size, factor) in enumerate(zip(x.shape, factors, strict=True))
    ]
    return _resized(node, x, axes, "asymmetric", "floor")


def _resize(
    node: Node,
    x: Tensor,
    roi: Tensor | None = None,
    scales: Tensor | None = None,
    sizes: Tensor | None = None,
) -> Tensor:
    if node.opset == 10:
        return _upsample(node, x, roi)  # its only input besides: scales
    coordinates = node.text("coordinate_transformation_mode", "half_pixel")
    if coordinates not in _COORDINATES:
        raise node.refuse(f"coordinates {coordinates}, expected {', '.join(_COORDINATES)}")
    places = [positive(axis, x.ndim) for axis in node.integers("axes", range(x.ndim))]
    lengths = [x.shape[place] for place in places]
    if sizes is not None and sizes.numel():
        new, factors = _of_sizes(node, lengths, whole(sizes))
    elif scales is not None and scales.numel():
        factors = [float(one) for one in scales.tolist()]
        new = [math.floor(size * factor) for size, factor in zip(lengths, factors, strict=True)]
    else:
        raise node.refuse("neither scales nor sizes, expected one")
    axes = [
        _Axis(place=place, old=x.shape[place], new=size, scale=factor)
        for place, size, factor in zip(places, new, factors, strict=True)
    ]
    return _resized(node, x, axes, coordinates, node.text("nearest_mode", "round_prefer_floor"))


def _of_sizes(node: Node, lengths: Sequence[int], sizes: Sequence[int]) -> tuple[list[int], list[float]]:
    factors = [size / length for size, length in zip(sizes, lengths, strict=True)]
    policy = node.text("keep_aspect_ratio_policy", "stretch")
    if policy == "stretch":
        return list(sizes), factors
    factor = min(factors) if policy == "not_larger" else max(factors)
    return [math.floor(length * factor + 0.5) for length in lengths], [factor] * len(lengths)


def _resized(node: Node, x: Tensor, axes: Sequence[_Axis], coordinates: str, rounding: str) -> Tensor:
    size = list(x.shape)
    for axis in axes:
        size[axis.place] = axis.new
    node.room(*size)
    for axis in axes:
        if axis.new == axis.old and axis.scale == 1:
            continue
        node.room(axis.new, axis.old)
        weights = torch.as_tensor(_weights(node, axis, coordinates, rounding), dtype=x.dtype, device=x.device)
        x = (x.movedim(axis.place, -1) @ weights.T).movedim(-1, axis.place)
    return x


def _weights(node: Node, axis: _Axis, coordinates: str, rounding: str) -> FloatArray:
    """(new, old) weights of the old cells in each new one."""
    where = _COORDINATES[coordinates](np.arange(axis.new, dtype=np.float64), axis)
    mode = node.text("mode", "nearest")
    if mode == "nearest":
        if rounding not in _ROUNDINGS:
            raise node.refuse(f"nearest_mode {rounding}, expected {', '.join(_ROUNDINGS)}")
        chosen = _ROUNDINGS[rounding](where).clip(0, axis.old - 1).astype(np.int64)
        return np.asarray(chosen[:, None] == np.arange(axis.old), dtype=np.float64)
    if mode not in ("linear", "cubic"):
        raise node.refuse(f"mode {mode}, expected nearest, linear or cubic")
    shrink = min(axis.scale, 1.0) if node.integer("antialias") else 1.0
    reach = math.ceil((1 if mode == "linear" else 2) / shrink)
    cells = np.floor(where).astype(np.int64)[:, None] + np.arange(1 - reach, reach + 1)
    distance = np.abs(cells - where[:, None]) * shrink
    a = node.number("cubic_coeff_a", -0.75)
    values = np.maximum(1 - distance, 0) if mode == "linear" else _cubic(distance, a)
    if node.integer("exclude_outside"):  # otherwise the border cells stand for those outside
        values = values * ((cells >= 0) & (cells < axis.old))
    values = values / values.sum(axis=1, keepdims=True)
    weights = np.zeros((axis.new, axis.old))
    np.add.at(weights, (np.arange(axis.new)[:, None], cells.clip(0, axis.old - 1)), values)
    return weights


def _cubic(distance: FloatArray, a: float) -> FloatArray:
    """Keys, "Cubic convolution interpolation for digital image processing", 1981."""
    near = ((a + 2) * distance - (a + 3)) * distance * distance + 1
    far = ((a * distance - 5 * a) * distance + 8 * a) * distance - 4 * a
    return np.where(distance <= 1, near, np.where(distance < 2, far, 0.0))


def _half_pixel(new: FloatArray, axis: _Axis) -> FloatArray:
    return (new + 0.5) / axis.scale - 0.5


def _half_pixel_symmetric(new: FloatArray, axis: _Axis) -> FloatArray:
    adjustment = axis.new / (axis.scale * axis.old)
    return axis.old / 2 * (1 - adjustment) + (new + 0.5) / axis.scale - 0.5


def _pytorch_half_pixel(new: FloatArray, axis: _Axis) -> FloatArray:
    return _half_pixel(new, axis) if axis.new > 1 else np.zeros_like(new)


def _align_corners(new: FloatArray, axis: _Axis) -> FloatArray:
    return new * (axis.old - 1) / (axis.new - 1) if axis.new > 1 else np.zeros_like(new)


def _asymmetric(new: FloatArray, axis: _Axis) -> FloatArray:
    return new / axis.scale


_COORDINATES = {
    "half_pixel": _half_pixel,
    "half_pixel_symmetric": _half_pixel_symmetric,
    "pytorch_half_pixel": _pytorch_half_pixel,
    "align_corners": _align_corners,
    "asymmetric": _asymmetric,
}

_ROUNDINGS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "round_prefer_floor": lambda where: np.ceil(where - 0.5),
    "round_prefer_ceil": lambda where: np.floor(where + 0.5),
    "floor": np.floor,
    "ceil": np.ceil,
}

TABLE: dict[str, Operator] = {"Resize": _resize, "Upsample": _upsample}
