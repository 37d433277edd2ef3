"""The residual network that guesses a person's sliders, the expression and the pose from an aligned crop ([0184]).

He et al., "Deep Residual Learning for Image Recognition", CVPR 2016 (blocks). The places of the landmarks, by which the
crop was made, come in beside the picture.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from facepipe.geometry.face_crops import TEMPLATE
from facepipe.photo.descent.subject import NUMBERS
from facepipe.rig.torch.graph_writer import Block
from facepipe.rig.torch.one_thread import short_floats

SIZE = 128  # pixels a side of the crop
COUNT = 68
MEAN, STD = 0.45, 0.25  # of sRGB 0..1
SPREAD = 0.03  # of landmarks around the template, in sides of the crop
WIDTHS = (16, 32, 64, 96)  # at 1/2, 1/4, 1/8 and 1/16 of the resolution
CELLS = SIZE // 16
SQUEEZED, HIDDEN = 16, 256


class Output(NamedTuple):
    """Guesses of b crops, before sliders and expressions are cut to 0..1."""

    shares: Tensor  # (b, f) of the free sliders' ranges
    expressions: Tensor  # (b, e)
    pose: Tensor  # (b, 7) as `CropSpace`, in standard deviations from the mean


class StartNetwork(nn.Module):  # type: ignore[misc]
    """Crops (b, 3, 128, 128), sRGB less `MEAN` over `STD`, and landmarks (b, 68, 2) in sides of the crop to guesses."""

    def __init__(self, default_shares: Tensor, expressions: int) -> None:
        super().__init__()
        sliders = len(default_shares)
        self.counts = (sliders, expressions, NUMBERS)
        self.stem = nn.Conv2d(3, WIDTHS[0], 5, 2, 2, bias=False)
        self.stem_norm = nn.BatchNorm2d(WIDTHS[0])
        self.blocks = nn.Sequential(
            Block(WIDTHS[0], WIDTHS[1], 2),
            Block(WIDTHS[1], WIDTHS[2], 2),
            Block(WIDTHS[2], WIDTHS[2]),
            Block(WIDTHS[2], WIDTHS[3], 2),
            Block(WIDTHS[3], WIDTHS[3]),
        )
        self.squeeze = nn.Conv2d(WIDTHS[3], SQUEEZED, 1)
        self.seen = nn.Linear(SQUEEZED * CELLS * CELLS, HIDDEN)
        self.placed = nn.Linear(2 * COUNT, HIDDEN)
        self.placed_last = nn.Linear(HIDDEN, HIDDEN)
        self.middle = nn.Linear(2 * HIDDEN, HIDDEN)
        self.last = nn.Linear(HIDDEN, sum(self.counts))
        self.straight = nn.Linear(2 * COUNT, sum(self.counts), bias=False)
        self.register_buffer("template", torch.as_tensor(TEMPLATE, dtype=torch.float32))
        with torch.no_grad():  # untrained, it guesses the defaults
            for layer in (self.last, self.straight):
                layer.weight.zero_()
            self.last.bias.zero_()
            self.last.bias[:sliders] = default_shares

    def forward(self, images: Tensor | None, landmarks: Tensor) -> Output:
        """The guesses; without images those by the landmarks alone."""
        if images is None:
            picture = landmarks.new_zeros((len(landmarks), HIDDEN))
        else:
            with short_floats(self.training):  # twice as fast
                values = self.blocks(torch.relu(self.stem_norm(self.stem(images))))
                values = torch.relu(self.squeeze(values))
            picture = torch.relu(self.seen(values.float().flatten(1)))
        places = ((landmarks - self.template) / SPREAD).flatten(1)
        marks = torch.relu(self.placed_last(torch.relu(self.placed(places))))
        inner = torch.relu(self.middle(torch.cat([picture, marks], dim=1)))
        return Output(*(self.last(inner) + self.straight(places)).split(self.counts, dim=1))


def held(values: Tensor) -> Tensor:
    """Cut to 0..1, with gradients as if they were not: what was pushed out comes back."""
    return values + (values.clamp(0, 1) - values).detach()
