"""Wrinkles of the skin: where shapes press it together, lines across, all of them at full strength in one normal map.

usage: python samples/head/build.py --data FOLDER

The skin folds across the way in which it is pressed: of each region's shapes at 1 the stretch of the surface is solved
for its principal directions, and lines are traced along the other one, evenly spaced as by Jobard and Lefer ("Creating
Evenly-Spaced Streamlines of Arbitrary Density", 1997), the deepest from where anatomy has them.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter, zoom
from scipy.spatial import cKDTree
from skin_maps import POINTS, SIZE, Array, Template, baked, lip_distance, masks, step

TEXELS = 1024  # a side of the maps
MASKS = 256  # a side of the masks
STRIDE = 0.04  # cm from one point of a line to the next
CALM = 4.0  # texels over which the sources' offsets are smoothed: they are linear on faces of 3 mm
WANDER = 0.14  # radians that lines stray from the way of the strain
SEED = 45
TABLE = Path(__file__).parent / "wrinkles.json"
FOLD = ((1.85, 0.1), (2.4, -0.9), (3.05, -2.1), (3.5, -3.3), (3.7, -4.5), (3.65, -5.5))  # of a smile, x and y

Places = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Kind:
    """Wrinkles that come together: one region, or one on each side."""

    shapes: tuple[str, ...]  # that press the skin there, without their sides
    least: float  # share by which it must be pressed
    apart: float  # cm between lines
    width: float  # cm of a line
    depth: float  # cm of the deepest
    fine: float  # depth of the others, share
    first: tuple[Places, ...] = ()  # x and y of the deepest on each side: of one point they are traced
    sided: bool = True


KINDS = {
    "browsUp": Kind(
        ("browInnerUp", "browOuterUp"), 0.10, 0.85, 0.17, 0.13, 0.4, (((1.5, 7.3),), ((0.4, 8.3),), ((2.6, 9.2),))
    ),
    "browsTogether": Kind(
        ("browDown",), 0.05, 0.55, 0.16, 0.15, 0.3, (((0.62, 4.6), (0.72, 5.4), (0.95, 6.3)),), sided=False
    ),
    "noseSneer": Kind(("noseSneer",), 0.08, 0.42, 0.11, 0.085, 0.45, (((0.8, 2.6),), ((0.9, 1.9),))),
    "crowsFeet": Kind(
        ("cheekSquint", "eyeSquint"), 0.07, 0.50, 0.11, 0.085, 0.45,
        (((5.3, 3.0),), ((5.3, 2.5),), ((5.2, 3.6),), ((3.4, 1.9),)),
    ),
    "smileFolds": Kind(("mouthSmile",), 0.06, 1.15, 0.24, 0.22, 0.24, (FOLD,)),
    "chin": Kind(("mouthShrugLower",), 0.02, 0.45, 0.12, 0.08, 0.5, (((0.2, -5.6),),), sided=False),
    "lipsPucker": Kind(("mouthPucker",), 0.05, 0.38, 0.10, 0.08, 0.8, sided=False),
    "neck": Kind(("jawOpen",), 0.10, 1.5, 0.18, 0.09, 0.5, (((0.5, -11.0),), ((0.5, -12.8),)), sided=False),
}  # fmt: skip


class Surface:
    """The face's tile of texture coordinates as a surface in space."""

    def __init__(self, template: Template, shapes: dict[str, Array]) -> None:
        painted = masks(template)
        kinds = [painted[name] for name in ("scalp", "socket", "mouth", "rim", "lips")]
        pressing = [
            sum(
                shapes[name][:POINTS]
                for name in shapes
                if name.removesuffix("Left").removesuffix("Right") in kind.shapes
            )
            for kind in KINDS.values()
        ]
        columns = [template.points, *kinds, lip_distance(template), *pressing]
        texels = baked(template, 0, np.column_stack(columns), SIZE)
        self.raw = texels[..., :3]
        self.places = gaussian_filter(self.raw, (3, 3, 0))
        scalp, socket, mouth, rim, lips, self.lip = np.moveaxis(texels[..., 3:9], -1, 0)
        self.skin = (1 - scalp) * (1 - np.maximum(socket, rim)) * (1 - mouth) * (1 - lips)
        self.offsets = {
            name: gaussian_filter(texels[..., 9 + 3 * i : 12 + 3 * i], (CALM, CALM, 0)) for i, name in enumerate(KINDS)
        }

    def strain(self, region: str) -> tuple[Array, Array]:
        """How much a region is pressed (SIZE, SIZE), and the way across, (SIZE, SIZE, 2) columns and rows a cm.

        With the first fundamental forms G and G' before and after, squares of stretches w solve ``G' a = w G a``.
        """
        moved = self.places + self.offsets[region]
        (a, b, c), (p, q, r) = (_form(places) for places in (self.places, moved))
        # the symmetric L^-1 G' L^-T with G = L L^T, and its eigenvectors by half the angle of a 2 x 2 matrix
        x = np.sqrt(np.maximum(a, 1e-9))
        y = b / x
        z = np.sqrt(np.maximum(c - y * y, 1e-9))
        m = p / a
        n = (q - p * b / a) / (x * z)
        o = (r - 2 * q * b / a + p * (b / a) ** 2) / (z * z)
        half = 0.5 * np.arctan2(2 * n, m - o)  # of the greatest stretch: lines run along it
        least = (m + o) / 2 - np.hypot((m - o) / 2, n)
        along = np.stack([np.cos(half), np.sin(half)])
        row = along[1] / z
        return 1 - np.sqrt(np.maximum(least, 0)), np.stack([(along[0] - y * row) / x, row], axis=-1)


