"""Whether a network takes and gives what its kind asks for, and the features that its tensors hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import torch
from torch import Tensor, nn

from facepipe.core.errors import InputError
from facepipe.networks.description import CELEBAMASK, CLASSES, Description, Kind, class_matrix

Features: TypeAlias = Tensor | tuple[Tensor, ...]
_SLACK = 1e-3  # of probabilities at their bounds and in their sum


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
            classes = _classes(last.shape[1], description.labels)
            if description.logits is None and not is_probability(last):
                self._scores.add("content")
        self.register_buffer("classes", classes)

    def forward(self, parts: Sequence[Tensor]) -> dict[Kind, Features]:
        """By kind, the tensors `parts` of all kinds one after the other."""
        given: dict[Kind, Features] = {}
        for kind, count in self._counts.items():
            given[kind], parts = self._finished(kind, tuple(parts[:count])), parts[count:]
        return given

    def _finished(self, kind: Kind, parts: tuple[Tensor, ...]) -> Features:
        last = parts[-1]
        if kind in self._scores:
            last = last.softmax(dim=1) if kind == "content" else last.sigmoid()
        if kind == "content" and self.classes is not None:
            last = torch.einsum("kc,bchw->bkhw", self.classes, last)
        return (*parts[:-1], last) if kind in ("content", "landmarks") else last


def _classes(channels: int, named: Sequence[str]) -> Tensor | None:
    """(11, channels) which channel is what class; None where they are the eleven in their order."""
    labels = named or {len(CLASSES): CLASSES, len(CELEBAMASK): CELEBAMASK}.get(channels, ())
    if len(labels) != channels:
        expected = f"{len(labels)} as its labels say" if labels else f"{len(CLASSES)}, or labels that name each class"
        raise InputError("content", f"last output of {channels} channels, expected {expected}")
    return None if tuple(labels) == CLASSES else torch.as_tensor(class_matrix(labels), dtype=torch.float32)


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
            _check_value(where, value)
            _check_shape(where, kind, place, value)


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


def _check_value(where: str, value: Tensor) -> None:
    if not isinstance(value, Tensor) or value.dtype != torch.float32:
        raise InputError(where, f"of type {getattr(value, 'dtype', type(value).__name__)}, expected float32")
    if not torch.isfinite(value).all():
        raise InputError(where, "NaN or infinity for a grey picture, expected finite numbers")
    if not value.requires_grad:
        raise InputError(where, "has no gradient in the picture, expected a differentiable output")


def _check_shape(where: str, kind: Kind, place: int, value: Tensor) -> None:
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


def _within(value: Tensor) -> bool:
    return bool(value.min() >= -_SLACK and value.max() <= 1 + _SLACK)
