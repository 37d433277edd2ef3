"""Heat maps: a per-point quantity in colours, and the bar that explains them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.colors import from_srgb

# Eleven sRGB stations of viridis (CC0), a perceptually even map that colour-blind readers can distinguish.
STATIONS = (
    np.array(
        [
            (68, 1, 84), (72, 36, 117), (65, 68, 135), (53, 95, 141), (42, 120, 142), (33, 144, 141),
            (34, 168, 132), (68, 191, 112), (122, 209, 81), (189, 223, 38), (253, 231, 37),
        ]
    )
    / 255.0
)  # fmt: skip
NO_VALUE = (0.55, 0.55, 0.55)  # sRGB grey of points without a value


@dataclass(frozen=True, kw_only=True)
class HeatMap:
    """A quantity to paint on the face.

    :raises InputError: infinite values
    """

    values: FloatArray  # (n,) one per point of all meshes in mesh order; NaN: no value
    label: str = ""
    unit: str = "mm"
    range: tuple[float, float] | None = None  # None: from 0 (or the least, if below) to the largest, rounded outward

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", np.asarray(self.values, dtype=np.float64))
        if np.isinf(self.values).any():
            raise InputError("heat map", "infinite values, expected finite ones or NaN for none")

    @property
    def limits(self) -> tuple[float, float]:
        """The values at the ends of the colour bar."""
        if self.range is not None:
            return self.range
        known = self.values[np.isfinite(self.values)]
        if not len(known):
            return 0.0, 1.0
        low, high = min(0.0, float(known.min())), max(0.0, float(known.max()))
        step = tick_step(low, high) if high > low else 1.0
        bottom = float(np.floor(low / step - 1e-9) * step) if low < 0 else 0.0
        if high <= 0:
            return bottom, 0.0 if low < 0 else 1.0
        # rounded up to half a step, so that the colours are used up to the end
        return bottom, float(np.ceil(high / step * 2 - 1e-9) * step / 2)

    def colors(self, values: FloatArray) -> FloatArray:
        """(m, 3) linear colours of values (m,); outside the range the end colour, NaN grey."""
        low, high = self.limits
        return from_srgb(colors((values - low) / (high - low)))


def colors(shares: FloatArray) -> FloatArray:
    """(m, 3) sRGB colours in 0..1 of shares (m,) of the range; NaN is grey."""
    known = np.isfinite(shares)
    at = np.clip(np.where(known, shares, 0.0), 0.0, 1.0)
    stations = np.linspace(0, 1, len(STATIONS))
    found = np.stack([np.interp(at, stations, STATIONS[:, channel]) for channel in range(3)], axis=1)
    return np.where(known[:, None], found, NO_VALUE)


def tick_step(low: float, high: float) -> float:
    """A step of 1, 2 or 5 times a power of ten that gives about 5 intervals."""
    rough = (high - low) / 5
    power = 10.0 ** np.floor(np.log10(rough))
    return float(power * next(factor for factor in (1, 2, 5, 10) if factor * power >= rough * 0.999))


def ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Values and their texts along the bar."""
    step = tick_step(low, high)
    decimals = max(0, -int(np.floor(np.log10(step))))
    first, last = int(np.ceil(low / step - 1e-6)), int(np.floor(high / step + 1e-6))
    return [(k * step, _number(k * step, decimals)) for k in range(first, last + 1)]


def _number(value: float, decimals: int) -> str:
    if decimals > 4 or abs(value) >= 1e6:
        return f"{value:.3g}"
    return f"{value:.{decimals}f}" if value else "0"