def _form(places: Array) -> tuple[Array, Array, Array]:
    """The first fundamental form of a picture of places: E, F, G by columns and rows."""
    across, down = np.gradient(places, axis=1), np.gradient(places, axis=0)
    return (across**2).sum(-1), (across * down).sum(-1), (down**2).sum(-1)


def zones(surface: Surface) -> dict[str, Array]:
    """Where lines of each kind may be: (SIZE, SIZE) of 0..1."""
    x, y, lip = np.abs(surface.raw[..., 0]), surface.raw[..., 1], surface.lip
    brow = np.interp(x, [0, 1.0, 2.0, 4.0, 6.0, 8.0], [5.0, 5.3, 5.7, 6.3, 5.7, 4.6])  # height of its upper edge
    beside = x - np.interp(y, *np.array([(-9, 3.4), *((height, side) for side, height in FOLD[::-1])]).T)
    eye = np.maximum(step(4.5, 4.9, x), 0.7 * step(2.9, 2.4, y) * step(2.0, 2.6, x))  # beside it and below
    found = {
        "browsUp": step(0.2, 1.0, y - brow) * step(7.2, 5.6, x),
        "browsTogether": step(1.9, 1.3, x) * step(3.3, 3.9, y) * step(7.0, 6.2, y),
        "noseSneer": step(2.3, 1.5, x) * step(0.6, 1.3, y) * step(4.0, 3.4, y),
        "crowsFeet": eye * step(7.6, 6.4, x) * step(0.7, 1.4, y) * step(5.2, 4.5, y),
        "smileFolds": step(0.2, 0.7, beside) * step(2.2, 1.3, beside) * step(1.2, 0.4, y) * step(-7.2, -6.2, y),
        "chin": step(3.2, 2.2, x) * step(-4.9, -5.3, y) * step(-8.4, -7.4, y),
        "lipsPucker": step(1.35, 0.7, lip) * step(0.0, 0.2, lip) * step(2.0, 1.5, x) * step(-0.6, -1.4, y),
        "neck": step(-9.3, -10.2, y) * step(8.0, 5.5, x),
    }
    return {name: surface.skin * zone for name, zone in found.items()}


@dataclass(frozen=True, kw_only=True)
class Line:
    """A wrinkle."""

    at: Array  # (k, 2) columns and rows of the SIZE grid
    places: Array  # (k, 3) cm
    depth: Array  # (k,) cm, 0 at its ends
    width: float  # cm


