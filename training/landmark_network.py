"""The residual networks behind ``landmarks.onnx``, ``dense_landmarks.onnx`` and ``face_mask.onnx``.

Landmarks are the centres of mass of heatmaps.

He et al., "Deep Residual Learning for Image Recognition", CVPR 2016 (blocks); Lin et al., "Feature Pyramid Networks for
Object Detection", CVPR 2017 (the way back up); Nibali et al., "Numerical Coordinate Regression with Convolutional
Neural Networks", 2018 (coordinates of heatmaps).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from facepipe.rig.torch.graph_writer import Block

SIZE = 96  # pixels a side of the input
CELLS = 24  # a side of a heatmap
COUNT = 68
MEAN, STD = 0.45, 0.25  # of sRGB 0..1


class Pyramid(nn.Module):
    """From pictures down to 1/2, 1/4 and so on of their resolution, and back up to 1/4."""

    def __init__(self, widths: Sequence[int], up: int, *, finest: bool = False) -> None:
        """
        :param widths: channels at 1/2, 1/4 ... of the resolution
        :param up: channels on the way back up
        :param finest: up to 1/2
        """
        super().__init__()
        self.finest = finest
        back = widths if finest else widths[1:]
        self.stem = nn.Conv2d(3, widths[0], 5, 2, 2, bias=False)
        self.stem_norm = nn.BatchNorm2d(widths[0])
        self.stages = nn.ModuleList(nn.Sequential(Block(a, b, 2), Block(b, b)) for a, b in pairwise(widths))
        self.laterals = nn.ModuleList(nn.Conv2d(width, up, 1) for width in back)
        self.ups = nn.ModuleList(Block(up, up) for _ in back[1:])

    def pyramid(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """(b, up, h / 4, w / 4), or of half the size, and what is deepest."""
        values = torch.relu(self.stem_norm(self.stem(images)))
        levels = [values] if self.finest else []
        for stage in self.stages:
            values = stage(values)
            levels.append(values)
        up = self.laterals[-1](values)
        for lateral, block, level in zip(self.laterals[-2::-1], self.ups, levels[-2::-1], strict=True):
            up = block(_double(up) + lateral(level))
        return up, values


class LandmarkNetwork(Pyramid):
    """68 landmarks and presence of crops (b, 3, 96, 96), sRGB less `MEAN` over `STD`."""

    def __init__(self) -> None:
        super().__init__((16, 32, 64, 128), 40)
        self.heat = nn.Conv2d(40, COUNT, 1)
        self.presence = nn.Linear(128, 1)
        self.register_buffer("cells", cell_centers(CELLS))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Landmarks (b, 68, 2) in 0..1 of the crop, presence before the sigmoid (b, 1), heat (b, 68, 576)."""
        up, deep = self.pyramid(images)
        heat = self.heat(up).flatten(2).float()
        landmarks = heat.softmax(dim=2) @ self.cells
        return landmarks, self.presence(deep.mean(dim=(2, 3))), heat


class DenseNetwork(Pyramid):
    """Many landmarks of aligned crops (b, 3, 192, 192), and how far off they may be."""

    SIZE, CELLS, UP = 192, 48, 80

    def __init__(self, count: int) -> None:
        super().__init__((32, 64, 96, 160, 192), self.UP)
        self.heat = nn.Conv2d(self.UP, count, 1)
        self.doubt = nn.Linear(self.UP, 1)
        self.usual = nn.Parameter(torch.zeros(count))
        self.register_buffer("cells", cell_centers(self.CELLS))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Landmarks (b, n, 2) in 0..1 of the crop, and logarithms of half their expected errors in pixels (b, n)."""
        up, _ = self.pyramid(images)
        share = self.heat(up).flatten(2).float().softmax(dim=2)
        there = share @ up.flatten(2).float().mT  # what the network sees at each
        return share @ self.cells, self.doubt(there)[..., 0] + self.usual


class MaskNetwork(Pyramid):
    """What pictures of heads (b, 3, 192, 192) show."""

    SIZE, CELLS = 192, 96
    CLASSES = ("face", "hair", "other")

    def __init__(self) -> None:
        super().__init__((24, 48, 80, 112, 144), 32, finest=True)
        self.classes = nn.Conv2d(32, len(self.CLASSES), 1)

    def forward(self, images: Tensor) -> Tensor:
        """(b, 3, 96, 96) logarithms of the shares of each class, but for their sum."""
        return self.classes(self.pyramid(images)[0]).float()


def cell_centers(cells: int) -> Tensor:
    """(cells^2, 2) x, y of a heatmap's cells in 0..1, row by row."""
    centers = (torch.arange(cells) + 0.5) / cells
    y, x = torch.meshgrid(centers, centers, indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2)


def _double(values: Tensor) -> Tensor:
    return nn.functional.interpolate(values, scale_factor=2.0, mode="nearest")
