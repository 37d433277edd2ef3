"""A graph under construction: nodes and constants with unique names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


class Nodes:
    """Collects the nodes of a graph; each method adds one and returns the name of its output."""

    def __init__(self, weights: str = "float32") -> None:
        """:param weights: how matrices of `packed_weights` are stored: float32, float16 or int8"""
        self.weights = weights
        self.samples: dict[str, tuple[Array, Array]] = {}  # of values, (n, size): as they are, and as packed weights do
        self.nodes: list[Any] = []
        self.constants: dict[str, Array] = {}
        self._index_names: dict[tuple[int, ...], str] = {}

    def constant(self, name: str, values: Array, kind: npt.DTypeLike = np.float32) -> str:
        """A tensor of the file, float32 unless it is to be of another kind."""
        unique = name if name not in self.constants else f"{name}_{len(self.constants)}"
        with np.errstate(over="ignore"):  # what does not fit is refused when the model is made
            self.constants[unique] = np.asarray(values, dtype=kind, order="C")
        return unique

    def indices(self, values: Sequence[int] | npt.NDArray[np.integer]) -> str:
        """A 1-D int64 tensor of the file; equal ones are stored once."""
        array = np.asarray(values, dtype=np.int64)
        key = tuple(array.tolist())
        if key not in self._index_names:
            self._index_names[key] = f"indices_{len(self._index_names)}"
            self.constants[self._index_names[key]] = array
        return self._index_names[key]

    def add(self, operator: str, *inputs: str, name: str | None = None, **attributes: Any) -> str:
        """A node with one output, called `name` if given."""
        from onnx import helper

        output = name or f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [output], name=f"node_{output}", **attributes))
        return output

    def reshape(self, value: str, *sizes: int, name: str | None = None) -> str:
        """Reshape to `sizes`."""
        return self.add("Reshape", value, self.indices(sizes), name=name)

    def slice(self, value: str, axis: int, start: int, end: int) -> str:
        """The part start..end - 1 of an axis."""
        return self.add("Slice", value, self.indices([start]), self.indices([end]), self.indices([axis]))

    def gather(self, value: str, axis: int, indices: Sequence[int] | npt.NDArray[np.integer]) -> str:
        """Entries of an axis by number."""
        return self.add("Gather", value, self.indices(indices), axis=axis)

    def concat(self, values: Sequence[str], axis: int, name: str | None = None) -> str:
        """Values after one another along an axis; one value alone is passed on where no name is asked for."""
        if len(values) == 1 and name is None:
            return values[0]
        return self.add("Concat", *values, axis=axis, name=name)