class Tracer:
    """Lines of one kind, one after the other, each apart from those before."""

    def __init__(self, surface: Surface, name: str, zone: Array, rng: np.random.Generator) -> None:
        self.kind, self.rng, self.raw = KINDS[name], rng, surface.raw
        pressed, way = surface.strain(name)
        self.may = zone * step(0.5 * self.kind.least, 1.5 * self.kind.least, pressed)
        self.may[[0, 1, -2, -1]] = self.may[:, [0, 1, -2, -1]] = 0
        noise = gaussian_filter(rng.standard_normal((SIZE, SIZE)), 9)
        # ways have no sign: their products with themselves can be blended
        products = (way[..., 0] ** 2, way[..., 0] * way[..., 1], way[..., 1] ** 2)
        self.fields = np.stack(
            [*np.moveaxis(surface.places, -1, 0), self.may, WANDER * noise / noise.std(), *products], -1
        )
        self.lines: list[Line] = []
        self.taken: cKDTree | None = None

    def at(self, place: Array) -> Array:
        """(8,) the fields at a column and row, blended."""
        column, row = (int(one) for one in place)
        x, y = place[0] - column, place[1] - row
        (nw, ne), (sw, se) = self.fields[row : row + 2, column : column + 2]
        return (nw * (1 - x) + ne * x) * (1 - y) + (sw * (1 - x) + se * x) * y

    def half(self, start: Array, sign: float, apart: float) -> list[Array]:
        """From a start one way, as far as the skin is pressed and no other line is near."""
        found, at, before = [], start, None
        for _ in range(400):
            *_, turn, xx, xy, yy = self.at(at)
            way = np.array([xx, xy]) / np.sqrt(xx) if xx > yy else np.array([xy, yy]) / np.sqrt(yy)
            way = way * sign if before is None else way * np.sign(way @ before)
            cos, sin = np.cos(turn), np.sin(turn)
            way = np.array([way[0] * cos - way[1] * sin, way[0] * sin + way[1] * cos])
            at, before = at + STRIDE * way, way
            if not (2 <= at[0] < SIZE - 3 and 2 <= at[1] < SIZE - 3):
                break
            x, y, z, may, *_ = self.at(at)
            if may < 0.12 or (self.taken is not None and self.taken.query([x, y, z])[0] < apart):
                break
            found.append(at)
        return found

    def traced(self, start: Array, apart: float) -> Array:
        """(k, 2) columns and rows of a line through a start; none where it would be short or near another."""
        if self.taken is not None and self.taken.query(self.at(start)[:3])[0] < apart:
            return np.zeros((0, 2))
        at = np.array([*self.half(start, -1, 0.55 * apart)[::-1], start, *self.half(start, 1, 0.55 * apart)])
        return at if STRIDE * len(at) > 1.2 * self.kind.apart else at[:0]

    def drawn(self, sign: int, points: Places) -> Array:
        """(k, 2) columns and rows of a line that passes through points of the face's front."""
        at = []
        for x, y in points:
            away = (self.raw[..., 0] - sign * x) ** 2 + (self.raw[..., 1] - y) ** 2 + 100 * (self.raw[..., 2] < 2)
            row, column = np.unravel_index(away.argmin(), away.shape)
            at.append((column, row))
        if len(at) == 1:
            return self.traced(np.array(at[0], float), 0.5 * self.kind.apart)
        curve = CubicSpline(np.linspace(0, 1, len(at)), at)(np.linspace(0, 1, 200))
        length = np.append(0, np.cumsum(np.linalg.norm(np.diff([self.at(one)[:3] for one in curve], axis=0), axis=1)))
        steps = np.arange(0, length[-1], STRIDE)
        sway = gaussian_filter(self.rng.standard_normal((len(steps), 2)), (0.6 / STRIDE, 0), mode="reflect")
        return np.stack([np.interp(steps, length, side) for side in curve.T], -1) + 1.2 * sway / sway.std()

    def add(self, at: Array, depth: float, *, drawn: bool = False) -> None:
        """Keep a line (k, 2), shallow at its ends and, if it was traced, where the skin is hardly pressed."""
        kind, count = self.kind, len(at)
        if not count:
            return
        found = np.array([self.at(one) for one in at])
        ends = np.minimum(np.arange(count), np.arange(count)[::-1]) * STRIDE
        rough = gaussian_filter(self.rng.standard_normal(count), 0.25 / STRIDE, mode="reflect")
        rough = np.clip(1 + 0.2 * rough / max(float(rough.std()), 1e-6), 0.4, 1.5)
        deep = depth * step(0, min(0.45 * STRIDE * count, 1.3), ends) * rough
        if not drawn:
            deep = deep * step(0.1, 0.75, found[:, 3])
        width = kind.width * (0.55 + 0.5 * depth / kind.depth)
        self.lines.append(Line(at=at, places=found[:, :3], depth=deep, width=width))
        self.taken = cKDTree(np.concatenate([line.places for line in self.lines]))

    def trace(self) -> list[Line]:
        """All lines: first where anatomy has them, then from starts by chance, as long as there is room."""
        kind, rng = self.kind, self.rng
        for points in kind.first:
            for sign in (1, -1):
                self.add(self.drawn(sign, points), kind.depth * rng.uniform(0.85, 1.1), drawn=len(points) > 1)
        rows, columns = np.nonzero(self.may > 0.3)
        for i in rng.permutation(len(rows))[:6000]:
            start = np.array([columns[i], rows[i]], float)
            depth = kind.depth * kind.fine * rng.uniform(0.35, 1.1)
            self.add(self.traced(start, kind.apart * rng.uniform(0.75, 1.3)), depth)
        return self.lines


