"""Networks in files, ONNX or torch.export, seen alike: one picture in, tensors out by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from facepipe.core.errors import InputError
from facepipe.core.trust import check_model
from facepipe.learn.features.description import PROPERTY
from facepipe.learn.features.onnx_file import properties, read_model
from facepipe.learn.features.onnx_module import OnnxModule

Chosen = tuple[str | int, ...]

_FLOAT = 1  # TensorProto.FLOAT


@dataclass(frozen=True, kw_only=True)
class Program:
    """A network that takes one picture."""

    shape: tuple[int | None, ...]  # of its input; None: any size
    outputs: tuple[str, ...]
    metadata: str | None  # JSON about itself
    build: Callable[[Chosen], nn.Module]  # picture -> tuple of the chosen outputs, frozen


def load_program(path: Path) -> Program:
    """The network in a file: ``.onnx``, or ``.pt2`` as `torch.export.save` writes it.

    Loading a ``.pt2`` file can run code that is in it; an ONNX file can't.

    :raises InputError: another suffix, a ``.pt2`` that the caller doesn't trust, a damaged file, or not one picture of
        float32 as input
    """
    suffix = path.suffix.lower()
    if suffix == ".onnx":
        return _onnx(path)
    if suffix == ".pt2":
        return _exported(path)
    raise InputError(path, f"suffix '{path.suffix}', expected .onnx or .pt2 (torch.export)")


def _onnx(path: Path) -> Program:
    model = read_model(path)
    held = {one.name for one in model.graph.initializer}
    inputs = [one for one in model.graph.input if one.name not in held]
    _only_one(path, [one.name for one in inputs])
    kind = inputs[0].type.tensor_type
    if kind.elem_type != _FLOAT:
        raise InputError(f"{path} -> input {inputs[0].name!r}", f"of type {kind.elem_type}, expected float32 (1)")
    names = tuple(one.name for one in model.graph.output)

    def build(chosen: Chosen) -> nn.Module:
        return OnnxModule(model, [_name(path, names, one) for one in chosen], path)

    shape = tuple(one.dim_value if one.dim_value > 0 else None for one in kind.shape.dim)
    return Program(shape=shape, outputs=names, metadata=properties(model).get(PROPERTY), build=build)


def _exported(path: Path) -> Program:
    if not path.is_file():
        raise InputError(path, "no such file")
    check_model(path)
    try:
        program = torch.export.load(path)
        signature = program.graph_signature
        inputs = list(signature.user_inputs)
        _only_one(path, inputs)
        values = {node.name: node.meta.get("val") for node in program.graph.nodes if node.op == "placeholder"}
        picture = values[inputs[0]]
        module = program.module()
    except InputError:
        raise
    except Exception as error:  # zip, pickle, JSON and schema errors of many kinds
        raise InputError(path, "is damaged or no torch.export program") from error
    if not isinstance(picture, Tensor) or picture.dtype != torch.float32:
        raise InputError(path, f"input of type {getattr(picture, 'dtype', picture)}, expected float32")
    names = tuple(str(one) for one in signature.user_outputs)

    def build(chosen: Chosen) -> nn.Module:
        return _Chosen(module, [names.index(_name(path, names, one)) for one in chosen], path)

    shape = tuple(size if isinstance(size, int) else None for size in picture.shape)
    return Program(shape=shape, outputs=names, metadata=None, build=build)


class _Chosen(nn.Module):  # type: ignore[misc]
    """Some outputs of a module, by position; its weights are frozen."""

    def __init__(self, module: nn.Module, places: Sequence[int], path: Path) -> None:
        super().__init__()
        self._module, self._places, self._path = module, tuple(places), path
        for weight in module.parameters():
            weight.requires_grad_(False)

    def train(self, mode: bool = True) -> _Chosen:
        """Programs keep the mode that they were exported in, and don't take another."""
        return self

    def forward(self, picture: Tensor) -> tuple[Tensor, ...]:
        try:
            found = self._module(picture)
        except (RuntimeError, AssertionError, ValueError, TypeError) as error:
            lines = str(error).splitlines()
            raise InputError(self._path, f"can't work on a picture of {tuple(picture.shape)} ({lines[:1]})") from error
        flat = _flat(found)
        return tuple(flat[place] for place in self._places)


def _flat(found: Any) -> list[Tensor]:
    if isinstance(found, Tensor):
        return [found]
    parts = found.values() if isinstance(found, dict) else found
    return [leaf for part in parts for leaf in _flat(part)]


def _only_one(path: Path, inputs: Sequence[str]) -> None:
    if len(inputs) != 1:
        raise InputError(path, f"{len(inputs)} inputs ({', '.join(inputs)[:80]}), expected one picture")


def _name(path: Path, names: Sequence[str], chosen: str | int) -> str:
    """A value's name from itself or from its place among the outputs; whether there is such a value shows later."""
    if isinstance(chosen, int):
        if not 0 <= chosen < len(names):
            raise InputError(path, f"output {chosen}, expected 0 to {len(names) - 1}")
        return names[chosen]
    if path.suffix.lower() == ".pt2" and chosen not in names:
        raise InputError(path, f"output {chosen!r}, expected one of {', '.join(names)[:120]} or a position")
    return chosen
