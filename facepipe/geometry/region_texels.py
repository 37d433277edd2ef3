"""What the texels of a painted region map say: a region, a mix of regions, nothing, or a colour nobody knows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import BoolArray, FloatArray, IntArray

Image8 = npt.NDArray[np.uint8]

UNKNOWN = -1
_OPAQUE = 128  # alpha from here on: painted
_SUM_WEIGHT = 1e4  # how much heavier than a colour level the sum of a mix weighs


class TexelShares(NamedTuple):
    """Of m texels: their shares (m, k) of the k colours, rows of sum 1 or all 0 (unpainted), and the unknown (m,)."""

    shares: FloatArray
    unknown: BoolArray


@dataclass(frozen=True, kw_only=True)
class Palette:
    """The colours of a map and how loosely they are meant."""

    colors: Image8  # (k, 3), all different
    background: Image8 | None = None  # (3,) colour of unpainted texels, beside transparent ones
    tolerance: float  # distance in RGB, 0..255 a channel
    edge: int  # texels over which a painted border may run

    @cached_property
    def known(self) -> FloatArray:
        """(k or k + 1, 3) the colours, then the background."""
        rows = [self.colors.reshape(-1, 3), *([] if self.background is None else [self.background.reshape(1, 3)])]
        return np.concatenate(rows).astype(np.float64)

    def labels(self, texels: Image8) -> tuple[IntArray, BoolArray]:
        """Of (m, 3|4) texels: the nearest colour within the tolerance, k for unpainted or UNKNOWN; which are exact."""
        packed = texels.astype(np.uint32) @ (1 << 8 * np.arange(texels.shape[1], dtype=np.uint32))
        _, first, back = np.unique(packed, return_index=True, return_inverse=True)
        values = texels[first]
        distance = np.linalg.norm(values[:, None, :3].astype(np.float64) - self.known, axis=2)
        label, least = distance.argmin(axis=1), distance.min(axis=1)
        label[least > self.tolerance] = UNKNOWN
        if texels.shape[1] == 4:
            label[values[:, 3] < _OPAQUE] = len(self.colors)
            least[values[:, 3] < _OPAQUE] = 0.0
        return label[back.ravel()], (least == 0)[back.ravel()]


def texel_shares(image: Image8, texels: IntArray, palette: Palette) -> TexelShares:
    """What some texels of `image` (h, w, 3|4) say.

    A colour of the palette is that one. Another is the nearest within the tolerance; but where that one is not found
    at most `edge` texels away, and a mix of those that are is within the tolerance, it is the mix, as antialiasing
    makes it, and counts by its shares: so a border is not taken for a region whose colour lies between. A colour that
    is neither near one of the palette nor a mix is unknown. An unpainted texel takes the nearest painted ones at most
    `edge` texels away: maps often end where the UV island ends.

    :param texels: (m,) numbers ``row * w + column``
    """
    pixels, count = image.reshape(-1, image.shape[2]), len(palette.colors)
    label, exact = palette.labels(pixels[texels])
    shares = np.where(label[:, None] == UNKNOWN, 0.0, np.eye(count + 1)[label])
    unsure = np.flatnonzero(~exact | (label == count))
    if len(unsure) and palette.edge:
        around, distance = _neighbours(image.shape, texels[unsure], palette.edge)
        distinct, back = np.unique(around, return_inverse=True)
        labels, pure = palette.labels(pixels[distinct])
        near, sure = labels[back.reshape(around.shape)], pure[back.reshape(around.shape)]
        shares[unsure] = _settled(pixels[texels[unsure], :3], label[unsure], exact[unsure], near, sure, palette)
        bare = shares[unsure, count] >= 1
        shares[unsure[bare], :count] = _nearest(near[bare], distance[bare], count)
    unknown = shares.sum(axis=1) <= 0
    painted = shares[:, :count]
    total = painted.sum(axis=1, keepdims=True)
    return TexelShares(np.divide(painted, total, out=np.zeros_like(painted), where=total > 0), unknown)


def _settled(
    colors: Image8, label: IntArray, exact: BoolArray, near: IntArray, sure: BoolArray, palette: Palette
) -> FloatArray:
    """Shares (m, k + 1) of the palette's colours and the unpainted; rows of 0 are unknown.

    :param label: (m,) as `Palette.labels` gives it, and `exact` (m,)
    :param near: (m, s) labels around, and which are exact: `sure` (m, s)
    """
    known = label != UNKNOWN
    shares = np.where(known[:, None], np.eye(len(palette.colors) + 1)[label], 0.0)
    seen = ((near == label[:, None]) & sure).any(axis=1) & known
    for choice in (np.where(sure, near, UNKNOWN), near):  # pure colours around, then those about right
        open_ = np.flatnonzero(~exact & ~seen)
        mixed = _mixes(colors[open_], choice[open_], palette)
        found = mixed.any(axis=1)
        shares[open_[found]] = mixed[found]
        seen[open_[found]] = True
        seen |= known  # the nearest colour goes before a mix of what is only about right
    return shares


def _neighbours(shape: tuple[int, ...], texels: IntArray, edge: int) -> tuple[IntArray, IntArray]:
    """Texels (m, s) of the square of 2 edge + 1 around each, clamped to the image, and squared distances (m, s)."""
    height, width = shape[:2]
    row, column = np.divmod(texels, width)
    down, right = (one.ravel() for one in np.mgrid[-edge : edge + 1, -edge : edge + 1])
    rows = np.clip(row[:, None] + down, 0, height - 1)
    columns = np.clip(column[:, None] + right, 0, width - 1)
    squared = (rows - row[:, None]) ** 2 + (columns - column[:, None]) ** 2
    return rows * width + columns, squared


def _mixes(colors: Image8, near: IntArray, palette: Palette) -> FloatArray:
    """Shares (m, k + 1) of the palette's colours and the background in `colors` (m, 3); rows of 0 are no mix.

    :param near: (m, s) labels around each; only these colours can be mixed
    """
    rows = len(palette.known)
    around = np.stack([(near == number).any(axis=1) for number in range(rows)], axis=1)
    cases, back = np.unique(np.column_stack([colors, around]), axis=0, return_inverse=True)
    found = np.zeros((len(cases), len(palette.colors) + 1))
    for number, case in enumerate(cases):
        found[number, :rows] = _mix(case[:3], np.flatnonzero(case[3:]), palette)
    return found[back.ravel()]


def _mix(color: Image8, choice: IntArray, palette: Palette) -> FloatArray:
    """Shares of the palette's rows `choice` in one colour; 0 where their nearest mix is beyond the tolerance."""
    from scipy.optimize import nnls

    shares = np.zeros(len(palette.known))
    if not len(choice):
        return shares
    known = palette.known[choice]
    system = np.vstack([known.T, np.full(len(choice), _SUM_WEIGHT)])
    parts, _ = nnls(system, np.append(color.astype(np.float64), _SUM_WEIGHT))
    if np.linalg.norm(parts @ known - color) <= palette.tolerance:
        shares[choice] = parts
    return shares


def _nearest(near: IntArray, squared: IntArray, count: int) -> FloatArray:
    """(m, k) mean of the painted labels (m, s) at the least distance; rows of 0 where none is painted."""
    far = np.iinfo(np.int64).max
    distance = np.where((near >= 0) & (near < count), squared, far)
    least = distance.min(axis=1, keepdims=True)
    closest = (distance == least) & (least < far)
    shares = np.stack([(closest & (near == number)).sum(axis=1) for number in range(count)], axis=1).astype(np.float64)
    return np.asarray(shares / np.maximum(shares.sum(axis=1, keepdims=True), 1.0))
