"""Heat maps and regions to paint on a face, and what is written over and below pictures: bar, legend, captions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.geometry.colors import from_srgb
from facepipe.geometry.rasterise import rasterise, screen_triangles
from facepipe.parts import FaceParts, all_regions
from facepipe.pictures.camera import Camera
from facepipe.pictures.scene import Scene

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageFont import FreeTypeFont, ImageFont

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
PAPER = (250, 250, 251)
INK = (38, 40, 46)
DOT = (226, 40, 52)
HIDDEN = 0.35  # opacity of landmarks behind the surface
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
    return [
        (value, f"{value:.3g}" if not value or decimals > 4 or abs(value) >= 1e6 else f"{value:.{decimals}f}")
        for value in (k * step for k in range(first, last + 1))
    ]


def contact_sheet(images: Sequence[tuple[str, Image]], columns: int) -> Image:
    """The pictures (one at least) row by row, `columns` to a row, captions below; cells as large as the largest."""
    from PIL import Image as Images
    from PIL import ImageDraw

    columns = min(columns, len(images))
    width, height = max(image.width for _, image in images), max(image.height for _, image in images)
    gap, letters = max(2, width // 40), max(9.0, width / 18)
    strip = round(letters * 1.7)
    rows = -(-len(images) // columns)
    sheet = Images.new("RGB", (columns * (width + gap) + gap, rows * (height + strip + gap) + gap), PAPER)
    pen = ImageDraw.Draw(sheet)
    for number, (caption, image) in enumerate(images):
        row, column = divmod(number, columns)
        left, top = gap + column * (width + gap), gap + row * (height + strip + gap)
        sheet.paste(image.convert("RGB"), (left + (width - image.width) // 2, top + (height - image.height) // 2))
        middle = left + width / 2, top + height + strip / 2
        pen.text(middle, caption, fill=INK, font=fitting_font(caption, letters, width), anchor="mm")
    return sheet


def font(pixels: float) -> FreeTypeFont | ImageFont:
    """Pillow's own scalable font."""
    from PIL import ImageFont

    return ImageFont.load_default(size=max(8.0, pixels))


def fitting_font(text: str, pixels: float, room: float) -> FreeTypeFont | ImageFont:
    """The font at `pixels`, or as much smaller (down to 8) as `text` needs to be no wider than `room`."""
    width = font(pixels).getlength(text)
    return font(pixels if width <= room else pixels * room / width)


def text_size(size: int) -> float:
    """Height of the letters in a picture of `size` pixels."""
    return max(9.0, size / 42)


def bar_width(size: int) -> int:
    """Pixels at the right that the colour bar takes."""
    return round(text_size(size) * 5.2)


def color_bar(image: Image, heatmap: HeatMap) -> None:
    """Draw the colours of a heat map with ticks at the right side; its label runs along the bar."""
    from PIL import Image as Images
    from PIL import ImageDraw

    size, letters = image.width, text_size(image.width)
    left, right = round(size - letters * 4.6), round(size - letters * 3.6)
    top, bottom = round(size * 0.14), round(size * 0.86)
    low, high = heatmap.limits
    shares = 1 - (np.arange(bottom - top) + 0.5) / (bottom - top)
    column = (colors(shares) * 255 + 0.5).astype(np.uint8)
    image.paste(Images.fromarray(np.repeat(column[:, None], right - left, axis=1)), (left, top))
    pen, line = ImageDraw.Draw(image), max(1, round(letters / 14))
    pen.rectangle((left - line, top - line, right + line - 1, bottom + line - 1), outline=INK, width=line)
    for value, text in ticks(low, high):
        y = bottom - (value - low) / (high - low) * (bottom - top)
        pen.line((right, y, right + letters * 0.35, y), fill=INK, width=line)
        pen.text((right + letters * 0.6, y), text, fill=INK, font=font(letters), anchor="lm")
    pen.text(((left + right) / 2, top - letters * 0.9), heatmap.unit, fill=INK, font=font(letters), anchor="mm")
    if heatmap.label:
        label_font = fitting_font(heatmap.label, letters, bottom - top)
        x0, y0, x1, y1 = label_font.getbbox(heatmap.label)
        mask = Images.new("L", (int(x1 - x0) + 2, int(y1 - y0) + 2), 0)
        ImageDraw.Draw(mask).text((1 - x0, 1 - y0), heatmap.label, fill=255, font=label_font)
        turned = mask.transpose(Images.Transpose.ROTATE_90)  # reads upwards, its foot beside the bar
        place = round(left - letters * 0.5 - turned.width), round((top + bottom) / 2 - turned.height / 2)
        image.paste(Images.new("RGB", turned.size, INK), place, turned)


