"""ONNX graphs, written node by node: no paths of the machine, an operator set that engines read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import ExportError

OPSET, IR_VERSION = 15, 8
MAX_BYTES = (1 << 31) - 1  # of a protobuf file

Array = npt.NDArray[Any]
Shapes = Mapping[str, tuple[int | str, ...]]  # of values by name; text for sizes that a run decides


class Nodes:
    """Collects the nodes of a graph, and constants with unique names; each method returns the name of what it adds."""

    def __init__(self) -> None:
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

    def model(self, name: str, where: str, inputs: Shapes, outputs: Shapes) -> Any:
        """The `onnx.ModelProto` of all nodes, without metadata.

        :param name: of the graph
        :param where: what it is of, for messages
        :raises ExportError: numbers beyond float32 (or float16), or more than the 2 GB that a file can hold
        """
        from onnx import TensorProto, helper, numpy_helper

        total = sum(values.nbytes for values in self.constants.values())
        if total > MAX_BYTES - (1 << 20):
            raise ExportError(where, f"{total} bytes of tensors, expected less than the 2 GB that an ONNX file holds")
        for constant, values in self.constants.items():
            if not np.isfinite(values).all():
                what = f"values beyond the range of {values.dtype}, expected finite numbers"
                raise ExportError(f"{where} -> {constant}", what)
        ends = [
            [helper.make_tensor_value_info(end, TensorProto.FLOAT, shape) for end, shape in side.items()]
            for side in (inputs, outputs)
        ]
        graph = helper.make_graph(self.nodes, name, *ends)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="facepipe")
        model.ir_version = IR_VERSION
        for constant, values in self.constants.items():  # the helpers would copy all tensors twice
            model.graph.initializer.append(numpy_helper.from_array(values, constant))
        return model
