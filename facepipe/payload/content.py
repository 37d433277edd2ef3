"""What a payload of bone coefficients holds, as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from facepipe.core.arrays import FloatArray

Precision = Literal["float16", "float32"]


@dataclass(frozen=True, kw_only=True)
class PayloadContent:
    """Bone coefficients of one pose, of several, or of a clip."""

    joints: tuple[str, ...]  # m paths, in skeleton order
    coefficients: FloatArray  # (m, 9), or (T, m, 9): t (stage units), r (radians), s, relative to rest
    times: FloatArray | None = None  # (T,) seconds, ascending: a clip; None: poses
    meters_per_unit: float  # of the stage that translations are in
    precision: Precision = "float32"

    @property
    def frames(self) -> FloatArray:
        """(T, m, 9) coefficients; T = 1 for a single pose."""
        array = np.asarray(self.coefficients, dtype=np.float64)
        return array if array.ndim == 3 else array[None]


@dataclass(frozen=True, kw_only=True)
class Encoded:
    """A payload, and the largest errors that rounding to its precision made."""

    data: bytes
    stored: int  # joints in it
    translation_error: float  # stage units
    rotation_error: float  # radians
    scale_error: float  # factor
