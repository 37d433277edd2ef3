"""What landmarks show of a person, learned from landmarks of many heads (`features_geometry.py`) without pictures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from features_augment import beside, seen_beside
from features_losses import attribute_loss
from features_marked import SHAPE_MODES, Reader
from torch import Tensor

BATCH, STEPS, RATE = 512, 6000, 2e-3
_NOISE = 0.02  # deviation of landmarks that a network finds, -1..1 of the crop


@dataclass(frozen=True)
class Modes:
    """Principal modes of neutrals."""

    mean: Tensor  # (204,)
    axes: Tensor  # (204, 64), in deviations

    @classmethod
    def from_shapes(cls, shapes: Tensor) -> Modes:
        """Of neutrals (n, 204)."""
        mean = shapes.mean(0)
        _, values, axes = torch.linalg.svd((shapes - mean).double(), full_matrices=False)
        deviations = values[:SHAPE_MODES] / len(shapes) ** 0.5
        return cls(mean, (axes[:SHAPE_MODES] / deviations[:, None]).T.float())

    def __call__(self, shapes: Tensor) -> Tensor:
        """(n, 64) the modes of neutrals (n, 204), in deviations; NaN stays."""
        return (shapes - self.mean) @ self.axes


def read_off(path: Path, kept: tuple[str, ...], seed: int) -> tuple[Reader, Modes]:
    """A reader trained on the landmarks in a file, for the attributes `kept`."""
    with np.load(path) as data:
        columns = [data["names"].tolist().index(name) for name in kept]
        marks = torch.as_tensor(data["marks"]) * 2 - 1
        shapes, attributes = torch.as_tensor(data["shapes"]), torch.as_tensor(data["attributes"][:, columns])
    modes = Modes.from_shapes(shapes[::2])
    targets = modes(shapes)
    reader, random = Reader(len(kept)), torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(reader.parameters(), lr=RATE, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=STEPS, pct_start=0.1)
    for _ in range(STEPS):
        rows = torch.randint(len(marks), (BATCH,), generator=random)
        moved = seen_beside(marks[rows], beside(BATCH, random))
        strength = _NOISE * torch.rand(BATCH, 1, 1, generator=random)
        found, logits = reader(moved + strength * torch.randn(moved.shape, generator=random))
        loss = (found - targets[rows]).square().mean() + attribute_loss(logits, attributes[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return reader, modes
