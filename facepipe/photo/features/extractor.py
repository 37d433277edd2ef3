"""Feature extractors: a face's picture in, features out, with gradients; their signatures, our own, and likeness."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import cosine_similarity

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import check_model
from facepipe.geometry.colors import to_srgb
from facepipe.geometry.face_crops import arcface_crop, face_crop
from facepipe.networks import feature_model
from facepipe.networks.files import sample_crop
from facepipe.networks.onnx_file import (
    CELEBAMASK,
    CLASSES,
    DEFAULT_SIZES,
    PROPERTY,
    Crop,
    Description,
    Kind,
    class_matrix,
    describe,
    properties,
    read_model,
)
from facepipe.photo.features.onnx_module import OnnxModule
from facepipe.rig.torch.one_thread import one_thread

Features: TypeAlias = Tensor | tuple[Tensor, ...]
_SLACK = 1e-3  # of probabilities at their bounds and in their sum
Chosen = tuple[str | int, ...]

_FLOAT = 1  # TensorProto.FLOAT
_GREY = 0.5


class Heads(nn.Module):  # type: ignore[misc]
    """Makes scores probabilities, and the classes of others the eleven, where a network leaves that open."""

    def __init__(self, description: Description, raw: Mapping[Kind, Sequence[Tensor]]) -> None:
        """:param raw: by kind, what the network gives for one picture
        :raises InputError: content whose last output has other channels than its labels, or labels unknown here
        """
        super().__init__()
        self._counts = {kind: len(parts) for kind, parts in raw.items()}
        self._scores = {kind for kind in raw if description.logits and kind != "identity"}
        classes = None
        if "content" in raw:
            last = raw["content"][-1]
            channels = last.shape[1]
            # (11, channels) which channel is what class; None where they are the eleven in their order
            labels = description.labels or {len(CLASSES): CLASSES, len(CELEBAMASK): CELEBAMASK}.get(channels, ())
            if len(labels) != channels:
                expected = (
                    f"{len(labels)} as its labels say" if labels else f"{len(CLASSES)}, or labels that name each class"
                )
                raise InputError("content", f"last output of {channels} channels, expected {expected}")
            classes = None if tuple(labels) == CLASSES else torch.as_tensor(class_matrix(labels), dtype=torch.float32)
            if description.logits is None and not is_probability(last):
                self._scores.add("content")
        self.register_buffer("classes", classes)

    def forward(self, parts: Sequence[Tensor]) -> dict[Kind, Features]:
        """By kind, the tensors `parts` of all kinds one after the other."""
        given: dict[Kind, Features] = {}
        for kind, count in self._counts.items():
            (*shallow, last), parts = parts[:count], parts[count:]
            if kind in self._scores:
                last = last.softmax(dim=1) if kind == "content" else last.sigmoid()
            if kind == "content" and self.classes is not None:
                last = torch.einsum("kc,bchw->bkhw", self.classes, last)
            given[kind] = (*shallow, last) if kind in ("content", "landmarks") else last
        return given


def check_input(path: Path, shape: Sequence[int | None], asked: int | None, usual: int) -> int:
    """Pixels a side of the pictures, by the network's input (b, 3, S, S), its description, or what is usual.

    :raises InputError: another rank, other channels, not square, another size than described, a batch of several
    """
    shown = "(" + ", ".join("any" if one is None else str(one) for one in shape) + ")"
    if len(shape) != 4 or shape[1] not in (3, None) or shape[0] not in (1, None):
        raise InputError(path, f"input of shape {shown}, expected (b, 3, S, S)")
    sides = {one for one in shape[2:] if one is not None}
    if len(sides) > 1:
        raise InputError(path, f"input of shape {shown}, expected a square picture (b, 3, S, S)")
    if asked is not None and sides - {asked}:
        raise InputError(path, f"input of shape {shown}, expected size {asked} as its description says")
    return asked or next(iter(sides), usual)


def check_features(
    path: Path, raw: Mapping[Kind, Sequence[Tensor]], chosen: Mapping[Kind, Sequence[str | int]]
) -> None:
    """Outputs for one picture that needs a gradient: floats, of the ranks of their kinds, finite, with gradients.

    :raises InputError: what is wrong with which output
    """
    for kind, parts in raw.items():
        for place, (value, name) in enumerate(zip(parts, chosen[kind], strict=True)):
            where = f"{path} -> {kind} output {name!r}"
            if not isinstance(value, Tensor) or value.dtype != torch.float32:
                raise InputError(where, f"of type {getattr(value, 'dtype', type(value).__name__)}, expected float32")
            if not torch.isfinite(value).all():
                raise InputError(where, "NaN or infinity for a grey picture, expected finite numbers")
            if not value.requires_grad:
                raise InputError(where, "has no gradient in the picture, expected a differentiable output")
            shape = tuple(value.shape)
            if kind == "content":
                good, expected = len(shape) == 4 and shape[0] == 1 and value.numel() > 0, "(b, c, h, w)"
            elif kind == "landmarks":
                expected = "(b, 1)" if place else "(b, 68, 2)"
                good = shape == ((1, 1) if place else (1, 68, 2))
            else:
                good, expected = len(shape) == 2 and shape[0] == 1 and shape[1] > 0, "(b, n)"
            if not good:
                raise InputError(where, f"of shape {shape} for one picture, expected {expected}")


def check_ranges(features: Mapping[Kind, Tensor | Sequence[Tensor]], names: Sequence[str]) -> None:
    """Probabilities are in 0..1, those of classes sum to 1, and attributes are as many as their `names`, if any.

    :raises InputError: the kind that is wrong
    """
    for kind, parts in features.items():
        value = parts if isinstance(parts, Tensor) else parts[-1]
        if kind == "content" and not is_probability(value):
            raise InputError(kind, 'last output is no probabilities, expected a sum of 1 ("logits": true of scores)')
        if kind in ("attributes", "landmarks") and not _within(value):
            shown = f"{value.min().item():.3g} to {value.max().item():.3g}"
            raise InputError(kind, f'values of {shown} in the last output, expected 0 to 1 ("logits": true of scores)')
        if kind == "attributes" and names and len(names) != value.shape[1]:
            raise InputError(kind, f"{value.shape[1]} values, expected {len(names)} as its names say")


def is_probability(value: Tensor) -> bool:
    """Whether (b, c, h, w) sums to 1 over its channels, all of them in 0..1."""
    whole = (value.sum(dim=1) - 1).abs().max() <= _SLACK
    return bool(whole and _within(value))


def _within(value: Tensor) -> bool:
    return bool(value.min() >= -_SLACK and value.max() <= 1 + _SLACK)


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
    if suffix == ".pt2":
        return _exported(path)
    raise InputError(path, f"suffix '{path.suffix}', expected .onnx or .pt2 (torch.export)")


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


@one_thread()
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
    # dropout or statistics of a batch, exported in training mode, show as other values for the same picture
    if source.suffix.lower() == ".pt2" and not all(map(torch.equal, outputs, network(normal))):
        raise InputError(source, "other values for the same picture, expected a program exported in eval mode")
    raw: dict[Kind, tuple[Tensor, ...]] = {}
    rest = outputs
    for one, names in chosen.items():
        raw[one], rest = rest[: len(names)], rest[len(names) :]
    check_features(source, raw, chosen)
    try:
        heads = Heads(description, raw)
        check_ranges(heads(outputs), description.names)
    except InputError as error:
        raise error.under(source) from None
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


def similarity(network: Extractor, photo: FloatArray, render: FloatArray, landmarks: FloatArray) -> float | None:
    """Cosine of the angle between embeddings of a photo (h, w, 3) sRGB and a render, 1: the same person; None: NaN.

    Both are cut at the same place, and are the same grey where the render shows nothing, so that neither background
    nor clothes count.

    :param render: (rh, rw, 4) linear colour on black and coverage 0..1, of all that the photo shows, any size
    :param landmarks: (68, 2) pixels of the photo
    """
    assert network.kind == "identity", network.kind
    matrix = network.crop_matrix(landmarks)
    reduced = matrix * (render.shape[1] / photo.shape[1])
    cover = np.clip(render[..., 3:], 0, 1)
    # sRGB is not linear: of colour on black it would change the tone of outlines; cut with coverage, since the cut
    # averages pixels
    color = to_srgb(np.clip(render[..., :3] / np.maximum(cover, 1e-6), 0, 1))
    with torch.no_grad():
        shown, share = (_cut(pixels, reduced, network.size) for pixels in (color * cover, cover))
        both = (shown, _cut(photo, matrix, network.size) * share)
        first, second = (network((each + _GREY * (1 - share)).clamp(0, 1)) for each in both)
    cosine = float(cosine_similarity(first.flatten(1), second.flatten(1))[0])
    return cosine if np.isfinite(cosine) else None


def _cut(pixels: FloatArray, matrix: FloatArray, size: int) -> Tensor:
    return sample_crop(torch.as_tensor(np.ascontiguousarray(pixels, dtype=np.float32)), matrix, size)


def own_extractors(kinds: Sequence[Kind]) -> dict[Kind, Extractor]:
    """The extractor of each kind: one network for all, so that one forward serves them.

    :raises InputError: a kind that it does not have
    """
    loaded = load_extractor(feature_model(), kinds[0], bounded=True) if kinds else None
    missing = [kind for kind in kinds if loaded is None or kind not in loaded.kinds]
    if missing:
        raise InputError(feature_model(), f"has no {missing[0]}, expected one of {loaded.kinds if loaded else ()}")
    return {kind: loaded for kind in kinds if loaded is not None}
