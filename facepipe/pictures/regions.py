"""Regions in colours: one each, mixed by the soft masks, and the legend that names them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.colors import from_srgb
from facepipe.parts import FaceParts, all_regions
from facepipe.pictures.heatmap import NO_VALUE
from facepipe.pictures.overlay import INK, font, text_size

if TYPE_CHECKING:
    from PIL.Image import Image


# sRGB: the colours of Okabe and Ito but black, made for colour-blind readers; then each time the one that, in OKLab, is
# farthest from those before and from NO_VALUE as full, deutan and protan sight see them.
PALETTE = (
    np.array(
        [
            (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (0, 114, 178), (213, 94, 0),
            (204, 121, 167), (119, 0, 34), (119, 255, 255), (68, 34, 136), (0, 0, 255), (119, 85, 102),
        ]
    )
    / 255.0
)  # fmt: skip
NONE = "no region"


@dataclass(frozen=True, kw_only=True)
class RegionColors:
    """Regions to paint on the face, the first one in the first colour of `PALETTE`.

    :raises InputError: no regions, or negative values
    """

    masks: dict[str, FloatArray] = field(repr=False)  # region -> (n,) mask over the points of all meshes in mesh order

    def __post_init__(self) -> None:
        if not self.masks:
            raise InputError("regions", "none on the face, expected some to draw")
        for name, mask in self.masks.items():
            if np.min(mask, initial=0.0) < 0:
                raise InputError(f"regions -> {name}", "negative values, expected 0 to 1")

    @classmethod
    def from_parts(cls, parts: FaceParts) -> RegionColors:
        """All regions of a face, by name.

        :raises InputError: it has none
        """
        return cls(masks=all_regions(parts.meshes))

    @property
    def table(self) -> FloatArray:
        """(n, k) masks."""
        return np.stack([np.asarray(mask, dtype=np.float64) for mask in self.masks.values()], axis=1)

    @property
    def entries(self) -> list[tuple[str, FloatArray]]:
        """Names and sRGB colours for the legend; grey for points without region, where there are any."""
        colors = region_colors(len(self.masks))
        bare = (self.table.sum(axis=1) <= 0).any()
        return [*zip(self.masks, colors, strict=True), *([(NONE, np.array(NO_VALUE))] if bare else [])]

    @property
    def colors(self) -> FloatArray:
        """(n, 3) linear colours of the points."""
        table = self.table
        total = table.sum(axis=1, keepdims=True)
        mixed = (table / np.where(total > 0, total, 1.0)) @ from_srgb(region_colors(len(self.masks)))
        return np.where(total > 0, mixed, from_srgb(np.array(NO_VALUE)))


def region_colors(count: int) -> FloatArray:
    """(count, 3) sRGB colours in 0..1; beyond the palette darker and lighter rounds of it."""
    rounds, place = np.divmod(np.arange(count), len(PALETTE))
    depth = (rounds + 1) // 2  # 0, 1, 1, 2, 2 ...
    target = np.where(rounds % 2 == 1, 0.0, 1.0)[:, None]
    share = (1 - 0.6**depth)[:, None]
    return np.asarray(PALETTE[place] * (1 - share) + target * share)


def legend_width(regions: RegionColors, size: int) -> int:
    """Pixels at the right that the legend takes: at most two fifths of the picture."""
    letters = _letters(regions, size)
    widest = max(font(letters).getlength(name) for name, _ in regions.entries)
    return round(min(widest + letters * 3.4, size * 0.4))


def draw_legend(image: Image, regions: RegionColors) -> None:
    """Swatches with names at the right side; what finds no room is counted below."""
    from PIL import ImageDraw

    size, entries = image.width, regions.entries
    letters = _letters(regions, size)
    step, room = letters * 1.7, int(size * 0.92 / (letters * 1.7))
    shown = entries if len(entries) <= room else entries[: room - 1]
    left, right = size - legend_width(regions, size) + letters * 0.6, size - letters * 0.5
    top = (size - step * (len(shown) + (len(shown) < len(entries)))) / 2
    pen, line = ImageDraw.Draw(image), max(1, round(letters / 14))
    for number, (name, color) in enumerate(shown):
        y = top + step * (number + 0.5)
        box = (round(left), round(y - letters * 0.5), round(left + letters), round(y + letters * 0.5))
        pen.rectangle(box, fill=tuple(int(value) for value in color * 255 + 0.5), outline=INK, width=line)
        at = left + letters * 1.6
        pen.text((at, y), _shortened(name, letters, right - at), fill=INK, font=font(letters), anchor="lm")
    if len(shown) < len(entries):
        text = f"and {len(entries) - len(shown)} more"
        pen.text((left, top + step * (len(shown) + 0.5)), text, fill=INK, font=font(letters), anchor="lm")


def _letters(regions: RegionColors, size: int) -> float:
    """Height of the letters that lets all names stand below each other, or the least that can be read."""
    return max(8.0, min(text_size(size), size * 0.92 / 1.7 / len(regions.entries)))


def _shortened(name: str, letters: float, room: float) -> str:
    if font(letters).getlength(name) <= room:
        return name
    while name and font(letters).getlength(f"{name}...") > room:
        name = name[:-1]
    return f"{name}..."
