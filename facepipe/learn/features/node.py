"""One node of an ONNX graph as operators see it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from facepipe.core.errors import InputError

# (node, *inputs) -> a tensor or a tuple of them; an input that was left out is None
Operator = Callable[..., Any]

_MOST_ELEMENTS = 1 << 26  # of one value that a shape in the file asks for


@dataclass(frozen=True, kw_only=True)
class Node:
    """What an operator is told besides its inputs."""

    name: str
    op_type: str
    opset: int
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any] = field(default_factory=dict)  # numbers, texts, lists and arrays

    def integer(self, name: str, default: int = 0) -> int:
        """A whole number, or its default."""
        return int(self.attributes.get(name, default))

    def number(self, name: str, default: float = 0.0) -> float:
        """A number, or its default."""
        return float(self.attributes.get(name, default))

    def text(self, name: str, default: str = "") -> str:
        """A text, or its default."""
        value = self.attributes.get(name, default)
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)

    def integers(self, name: str, default: Sequence[int] = ()) -> tuple[int, ...]:
        """Whole numbers, or their default."""
        return tuple(int(one) for one in self.attributes.get(name, default))

    def given(self, name: str, value: Tensor | None) -> tuple[int, ...] | None:
        """Whole numbers that newer operator sets give as an input and older ones as an attribute; None: neither."""
        if value is not None:
            return whole(value)
        return self.integers(name) if name in self.attributes else None

    def refuse(self, what: str) -> InputError:
        """The error that this node has `what`."""
        return InputError(f"node {self.name or ', '.join(self.outputs)!r}", f"operator {self.op_type}: {what}")

    def room(self, *shape: int) -> None:
        """Refuse a shape that no feature has, before memory is taken for it."""
        count = 1
        for size in shape:
            count *= max(int(size), 0)
        if count > _MOST_ELEMENTS:
            raise self.refuse(f"a value of {count} numbers, expected at most {_MOST_ELEMENTS}")


def whole(value: Tensor) -> tuple[int, ...]:
    """The whole numbers in a tensor of any shape."""
    return tuple(int(one) for one in value.reshape(-1).tolist())


def positive(axis: int, dimensions: int) -> int:
    """An axis counted from the front.

    :raises IndexError: no such axis
    """
    if not -dimensions <= axis < max(dimensions, 1):
        raise IndexError(f"axis {axis} of a value with {dimensions} dimensions")
    return axis % max(dimensions, 1)


def along(values: Sequence[float] | Tensor, axis: int, like: Tensor) -> Tensor:
    """(n,) values shaped to broadcast along `axis` of `like`."""
    shape = [1] * like.ndim
    shape[axis] = -1
    return torch.as_tensor(values, device=like.device).reshape(shape)
