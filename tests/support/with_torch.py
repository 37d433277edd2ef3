"""torch for tests, of files and functions that are marked `needs_torch`."""

from __future__ import annotations

import numpy as np
import torch

torch.set_num_threads(1)  # tests run side by side, one on each core


def tensor(values: object, **options: object) -> torch.Tensor:
    """A float64 tensor."""
    return torch.tensor(np.asarray(values, dtype=np.float64), **options)