def draw_landmarks(
    image: Image, parts: FaceParts, scene: Scene, camera: Camera, scheme: str, *, numbered: bool = True
) -> None:
    """Dots with numbers at the landmarks of a scheme; those behind the surface are faint.

    :raises InputError: no mesh has the scheme
    """
    from PIL import Image as Images
    from PIL import ImageDraw

    marked, start = [], 0
    for mesh in parts.meshes:
        if scheme in mesh.landmarks:
            marked.append(np.asarray(mesh.landmarks[scheme].indices, dtype=np.int64) + start)
        start += len(mesh.points)
    if not marked:
        known = sorted({name for mesh in parts.meshes for name in mesh.landmarks})
        raise InputError(f"{parts.name} -> landmarks", unknown(scheme, known, "scheme"))
    points, numbers = np.concatenate(marked), np.concatenate([np.arange(len(indices)) for indices in marked])
    screen = camera.project(scene.points)
    where = screen[points, :2] / screen[points, 3:]
    width, height = image.size
    solid = scene.triangles[~scene.see_through]
    nearness = rasterise(screen_triangles(screen, solid), width, height).nearness
    at = screen[points, :2] / screen[points, 3:]
    column = np.clip(np.floor(at[:, 0]), 0, width - 1).astype(np.int64)
    row = np.clip(np.floor(at[:, 1]), 0, height - 1).astype(np.int64)
    depth = screen[points, 3]
    slack = 0.02 * float(np.ptp(screen[np.unique(scene.triangles), 3])) if len(scene.triangles) else 0.0
    seen = np.asarray(nearness[row, column] * (depth - slack) <= 1.0)
    radius = max(1.6, image.width / 260)
    pixels = np.asarray(image, dtype=np.float64).copy()
    for (x, y), clear in zip(where, seen, strict=True):
        _disc(pixels, x, y, radius + max(0.7, radius * 0.3), (255, 255, 255), 0.9 if clear else HIDDEN / 2)
        _disc(pixels, x, y, radius, DOT, 1.0 if clear else HIDDEN)
    image.paste(Images.fromarray((pixels + 0.5).astype(np.uint8)))
    if not numbered:
        return
    pen, letters = ImageDraw.Draw(image), font(max(8.0, image.width / 72))
    shown = np.flatnonzero(seen)
    texts = [str(numbers[each]) for each in shown]
    widths = np.array([letters.getlength(text) for text in texts])
    for text, (x, y) in zip(texts, _label_centers(where, where[shown], widths, radius), strict=True):
        pen.text(
            (x, y), text, fill=INK, font=letters, anchor="mm",
            stroke_width=max(1, round(image.width / 700)), stroke_fill=(255, 255, 255),
        )  # fmt: skip


def _label_centers(dots: FloatArray, places: FloatArray, widths: FloatArray, radius: float) -> FloatArray:
    """(m, 2) where to centre the labels of the dots at `places` (m, 2): on the side with the most room around it."""
    turns = np.arange(12) * np.pi / 6
    taken = [*dots]
    centers = np.zeros((len(places), 2))
    for number, (place, width) in enumerate(zip(places, widths, strict=True)):
        reach = radius * 2.2 + np.stack([width / 2 * np.abs(np.cos(turns)), radius * np.abs(np.sin(turns))], axis=1)
        choices = place + reach * np.stack([np.cos(turns), -np.sin(turns)], axis=1)
        apart = np.linalg.norm(choices[:, None] - np.array(taken)[None], axis=2)
        # Crowding falls off steeply; the first, to the right, wins where all sides are free.
        crowding = (np.maximum(apart, 1.0) ** -3).sum(axis=1)
        centers[number] = choices[np.argmin(np.round(crowding * radius**3, 3))]
        taken.append(centers[number])
    return centers


def _disc(pixels: FloatArray, x: float, y: float, radius: float, color: tuple[int, int, int], opacity: float) -> None:
    """Blend a smooth-edged disc into (h, w, 3) pixels."""
    height, width = pixels.shape[:2]
    left, right = max(0, int(x - radius - 2)), min(width, int(x + radius + 3))
    top, bottom = max(0, int(y - radius - 2)), min(height, int(y + radius + 3))
    if right <= left or bottom <= top:
        return
    columns, rows = np.arange(left, right) + 0.5 - x, np.arange(top, bottom) + 0.5 - y
    cover = np.clip(radius + 0.5 - np.hypot(columns[None, :], rows[:, None]), 0, 1)[..., None] * opacity
    pixels[top:bottom, left:right] += (np.array(color) - pixels[top:bottom, left:right]) * cover


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
        if font(letters).getlength(name) > right - at:
            while name and font(letters).getlength(f"{name}...") > right - at:
                name = name[:-1]
            name = f"{name}..."
        pen.text((at, y), name, fill=INK, font=font(letters), anchor="lm")
    if len(shown) < len(entries):
        text = f"and {len(entries) - len(shown)} more"
        pen.text((left, top + step * (len(shown) + 0.5)), text, fill=INK, font=font(letters), anchor="lm")


def _letters(regions: RegionColors, size: int) -> float:
    """Height of the letters that lets all names stand below each other, or the least that can be read."""
    return max(8.0, min(text_size(size), size * 0.92 / 1.7 / len(regions.entries)))
