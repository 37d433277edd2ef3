"""The network of the second stage: what it says of a person, it reads off landmarks that it finds itself.

Shapes of heads differ by fractions of a pixel here, which the deep features of the first stage are too coarse for.
Landmarks are the mean places of heat maps (Sun et al., "Integral Human Pose Regression", ECCV 2018).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from features_network import LABEL_SIZE, FeatureNetwork
from onnx import numpy_helper
from torch import Tensor, nn
from torch.nn.functional import normalize

from facepipe.geometry.face_crops import TEMPLATE

SHAPE_MODES = 64
_CELLS = LABEL_SIZE // 2  # a side of the heat maps
_SPREAD = 0.05  # of landmarks, -1..1 of the crop


class MarkedRaw(NamedTuple):
    """What training works on."""

    content: tuple[Tensor, ...]  # (b, c, h, w), shallow first
    logits: Tensor  # (b, 11, 64, 64)
    marks: Tensor  # (b, 68, 2), -1..1 of the picture
    embedding: Tensor  # (b, 64) the neutral's modes, in deviations
    attributes: Tensor  # (b, a) logits


class Reader(nn.Module):
    """A person's neutral and sliders of 68 landmarks."""

    def __init__(self, attributes: int) -> None:
        super().__init__()
        self.register_buffer("center", torch.as_tensor(2 * TEMPLATE - 1, dtype=torch.float32))
        self.register_buffer("steepness", torch.tensor(1 / _SPREAD))
        self.hidden = nn.Sequential(nn.Linear(136, 320), nn.ReLU(), nn.Linear(320, 320), nn.ReLU())
        self.embedding = nn.Linear(320, SHAPE_MODES)
        self.attributes = nn.Linear(320, attributes)

    def forward(self, marks: Tensor) -> tuple[Tensor, Tensor]:
        """The neutral's modes (b, 64), in deviations, and logits of attributes (b, a)."""
        hidden = self.hidden(((marks - self.center) * self.steepness).flatten(1))
        return self.embedding(hidden), self.attributes(hidden)


class MarkedNetwork(FeatureNetwork):
    """Content and semantics as in the first stage, without normalisation; landmarks; what a `Reader` makes of them."""

    def __init__(self, reader: Reader) -> None:
        super().__init__(1)
        del self.summary, self.identity, self.inner, self.attributes
        for pair in [module for module in self.modules() if isinstance(module, nn.Sequential)]:
            if isinstance(pair[-1], nn.BatchNorm2d):
                _fold(pair)
        self.heat = nn.Sequential(nn.Conv2d(32, 64, 3, 1, 1), nn.ReLU(), nn.Conv2d(64, 68, 1))
        self.reader = reader
        centers = (torch.arange(_CELLS) + 0.5) * 2 / _CELLS - 1
        grid = torch.stack(torch.meshgrid(centers, centers, indexing="xy"), dim=-1)
        self.register_buffer("cells", grid.reshape(-1, 2))

    def raw(self, image: Tensor) -> MarkedRaw:  # type: ignore[override]
        """Features before softmax, unit length and sigmoid."""
        found, merged = self.decoded(image)
        marks = self.heat(merged[1]).flatten(2).softmax(2) @ self.cells
        logits = self.semantics(self.merges[0](merged[0]))
        return MarkedRaw(tuple(found[:3]), logits, marks, *self.reader(marks))

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """What the file gives, in the order of `OUTPUTS`."""
        raw = self.raw(image)
        return (*raw.content, raw.logits.softmax(1), normalize(raw.embedding, dim=1), raw.attributes.sigmoid())


def _fold(pair: nn.Sequential) -> None:
    conv = pair[0]
    pair[0] = nn.Conv2d(conv.in_channels, conv.out_channels, conv.kernel_size, conv.stride, conv.padding)
    pair[1] = nn.Identity()


def take_trunk(network: MarkedNetwork, model: Any) -> None:
    """Weights of the trunk and the decoder from the first stage's ONNX model."""
    stored = {one.name: numpy_helper.to_array(one) for one in model.graph.initializer}
    for path, module in network.named_modules():
        if not isinstance(module, nn.Conv2d) or path.startswith("heat"):
            continue
        name = path.replace(".", "_")
        with torch.no_grad():
            module.weight.copy_(torch.as_tensor(np.array(stored[f"{name}.weight"])))
            module.bias.copy_(torch.as_tensor(np.array(stored[f"{name}.bias"])))
