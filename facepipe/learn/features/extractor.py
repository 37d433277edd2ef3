"""Feature extractors: a face's picture in, content, identity, attributes or landmarks out, with gradients."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.learn.features.crops import arcface_crop, face_crop
from facepipe.learn.features.description import DEFAULT_SIZES, Crop, Description, Kind, describe
from facepipe.learn.features.programs import Chosen, Program, load_program
from facepipe.learn.features.signatures import Features, Heads, check_features, check_input, check_ranges

_GREY = 0.5


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


def load_extractor(path: str | os.PathLike[str], kind: Kind | None = None) -> Extractor:
    """The network in an ONNX file, or a torch.export program (``.pt2``: trusted files only, loading can run code).

    How it wants pictures and what its outputs are is said by ``<path>.json``, by the metadata ``facepipe.features``
    of an ONNX file, or else it is what is usual for `kind`. It is tried on a grey picture.

    :param kind: what a call gives; None: the first that the file says
    :raises InputError: not readable, operators or values that can't be used, a signature other than that of its
        kinds, no gradient, NaN
    """
    source = Path(path)
    program = load_program(source)
    description = describe(source, program.metadata, kind)
    first: Kind = next(iter(description.kinds)) if kind is None else kind
    size = check_input(source, program.shape, description.size, DEFAULT_SIZES[first])
    grey = torch.full((1, 3, size, size), _GREY, requires_grad=True)
    normal = Normalize(description)(grey)
    chosen = {one: _outputs(source, program, one, description, normal) for one in description.kinds}
    network = _ByPicture(program, tuple(name for names in chosen.values() for name in names))
    found = network(normal)
    if source.suffix.lower() == ".pt2" and not all(map(torch.equal, found, network(normal))):
        raise InputError(source, "other values for the same picture, expected a program exported in eval mode")
    heads = _heads(source, description, found, chosen)
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


def _heads(path: Path, description: Description, found: tuple[Tensor, ...], chosen: Mapping[Kind, Chosen]) -> Heads:
    """Those of a network that gave `found` for the grey picture.

    :raises InputError: outputs that are not what the kinds ask for
    """
    raw: dict[Kind, tuple[Tensor, ...]] = {}
    rest = found
    for kind, names in chosen.items():
        raw[kind], rest = rest[: len(names)], rest[len(names) :]
    check_features(path, raw, chosen)
    try:
        heads = Heads(description, raw)
        check_ranges(heads(found), description.names)
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