def valleys(lines: list[Line], places: Array) -> Array:
    """(TEXELS, TEXELS) depth, cm, of lines: the deepest of those at each texel.

    A crease has a narrow bottom and round shoulders: ``exp(-sqrt(d^2 + e^2) / w)``.
    """
    depth, scale = np.zeros(places.shape[:2]), TEXELS / SIZE
    texel = np.linalg.norm(np.gradient(places, axis=1), axis=-1)
    for line in lines:
        at = line.at * scale
        column, row = np.clip(at.round().astype(int), 0, TEXELS - 1).T
        pad = int(np.ceil(5 * line.width / max(float(texel[row, column].min()), 0.006)))
        low = np.maximum(np.floor(at.min(axis=0)).astype(int) - pad, 0)
        high = np.minimum(np.ceil(at.max(axis=0)).astype(int) + pad, TEXELS)
        box = (slice(low[1], high[1]), slice(low[0], high[0]))
        away, nearest = cKDTree(line.places).query(places[box].reshape(-1, 3))
        soft = 0.45 * line.width
        fall = np.exp(-(np.sqrt(away**2 + soft**2) - soft) / line.width)
        near = (line.depth[nearest] * fall).reshape(depth[box].shape)
        depth[box] = np.maximum(depth[box], near)
    return depth


def drawn(template: Template, shapes: dict[str, Array]) -> tuple[dict[str, Array], Array, Array]:
    """Masks by region (MASKS, MASKS), the normal map and the tints (TEXELS, TEXELS, 3), bytes."""
    surface = Surface(template, shapes)
    rng = np.random.default_rng(SEED)
    places = np.stack(
        [zoom(surface.places[..., i], TEXELS / SIZE, order=1, grid_mode=True, mode="nearest") for i in range(3)], -1
    )
    texel = float(np.median(np.linalg.norm(np.gradient(places, axis=1), axis=-1)))
    height, dark = np.zeros((TEXELS, TEXELS)), np.zeros((TEXELS, TEXELS))
    found: dict[str, Array] = {}
    for region, zone in zones(surface).items():
        kind = KINDS[region]
        depth = valleys(Tracer(surface, region, zone, rng).trace(), places)
        # skin that goes down in a crease comes up beside it
        height += 0.75 * gaussian_filter(depth, 2.6 * kind.width / texel) - depth
        dark = np.maximum(dark, 0.8 * depth / kind.width)
        reach = gaussian_filter(np.minimum(depth / (0.12 * kind.depth), 1.0), 0.12 / texel)
        mask = np.minimum(gaussian_filter(np.minimum(3 * reach, 1.0), 0.18 / texel) * 1.3, 1.0)
        side = step(-0.5, 0.5, places[..., 0])
        for name, share in (("Left", side), ("Right", 1 - side)) if kind.sided else (("", 1.0),):
            own = (mask * share).reshape(MASKS, TEXELS // MASKS, MASKS, TEXELS // MASKS).mean(axis=(1, 3))
            found[region + name] = (own * 255 + 0.5).astype(np.uint8)
    height = gaussian_filter(height, 0.8)
    across = np.maximum(np.linalg.norm(np.gradient(places, axis=1), axis=-1), 0.008)
    down = np.maximum(np.linalg.norm(np.gradient(places, axis=0), axis=-1), 0.008)
    slopes = -np.gradient(height, axis=1) / across, np.gradient(height, axis=0) / down
    up = 127.5 / np.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2)
    normals = np.stack([128 + slope * up for slope in (*slopes, np.ones_like(up))], axis=-1)
    dark = np.minimum(gaussian_filter(dark, 1.6), 1.0)[..., None]
    tints = 255 * np.exp(-dark * [0.24, 0.40, 0.37])
    return found, np.clip(normals, 0, 255).astype(np.uint8), (tints + 0.5).astype(np.uint8)


def main(source: Path, shapes: dict[str, Array], out: Path) -> None:
    """Draw and save.

    :param shapes: name -> (n, 3) offsets of the head's points, cm
    """
    found, normals, tints = drawn(Template(source), shapes)
    Image.fromarray(normals).save(out / "wrinkles_normal.jpg", quality=90, subsampling=0)
    Image.fromarray(tints).save(out / "wrinkles_tint.jpg", quality=85, subsampling=0)
    table = json.loads(TABLE.read_text())
    for number in range(1 + max(int(row["mask"][0]) for row in table.values())):
        picture = np.zeros((MASKS, MASKS, 3), np.uint8)
        for name, row in table.items():
            if int(row["mask"][0]) == number:
                picture[..., "rgb".index(row["mask"][1])] = found[name]
        Image.fromarray(picture).save(out / f"wrinkles_mask{number}.png", optimize=True)
    shutil.copyfile(TABLE, out / TABLE.name)
