"""Frames of a rig, written as docs/neural_rig.md shows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pages import blocks
from places import REPOSITORY

from facepipe.neural import Motion

DOCS = (REPOSITORY / "docs/neural_rig.md").read_text(encoding="utf-8")


def docs_bake() -> Callable[..., None]:
    """The writer that docs/neural_rig.md shows."""
    found: dict[str, Any] = {}
    exec(next(block for block in blocks(DOCS, "python") if "def bake" in block), found)
    bake: Callable[..., None] = found["bake"]
    return bake


def bake(motion: Motion, path: Path) -> Path:
    """Each block a clip: frames one time code apart, clips four."""
    own, codes = motion.topology, np.arange(len(motion.values)) + 3.0 * motion.blocks

    def split(points: np.ndarray) -> dict[str, np.ndarray]:
        pieces = np.split(np.ascontiguousarray(points, np.float32), np.cumsum(own.points)[:-1])
        return dict(zip(own.names, pieces, strict=True))

    names = [control.name for control in motion.controls]
    docs_bake()(
        str(path),
        dict(zip(own.names, zip(own.counts, own.indices, strict=True), strict=True)),
        {one.name: (one.minimum, one.maximum, one.default) for one in motion.controls},
        split(motion.rest),
        [
            (code, dict(zip(names, row.tolist(), strict=True)), split(points))
            for code, row, points in zip(codes, motion.values, motion.points, strict=True)
        ],
    )
    return path
