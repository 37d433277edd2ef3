"""How much the nodes of a graph make, found without making it: on torch's meta device, which has shapes alone.

Small values are computed as they are: they can be the shapes of others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from facepipe.learn.features.node import Node, Operator, whole

MOST = 1 << 29  # numbers that all nodes together make of one picture
_SMALL = 1000


def check_sizes(steps: Sequence[tuple[Node, Operator]], values: Mapping[str, Tensor], pictures: int) -> None:
    """Count what `steps` make of `values`. What only the numbers decide is not counted, nor what follows from it.

    :param pictures: how many are in `values`
    :raises InputError: a node after which it is more than `MOST` for each picture
    """
    known = {name: _kept(value) for name, value in values.items()}
    total = 0
    for node, operator in steps:
        if any(name and name not in known for name in node.inputs):
            continue
        found = _shapes(node, operator, [known[name] if name else None for name in node.inputs])
        total += sum(one.numel() for one in found)
        if total > MOST * pictures:
            raise node.refuse(f"{total} numbers by then, expected at most {MOST} for a picture")
        known.update(zip(node.outputs, map(_kept, found), strict=False))


def _shapes(node: Node, operator: Operator, inputs: Sequence[Tensor | None]) -> tuple[Tensor, ...]:
    """What a node makes, as shapes where that suffices; nothing where it takes numbers that are not there."""
    first, *rest = inputs or (None,)
    if node.op_type == "ConstantOfShape":
        operator = _empty
    if node.op_type == "Shape" and first is not None:
        first = torch.zeros(()).expand(first.shape)  # takes no memory
        rest = []
    small = all(one is None or not one.is_meta for one in inputs) or node.op_type == "Shape"
    tries = [[first, *rest]] if small else []
    for one in (*tries, [_meta(first), *rest], [_meta(each) for each in (first, *rest)]):
        try:
            found = operator(node, *one)
        except Exception:  # shapes alone don't suffice, or it can't work at all: the run itself says so
            continue
        return tuple(found) if isinstance(found, tuple) else (found,)
    return ()


def _empty(node: Node, shape: Tensor) -> Tensor:
    return torch.empty(whole(shape), device="meta")


def _kept(value: Tensor) -> Tensor:
    return value if value.numel() <= _SMALL else value.to("meta")


def _meta(value: Tensor | None) -> Tensor | None:
    return None if value is None else value.to("meta")
