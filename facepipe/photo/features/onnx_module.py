"""An ONNX graph as a module of torch, with gradients (onnxruntime gives none).

How much the nodes of a graph make is found without making it, on torch's meta device, which has shapes alone. Small
values are computed as they are: they can be the shapes of others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from facepipe.core.errors import InputError
from facepipe.networks.onnx_file import array, opset
from facepipe.photo.features.operators import OPERATORS, Node, Operator, whole

MOST = 1 << 29  # numbers that all nodes together make of one picture
_SMALL = 1000
_RUN_ERRORS = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
_TENSOR, _PLAIN = 4, {1, 2, 3, 6, 7, 8}  # AttributeProto.TENSOR; FLOAT, INT, STRING and lists of them


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
        outputs = _shapes(node, operator, [known[name] if name else None for name in node.inputs])
        total += sum(output.numel() for output in outputs)
        if total > MOST * pictures:
            raise node.refuse(f"{total} numbers by then, expected at most {MOST} for a picture")
        known.update(zip(node.outputs, map(_kept, outputs), strict=False))


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
            outputs = operator(node, *one)
        except Exception:  # shapes alone don't suffice, or it can't work at all: the run itself says so
            continue
        return tuple(outputs) if isinstance(outputs, tuple) else (outputs,)
    return ()


def _empty(node: Node, shape: Tensor) -> Tensor:
    return torch.empty(whole(shape), device="meta")


def _kept(value: Tensor) -> Tensor:
    return value if value.numel() <= _SMALL else value.to("meta")


def _meta(value: Tensor | None) -> Tensor | None:
    return None if value is None else value.to("meta")


class OnnxModule(nn.Module):  # type: ignore[misc]
    """The nodes of a graph, run one after the other; weights and constants are buffers.

    Only what the outputs need is kept. Weights are frozen: gradients flow to the inputs.
    """

    def __init__(
        self, model: Any, outputs: Sequence[str] | None = None, where: object = "model", *, bounded: bool = False
    ) -> None:
        """:param model: `onnx.ModelProto`
        :param outputs: names of values to give, also inner ones; default the graph's own outputs
        :param where: the file, for messages
        :param bounded: known to make no more than fits; what a graph makes is counted otherwise, which takes seconds
        :raises InputError: operators that are not known here, values that nothing makes, bad weights
        """
        super().__init__()
        self._where, graph = str(where), model.graph
        weights = {one.name: one for one in graph.initializer}
        self.inputs: tuple[str, ...] = tuple(one.name for one in graph.input if one.name not in weights)
        self.outputs: tuple[str, ...] = tuple(outputs or (one.name for one in graph.output))
        wanted, nodes = set(self.outputs), []  # what the outputs depend on
        for proto in reversed(graph.node):
            if wanted.intersection(proto.output):
                wanted.update(name for name in proto.input if name)
                nodes.append(proto)
        nodes.reverse()
        self._buffer_of: dict[str, str] = {}
        used = {name for node in nodes for name in node.input} | set(self.outputs)
        try:
            for name in sorted(used & set(weights)):
                self._keep(name, torch.from_numpy(array(weights[name])))
            version = opset(model)
            self._steps = [step for node in nodes for step in self._step(node, version)]
            known = {*self.inputs, *self._buffer_of}
            for node, _ in self._steps:
                for place, name in enumerate(node.inputs):
                    if name not in known and (name or place == 0):
                        raise node.refuse(f"input {name!r}, which nothing before it makes")
                for name in filter(None, node.outputs):
                    if name in known:
                        raise node.refuse(f"output {name!r}, which there is already")
                    known.add(name)
            for name in self.outputs:
                if name not in known:
                    raise InputError(f"output {name!r}", "no value of the graph, expected the name of one")
        except InputError as error:
            raise error.under(where) from None
        # by step, the values that nothing after it reads, so that a forward without gradients frees them
        later, uses = set(self.outputs), []
        for node, _ in reversed(self._steps):
            done = [name for name in (*node.inputs, *node.outputs) if name and name not in later]
            later.update(done)
            uses.append(done)
        self._last = uses[::-1]
        self._bounded = bounded
        self._checked: tuple[torch.Size, ...] = ()  # shapes of the inputs last checked
        self.eval()

    def forward(self, *values: Tensor) -> tuple[Tensor, ...]:
        """`outputs` of `inputs`, in their order.

        :raises InputError: a node that can't work on what it is given
        """
        known: dict[str, Tensor] = dict(zip(self.inputs, values, strict=True))
        known.update({name: self.get_buffer(buffer) for name, buffer in self._buffer_of.items()})
        shapes = tuple(one.shape for one in values)
        if shapes != self._checked and not self._bounded:
            try:
                check_sizes(self._steps, known, max([1, *(shape[0] for shape in shapes if shape)]))
            except InputError as error:
                raise error.under(self._where) from None
            self._checked = shapes
        for (node, operator), done in zip(self._steps, self._last, strict=True):
            try:
                outputs = operator(node, *[known[name] if name else None for name in node.inputs])
            except InputError as error:
                raise error.under(self._where) from None
            except _RUN_ERRORS as error:
                what = f"can't work on its inputs ({str(error).splitlines()[0] if str(error) else error!r})"
                raise node.refuse(what).under(self._where) from error
            known.update(zip(node.outputs, outputs if isinstance(outputs, tuple) else (outputs,), strict=True))
            # What no later node takes is let go, else the memory of all layers is held at once.
            for name in done:
                known.pop(name, None)
        return tuple(known[name] for name in self.outputs)

    def _keep(self, name: str, value: Tensor) -> None:
        buffer = f"value_{len(self._buffer_of)}"
        self._buffer_of[name] = buffer
        self.register_buffer(buffer, value)

    def _step(self, proto: Any, version: int) -> Iterator[tuple[Node, Operator]]:
        """The node with what it does; a constant is kept as a weight is."""
        from onnx import helper

        attributes: dict[str, Any] = {}
        outputs = proto.output if proto.op_type == "Split" else proto.output[:1]  # others are of training
        of_file = {"name": proto.name, "op_type": proto.op_type, "opset": version, "inputs": tuple(proto.input)}
        node = Node(**of_file, outputs=tuple(outputs), attributes=attributes)
        for attribute in proto.attribute:
            if attribute.type == _TENSOR:
                attributes[attribute.name] = array(attribute.t)
            elif attribute.type in _PLAIN and not attribute.ref_attr_name:
                value = helper.get_attribute_value(attribute)
                attributes[attribute.name] = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
            else:
                raise node.refuse(f"attribute {attribute.name!r} is a graph or of another kind, expected numbers")
        if proto.domain not in ("", "ai.onnx"):
            raise node.refuse(f"of domain {proto.domain!r}, expected the operators of ONNX itself")
        if node.op_type == "Constant":
            kinds = ("value", "value_float", "value_int", "value_floats", "value_ints")
            given = next((kind for kind in kinds if kind in attributes), None)
            if given is None:
                raise node.refuse("no dense value of numbers, expected one")
            self._keep(node.outputs[0], torch.as_tensor(attributes[given]))
        elif node.op_type not in OPERATORS:
            raise node.refuse(f"is not read, expected one of {', '.join(sorted({'Constant', *OPERATORS}))}")
        else:
            yield node, OPERATORS[node.op_type]
