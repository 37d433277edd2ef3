"""From the tensors that a network gives to the features of its kinds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import torch
from torch import Tensor, nn

from facepipe.core.errors import InputError
from facepipe.learn.features.description import Description, Kind
from facepipe.learn.features.semantics import CELEBAMASK, CLASSES, class_matrix
from facepipe.learn.features.signatures import is_probability

Features: TypeAlias = Tensor | tuple[Tensor, ...]


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
