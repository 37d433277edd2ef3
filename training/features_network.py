"""The network of the first stage: one residual trunk, and a head for each kind of feature.

He et al., "Deep Residual Learning for Image Recognition", CVPR 2016, for the trunk; the light decoder adds the trunk's
stages back from deep to shallow as in Lin et al., "Feature Pyramid Networks", CVPR 2017.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor, nn
from torch.nn.functional import interpolate, normalize

SIZE = 128  # pixels a side of the input
LABEL_SIZE = SIZE // 2  # pixels a side of the semantic probabilities
CLASSES = (
    "background",
    "face",
    "hair",
    "leftBrow",
    "rightBrow",
    "leftEye",
    "rightEye",
    "nose",
    "upperLip",
    "teeth",
    "lowerLip",
)
CONTENT = ("content0", "content1", "content2", "probabilities")
OUTPUTS = (*CONTENT, "identity", "attributes")
EMBEDDING = 96
MEAN, STD = 0.45, 0.25  # of sRGB 0..1, subtracted and divided by before the network

_WIDTHS = (16, 32, 64, 128)  # channels at 1/2, 1/4, 1/8 and 1/16 of the resolution
_BLOCKS = (1, 1, 2, 2)
_LATERALS = (16, 32, 48, 48)
_GRID = SIZE // 16  # cells a side of the deepest stage


class Raw(NamedTuple):
    """What training works on."""

    content: tuple[Tensor, ...]  # (b, c, h, w), shallow first
    logits: Tensor  # (b, 11, 64, 64)
    embedding: Tensor  # (b, d) of any length
    attributes: Tensor  # (b, a) logits


class Block(nn.Module):
    """Two 3x3 convolutions around a shortcut."""

    def __init__(self, before: int, after: int, stride: int) -> None:
        super().__init__()
        self.first = _normed(before, after, 3, stride)
        self.second = _normed(after, after, 3, 1)
        same = before == after and stride == 1
        self.shortcut = nn.Identity() if same else _normed(before, after, 1, stride)
        self.relu = nn.ReLU()

    def forward(self, values: Tensor) -> Tensor:
        """(b, after, h, w) of (b, before, h, w), halved by a stride of 2."""
        inner = self.second(self.relu(self.first(values)))
        return self.relu(inner + self.shortcut(values))


class FeatureNetwork(nn.Module):
    """Content with semantics, identity and attributes of (b, 3, 128, 128) images."""

    def __init__(self, attributes: int) -> None:
        super().__init__()
        self.stem = nn.Sequential(_normed(3, _WIDTHS[0], 5, 2), nn.ReLU())
        stages, before = [], _WIDTHS[0]
        for depth, (after, count) in enumerate(zip(_WIDTHS, _BLOCKS, strict=True)):
            strides = [2 if depth else 1] + [1] * (count - 1)
            stages.append(nn.Sequential(*(Block(before if not i else after, after, s) for i, s in enumerate(strides))))
            before = after
        self.stages = nn.ModuleList(stages)
        self.laterals = nn.ModuleList(
            nn.Conv2d(width, lateral, 1) for width, lateral in zip(_WIDTHS, _LATERALS, strict=True)
        )
        self.merges = nn.ModuleList(
            nn.Sequential(_normed(deep, shallow, 3, 1), nn.ReLU())
            for deep, shallow in zip(_LATERALS, (_LATERALS[0], *_LATERALS[:-1]), strict=True)
        )
        self.semantics = nn.Conv2d(_LATERALS[0], len(CLASSES), 1)
        self.summary = nn.Sequential(_normed(_WIDTHS[-1], 32, 1, 1), nn.ReLU())
        self.identity = _normed(32, EMBEDDING, _GRID, 1, padding=0)
        self.inner = nn.Sequential(_normed(32, 64, _GRID, 1, padding=0), nn.ReLU())
        self.attributes = nn.Conv2d(64, attributes, 1)

    def decoded(self, image: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """The trunk's stages, shallow first, and what the decoder adds up at the same depths."""
        values, found = self.stem(image), []
        for stage in self.stages:
            values = stage(values)
            found.append(values)
        lateral = [layer(stage) for layer, stage in zip(self.laterals, found, strict=True)]
        merged = [lateral[-1]]
        for depth in range(len(lateral) - 2, -1, -1):
            up = interpolate(self.merges[depth + 1](merged[0]), scale_factor=2.0, mode="bilinear")
            merged.insert(0, up + lateral[depth])
        return found, merged

    def raw(self, image: Tensor) -> Raw:
        """Features before softmax, unit length and sigmoid."""
        found, merged = self.decoded(image)
        summary = self.summary(found[-1])
        return Raw(
            content=tuple(found[:3]),
            logits=self.semantics(self.merges[0](merged[0])),
            embedding=self.identity(summary).flatten(1),
            attributes=self.attributes(self.inner(summary)).flatten(1),
        )

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """What the file gives, in the order of `OUTPUTS`."""
        raw = self.raw(image)
        return (*raw.content, raw.logits.softmax(1), normalize(raw.embedding, dim=1), raw.attributes.sigmoid())


def _normed(before: int, after: int, size: int, stride: int, *, padding: int | None = None) -> nn.Sequential:
    margin = size // 2 if padding is None else padding
    return nn.Sequential(nn.Conv2d(before, after, size, stride, margin, bias=False), nn.BatchNorm2d(after))


def normalised(images: Tensor) -> Tensor:
    """What the network takes of sRGB 0..1."""
    return (images - MEAN) / STD
