"""What skinning a face did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.reports import Report
from facepipe.processors.skin.surface import Surface


@dataclass(frozen=True, kw_only=True)
class FitReport:
    """How well skinning alone reproduces the face's shapes, over all points that any of them moves, in millimetres."""

    shapes: int
    points: int
    rms_before_mm: float  # weights as made, transforms fitted
    rms_after_mm: float
    max_before_mm: float
    max_after_mm: float


@dataclass(frozen=True, kw_only=True)
class TransferReport:
    """How the skeleton came over."""

    source: str
    same_topology: bool  # every point has the weights of its own
    landmarks_mm: float  # largest distance of a warped landmark from this face's
    surface_mm: Mapping[
        str, float
    ]  # mean, RMS, p95, max: main part from the warped source, of one topology from the points
    eyeballs: int  # paired, and used as landmarks
    parts: Mapping[str, tuple[str, ...]]  # mesh of loose parts -> meshes of the source that they took weights from


@dataclass(frozen=True, kw_only=True)
class SkinReport(Report):
    """What was authored."""

    joints: int
    influences: int  # most that a point has
    meshes: Mapping[str, int]  # mesh -> most influences of its points
    weightless: tuple[str, ...]  # joints that move no point
    rigid: Mapping[str, str] = field(default_factory=dict)  # mesh that one joint moves whole -> joint
    largest_step: float  # largest difference of a weight between the two ends of an edge
    largest_step_per_mm: float  # the same over the length of the edge, edges below 1 mm counted as 1 mm
    transfer: TransferReport | None = None
    fit: FitReport | None = None


def steps(surface: Surface, weights: FloatArray) -> tuple[float, float]:
    """Largest difference of weights (m, j) over an edge, and over an edge's length in millimetres."""
    if not len(surface.edges):
        return 0.0, 0.0
    a, b = surface.edges.T
    change = np.abs(weights[a] - weights[b]).max(axis=1)
    length = np.linalg.norm(surface.points[a] - surface.points[b], axis=1)
    return float(change.max()), float((change / np.maximum(length, 1.0)).max())
