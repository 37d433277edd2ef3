"""The residual network behind ``landmarks.onnx``: heatmaps whose centres of mass are the landmarks.

He et al., "Deep Residual Learning for Image Recognition", CVPR 2016 (blocks); Lin et al., "Feature Pyramid Networks for
Object Detection", CVPR 2017 (the way back up); Nibali et al., "Numerical Coordinate Regression with Convolutional
Neural Networks", 2018 (coordinates of heatmaps).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from facepipe.learn.networks.graph_writer import Block

SIZE = 96  # pixels a side of the input
CELLS = 24  # a side of a heatmap
COUNT = 68
MEAN, STD = 0.45, 0.25  # of sRGB 0..1
_WIDTHS = (16, 32, 64, 128)  # at 1/2, 1/4, 1/8 and 1/16 of the resolution
_UP = 40


class LandmarkNetwork(nn.Module):  # type: ignore[misc]
    """68 landmarks and presence of crops (b, 3, 96, 96), sRGB less `MEAN` over `STD`."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3, _WIDTHS[0], 5, 2, 2, bias=False)
        self.stem_norm = nn.BatchNorm2d(_WIDTHS[0])
        self.quarter = nn.Sequential(Block(_WIDTHS[0], _WIDTHS[1], 2), Block(_WIDTHS[1], _WIDTHS[1]))
        self.eighth = nn.Sequential(Block(_WIDTHS[1], _WIDTHS[2], 2), Block(_WIDTHS[2], _WIDTHS[2]))
        self.sixteenth = nn.Sequential(Block(_WIDTHS[2], _WIDTHS[3], 2), Block(_WIDTHS[3], _WIDTHS[3]))
        self.laterals = nn.ModuleList(nn.Conv2d(width, _UP, 1) for width in _WIDTHS[1:])
        self.up_eighth, self.up_quarter = Block(_UP, _UP), Block(_UP, _UP)
        self.heat = nn.Conv2d(_UP, COUNT, 1)
        self.presence = nn.Linear(_WIDTHS[3], 1)
        self.register_buffer("cells", cell_centers())

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Landmarks (b, 68, 2) in 0..1 of the crop, presence before the sigmoid (b, 1), heat (b, 68, 576)."""
        values = torch.relu(self.stem_norm(self.stem(images)))
        quarter = self.quarter(values)
        eighth = self.eighth(quarter)
        deep = self.sixteenth(eighth)
        up = self.up_eighth(_double(self.laterals[2](deep)) + self.laterals[1](eighth))
        up = self.up_quarter(_double(up) + self.laterals[0](quarter))
        heat = self.heat(up).flatten(2).float()
        landmarks = heat.softmax(dim=2) @ self.cells
        return landmarks, self.presence(deep.mean(dim=(2, 3))), heat


def cell_centers() -> Tensor:
    """(576, 2) x, y of the heatmaps' cells in 0..1, row by row."""
    centers = (torch.arange(CELLS) + 0.5) / CELLS
    y, x = torch.meshgrid(centers, centers, indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2)


def _double(values: Tensor) -> Tensor:
    return nn.functional.interpolate(values, scale_factor=2.0, mode="nearest")
