"""How near an inverse comes, and how well targets tell each control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.reports import Report

_RIDGE = 1e-12  # of the trace: what has no answer has a small one
ANYWHERE = 1.0 / np.sqrt(12.0)  # standard deviation of a control that may be anywhere in its range


@dataclass(frozen=True, kw_only=True)
class ControlReport:
    """How well targets tell one control, in the median of the frames."""

    moves_mm: float  # RMS over all points of what it does, over its whole range
    own_share: float  # 0..1 of that which no others together can do
    std: float  # standard error as a share of its range, at most 0.29: it may be anywhere
    identifiable: bool


@dataclass(frozen=True, kw_only=True)
class InverseReport(Report):
    """How near points come to targets, in millimetres over all points and frames, and what it took."""

    mode: str
    frames: int
    error_mean_mm: float
    error_rms_mm: float
    error_p95_mm: float
    error_max_mm: float
    worst_frame: int  # of the largest mean error
    worst_frame_mm: float
    steps: float  # mean of the frames
    seconds: float
    seconds_per_frame: float
    controls: Mapping[str, ControlReport]

    @property
    def not_identifiable(self) -> tuple[str, ...]:
        """Controls that may be anywhere, for all that the targets tell."""
        return tuple(name for name, one in self.controls.items() if not one.identifiable)


def told(names: list[str], matrices: FloatArray, off: FloatArray, outputs: int) -> dict[str, ControlReport]:
    """What is known of controls where points are off by `off` (f,) mm RMS.

    The standard error is that of least squares, what is left being spread evenly over all that the rig can do.

    :param matrices: (f, c, c) mean over the points of products of their derivatives, mm^2
    :param outputs: of the rig
    """
    count = len(names)
    sizes = np.sqrt(np.maximum(np.diagonal(matrices, axis1=1, axis2=2), 0.0))
    ridge = _RIDGE * np.maximum(np.trace(matrices, axis1=1, axis2=2), 1e-30)
    inverse = np.linalg.inv(matrices + ridge[:, None, None] * np.eye(count))
    own = np.minimum(1.0 / np.sqrt(np.diagonal(inverse, axis1=1, axis2=2)), sizes)
    free = np.sqrt(max(outputs - count, 1))
    std = np.minimum(off[:, None] / np.maximum(free * own, 1e-30), ANYWHERE)
    shares = own / np.maximum(sizes, 1e-30)
    rows = zip(*(np.median(one, axis=0).tolist() for one in (sizes, shares, std)), strict=True)
    return {
        name: ControlReport(moves_mm=moves, own_share=share, std=error, identifiable=bool(error < 0.99 * ANYWHERE))
        for name, (moves, share, error) in zip(names, rows, strict=True)
    }
