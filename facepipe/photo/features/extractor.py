"""Feature extractors: a face's picture in, content, identity, attributes or landmarks out, with gradients."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import check_model
from facepipe.geometry.face_crops import arcface_crop, face_crop
from facepipe.networks.description import DEFAULT_SIZES, PROPERTY, Crop, Description, Kind, describe
from facepipe.networks.onnx_file import properties, read_model
from facepipe.photo.features.onnx_module import OnnxModule
from facepipe.photo.features.signatures import Features, Heads, check_features, check_input, check_ranges

Chosen = tuple[str | int, ...]

_FLOAT = 1  # TensorProto.FLOAT
_GREY = 0.5


@dataclass(frozen=True, kw_only=True)
class Program:
    """A network that takes one picture."""

    shape: tuple[int | None, ...]  # of its input; None: any size
    outputs: tuple[str, ...]
    metadata: str | None  # JSON about itself
    build: Callable[[Chosen], nn.Module]  # picture -> tuple of the chosen outputs, frozen


def load_program(path: Path, *, bounded: bool = False) -> Program:
    """The network in a file: ``.onnx``, or ``.pt2`` as `torch.export.save` writes it.

    Loading a ``.pt2`` file can run code that is in it; an ONNX file can't.

    :param bounded: as for `OnnxModule`
    :raises InputError: another suffix, a ``.pt2`` that the caller doesn't trust, a damaged file, or not one picture of
        float32 as input
    """
    suffix = path.suffix.lower()
    if suffix == ".onnx":
        return _onnx(path, bounded)
    if suffix == ".pt2":
        return _exported(path)
    raise InputError(path, f"suffix '{path.suffix}', expected .onnx or .pt2 (torch.export)")


def _onnx(path: Path, bounded: bool) -> Program:
    model = read_model(path)
    held = {one.name for one in model.graph.initializer}
    inputs = [one for one in model.graph.input if one.name not in held]
    _only_one(path, [one.name for one in inputs])
    kind = inputs[0].type.tensor_type
    if kind.elem_type != _FLOAT:
        raise InputError(f"{path} -> input {inputs[0].name!r}", f"of type {kind.elem_type}, expected float32 (1)")
    names = tuple(one.name for one in model.graph.output)

    def build(chosen: Chosen) -> nn.Module:
        return OnnxModule(model, [_name(path, names, one) for one in chosen], path, bounded=bounded)

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
    names = tuple(str(output) for output in signature.user_outputs)

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
            outputs = self._module(picture)
        except (RuntimeError, AssertionError, ValueError, TypeError) as error:
            lines = str(error).splitlines()
            raise InputError(self._path, f"can't work on a picture of {tuple(picture.shape)} ({lines[:1]})") from error
        flat = _flat(outputs)
        return tuple(flat[place] for place in self._places)


def _flat(given: Any) -> list[Tensor]:
    if isinstance(given, Tensor):
        return [given]
    parts = given.values() if isinstance(given, dict) else given
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


class Extractor(nn.Module):  # type: ignore[misc]
    """A frozen network that takes sRGB pictures (b, 3, size, size) in 0..1; made by `load_extractor`."""

    kind: Kind  # what a call gives
    kinds: tuple[Kind, ...]  # what one forward gives
    size: int  # pixels a side of its pictures
    crop: Crop  # how a face lies in them
    names: tuple[str, ...]  # of attributes, empty where they have none
    trained_on: str

    def __init__(self, network: nn.Module, heads: Heads, description: Description, kind: Kind, size: int) -> None:
        """:param network: normalised pictures -> tuple of tensors, those of all kinds one after the other"""
        super().__init__()
        self.normalize, self.network, self.heads = Normalize(description), network, heads
        self.kind, self.kinds, self.size = kind, tuple(description.kinds), size
        self.crop, self.names, self.trained_on = description.crop, description.names, description.trained_on
        self.eval()

    def forward(self, image: Tensor) -> Features:
        """The features of `kind`, as `features`."""
        return self.features(image)[self.kind]

    def features(self, image: Tensor) -> dict[Kind, Features]:
        """By kind, of sRGB pictures (b, 3, size, size) in 0..1, all by one forward:

        - content: tensors (b, c, h, w), shallow first, the last one probabilities (b, 11, h, w) of `CLASSES`
        - identity: embedding (b, d)
        - attributes: (b, a) in 0..1
        - landmarks: (b, 68, 2) x and y in 0..1 of the picture, and (b, 1) the probability that it shows a face

        :raises InputError: pictures of another shape
        """
        if image.ndim != 4 or tuple(image.shape[1:]) != (3, self.size, self.size):
            raise InputError("image", f"shape {tuple(image.shape)}, expected (b, 3, {self.size}, {self.size})")
        return dict(self.heads(self.network(self.normalize(image))))

    def crop_matrix(self, landmarks: FloatArray) -> FloatArray:
        """(2, 3) matrix for `sample_crop`: the crop that it wants of a face with `landmarks` (68, 2), image pixels."""
        return arcface_crop(landmarks, self.size) if self.crop == "arcface" else face_crop(landmarks, self.size)


class Normalize(nn.Module):  # type: ignore[misc]
    """Pictures as a network was trained on them: mean and deviation, then the order of the channels."""

    def __init__(self, description: Description) -> None:
        super().__init__()
        self._turned = description.order == "BGR"
        self.register_buffer("mean", torch.tensor(description.mean)[:, None, None])
        self.register_buffer("std", torch.tensor(description.std)[:, None, None])

    def forward(self, image: Tensor) -> Tensor:
        normal = (image - self.mean) / self.std
        return normal.flip(1) if self._turned else normal


def load_extractor(path: str | os.PathLike[str], kind: Kind | None = None, *, bounded: bool = False) -> Extractor:
    """The network in an ONNX file, or a torch.export program (``.pt2``: trusted files only, loading can run code).

    How it wants pictures and what its outputs are stands in ``<path>.json``, by the metadata ``facepipe.features``
    of an ONNX file, or else it is what is usual for `kind`. It is tried on a grey picture.

    :param kind: what a call gives; None: the first that the file says
    :param bounded: as for `OnnxModule`
    :raises InputError: not readable, operators or values that can't be used, a signature other than that of its
        kinds, no gradient, NaN
    """
    source = Path(path)
    program = load_program(source, bounded=bounded)
    description = describe(source, program.metadata, kind)
    first: Kind = next(iter(description.kinds)) if kind is None else kind
    size = check_input(source, program.shape, description.size, DEFAULT_SIZES[first])
    grey = torch.full((1, 3, size, size), _GREY, requires_grad=True)
    normal = Normalize(description)(grey)
    chosen = {one: _outputs(source, program, one, description, normal) for one in description.kinds}
    network = _ByPicture(program, tuple(name for names in chosen.values() for name in names))
    outputs = network(normal)
    if source.suffix.lower() == ".pt2" and not all(map(torch.equal, outputs, network(normal))):
        raise InputError(source, "other values for the same picture, expected a program exported in eval mode")
    heads = _heads(source, description, outputs, chosen)
    return Extractor(network, heads, description, first, size)


def _outputs(path: Path, program: Program, kind: Kind, description: Description, normal: Tensor) -> Chosen:
    """Those the description names, else all; of content networks with auxiliary heads of one shape, the first."""
    chosen = description.kinds[kind] or program.outputs
    if kind == "content" and not description.kinds[kind] and len(chosen) > 1:
        with torch.no_grad():
            found = _ByPicture(program, chosen)(normal)
        if len({tuple(one.shape[:2]) for one in found}) == 1:
            return chosen[:1]
    expected = {"content": len(chosen), "landmarks": 2}.get(kind, 1)
    if len(chosen) != expected:
        what = f"{len(chosen)} outputs for {kind} ({', '.join(map(str, chosen))[:80]}), expected {expected}"
        raise InputError(path, f"{what}: name them as kinds in {path.name}.json")
    return chosen


def _heads(path: Path, description: Description, outputs: tuple[Tensor, ...], chosen: Mapping[Kind, Chosen]) -> Heads:
    """Those of a network that gave `outputs` for the grey picture.

    :raises InputError: outputs that are not what the kinds ask for
    """
    raw: dict[Kind, tuple[Tensor, ...]] = {}
    rest = outputs
    for kind, names in chosen.items():
        raw[kind], rest = rest[: len(names)], rest[len(names) :]
    check_features(path, raw, chosen)
    try:
        heads = Heads(description, raw)
        check_ranges(heads(outputs), description.names)
    except InputError as error:
        raise error.under(path) from None
    return heads


class _ByPicture(nn.Module):  # type: ignore[misc]
    """Outputs of a program for any number of pictures, also where it was made for one at a time."""

    def __init__(self, program: Program, chosen: Chosen) -> None:
        super().__init__()
        self.module, self._batch = program.build(chosen), program.shape[0]

    def forward(self, pictures: Tensor) -> tuple[Tensor, ...]:
        if self._batch in (None, pictures.shape[0]):
            return tuple(self.module(pictures))
        parts = [self.module(one) for one in pictures.split(1)]
        return tuple(torch.cat(same) for same in zip(*parts, strict=True))
