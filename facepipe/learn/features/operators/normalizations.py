"""Normalisation by kept or by own statistics."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from facepipe.learn.features.node import Node, Operator, along, positive


def _batch(node: Node, x: Tensor, scale: Tensor, shift: Tensor, mean: Tensor, variance: Tensor) -> Tensor:
    if node.integer("training_mode") or not node.integer("spatial", 1):
        raise node.refuse("training_mode 1 or spatial 0, expected a trained network with statistics by channel")
    return functional.batch_norm(x, mean, variance, scale, shift, eps=node.number("epsilon", 1e-5))


def _instance(node: Node, x: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
    return functional.instance_norm(x, weight=scale, bias=shift, eps=node.number("epsilon", 1e-5))


def _layer(node: Node, x: Tensor, scale: Tensor, shift: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Normalised, then the mean and the inverse deviation, with the axes that they span of size 1."""
    axes = tuple(range(positive(node.integer("axis", -1), x.ndim), x.ndim))
    mean = x.mean(axes, keepdim=True)
    inverse = torch.rsqrt((x - mean).square().mean(axes, keepdim=True) + node.number("epsilon", 1e-5))
    result = (x - mean) * inverse * scale
    return result if shift is None else result + shift, mean, inverse


def _group(node: Node, x: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
    """Scale and shift are by channel since operator set 21, by group before."""
    groups, plain = node.integer("num_groups", 1), node.opset >= 21
    normal = functional.group_norm(x, groups, eps=node.number("epsilon", 1e-5))
    repeat = 1 if plain else x.shape[1] // groups
    return normal * along(scale.repeat_interleave(repeat), 1, x) + along(shift.repeat_interleave(repeat), 1, x)


TABLE: dict[str, Operator] = {
    "BatchNormalization": _batch,
    "InstanceNormalization": _instance,
    "LayerNormalization": _layer,
    "GroupNormalization": _group,
}
