"""One node of an ONNX graph as operators see it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from facepipe.core.errors import InputError

# (node, *inputs) -> a tensor or a tuple of them; an input that was left out is None
Operator = Callable[..., Any]

_MOST_ELEMENTS = 1 << 26  # of one value that a shape in the file asks for


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
