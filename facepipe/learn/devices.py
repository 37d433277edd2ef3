"""Where torch computes."""

from __future__ import annotations

import torch


def best_device() -> str:
    """``cuda`` where torch has a GPU, otherwise ``cpu``."""
    return "cuda" if torch.cuda.is_available() else "cpu"
