"""Files of pictures that a training reads while others are still being drawn."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

FloatArray = npt.NDArray[np.floating]


class Shards(ABC):
    """What files hold, on the device of a training: arrays of as many rows, pictures (n, S, S, 3) first."""

    def __init__(
        self,
        folder: Path,
        stem: str,
        numbers: Container[int],
        device: str,
        read: Callable[[Path], tuple[npt.NDArray[np.generic], ...]],
    ) -> None:
        """
        :param stem: before the number in names of files
        :param numbers: of the files that are read
        """
        self._folder, self._stem, self._numbers, self._read = folder, stem, numbers, read
        self._known = set[Path]()
        self.device, self.columns = device, tuple[Tensor, ...]()
        self.grow()

    @property
    def images(self) -> Tensor:
        """(n, S, S, 3) uint8."""
        return self.columns[0]

    def grow(self) -> None:
        """Read the files that are new."""
        found = sorted(self._folder.glob(f"{self._stem}_*.npz"))
        paths = [path for path in found if int(path.stem[len(self._stem) + 1 :]) in self._numbers]
        parts = [self._read(path) for path in paths if path not in self._known]
        self._known.update(paths)
        if parts:
            new = tuple(torch.as_tensor(np.concatenate(one), device=self.device) for one in zip(*parts, strict=True))
            old = self.columns or tuple(column[:0] for column in new)
            self.columns = tuple(torch.cat(pair) for pair in zip(old, new, strict=True))

    @abstractmethod
    def batch(self, rows: npt.NDArray[np.integer], rng: np.random.Generator | None) -> tuple[Tensor, Tensor]:
        """Normalised pictures, and what a network shall say of them; varied where there is a generator."""

    def tensor(self, values: FloatArray) -> Tensor:
        """float32 on the device."""
        return torch.as_tensor(values, dtype=torch.float32, device=self.device)


def batches(shards: Shards, size: int, rng: np.random.Generator) -> Iterator[tuple[Tensor, Tensor]]:
    """Varied pictures in random order, without end."""
    while True:
        shards.grow()
        order = rng.permutation(len(shards.images))
        for start in range(0, max(len(order) - size, 0) + 1, size):
            yield shards.batch(order[start : start + size], rng)
