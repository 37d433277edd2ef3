"""The skin's textures: colour, roughness and relief as functions of the place on the head.

A tile is one square of texture coordinates: 0 the face, 1 the back of the head with neck, mouth and eye sockets. What
is coarse is made of the place in space, so that both tiles agree where they meet; only grain is made texel by texel.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.resources import files
from io import BytesIO
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from facepipe.core.arrays import FloatArray
from facepipe.geometry.bicubic import Enlarged, strips
from facepipe.geometry.colors import to_srgb
from facepipe.geometry.gaussian_blur import gaussian_blur
from facepipe.heads.ageing import sags
from facepipe.heads.asset import arrays
from facepipe.heads.hairlines import bearded, receded
from facepipe.heads.people import BEARDS, STYLES, Look
from facepipe.parts import Texture


def _filtered_where(values: FloatArray, sigmas: tuple[float, float], share: FloatArray) -> tuple[Any, FloatArray]:
    """The box of a picture where `share` is not 0, and there the Gaussian filter's result: the rest is not seen."""
    box, around, inner = [], [], []
    for axis, sigma in enumerate(sigmas):
        some = np.flatnonzero(share.any(axis=1 - axis))
        low, high = (int(some[0]), int(some[-1]) + 1) if len(some) else (0, 0)
        start = max(low - int(4 * sigma + 0.5), 0)  # the filter reaches no farther
        box.append(slice(low, high))
        around.append(slice(start, high + int(4 * sigma + 0.5)))
        inner.append(slice(low - start, high - start))
    return tuple(box), gaussian_blur(values[tuple(around)], sigmas)[tuple(inner)]


def to_bytes(values: FloatArray) -> Any:
    """0..1 as 0..255."""
    return (np.clip(values, 0, 1) * 255 + 0.5).astype(np.uint8)


def jpeg(name: str, pixels: Any) -> Texture:
    """An image file of bytes (h, w, 3)."""
    from PIL import Image

    stream = BytesIO()
    Image.fromarray(pixels).save(stream, format="JPEG", quality=90, subsampling=0)
    return Texture(name=f"{name}.jpg", data=stream.getvalue())


TILES = ("face", "back")
_SHAVED = ("stubble", "buzz")  # styles whose hairs are dots
_SMALL = 128  # texels a side, up to which every fourth place will do, and spots are smaller than a texel
_BLOOD = np.array([0.16, 0.62, 0.52])  # how much a unit of it darkens red, green and blue (natural logarithm)
_MELANIN = np.array([0.45, 0.75, 1.0])
_LINED = 1.1  # darkening of the lids' rims, where lashes are full
_GROOVE = 2.0  # darkening in the depth of folds, for each cm
_SHADE = np.array([0.75, 0.95, 1.0])
_TINTS = (_BLOOD, _MELANIN, _SHADE)
_CARUNCLE = np.array([0.55, 0.25, 0.22])
_RIM = np.array([0.78, 0.47, 0.43])  # of the lower lid, where tears lie along the eyeball
_TEARS = 0.05  # cm that they stand up along the eyeball
_FLESH = np.array([0.52, 0.20, 0.18])


class Masks(Mapping[str, FloatArray]):
    """Kinds of skin by name, (h, w) of 0..1, made of bytes when they are asked for: all together are 22 MB."""

    def __init__(self, planes: Any) -> None:
        """:param planes: (names, h, w) bytes"""
        self._planes = dict(zip(map(str, arrays("skin_maps")["names"]), planes, strict=True))

    def __getitem__(self, name: str) -> FloatArray:
        return np.asarray(self._planes[name].astype(np.float32) / 255)

    def __iter__(self) -> Iterator[str]:
        return iter(self._planes)

    def __len__(self) -> int:
        return len(self._planes)


@cache
def masks(tile: int, step: int = 1) -> Masks:
    """The kinds of skin of a tile, (512, 512), top row first, or every `step`-th place of them."""
    planes = np.moveaxis(arrays("skin_maps")[f"{TILES[tile]}_masks"][::step, ::step], -1, 0)
    return Masks(np.ascontiguousarray(planes))


def _places(tile: int) -> FloatArray:
    return arrays("skin_maps")[f"{TILES[tile]}_places"].astype(np.float32)


@cache
def wrinkle_table() -> Mapping[str, Any]:
    """Region -> the picture and channel of its mask, its strength at rest in the oldest, and gains of shapes."""
    table: dict[str, Any] = json.loads((files("facepipe.heads") / "data" / "wrinkles.json").read_text("utf-8"))
    return table


def _picture(name: str, size: int) -> Any:
    """(n, n, 3) bytes of a picture of the package, at least as large as asked for where it is."""
    from PIL import Image

    with Image.open(BytesIO((files("facepipe.heads") / "data" / name).read_bytes())) as image:
        image.draft(None, (size, size))  # a JPEG is decoded at a half or less where that is enough
        return np.asarray(image)


def at_rest(look: Look) -> dict[str, float]:
    """How strong wrinkles are without any expression, by region, 0..1: none below 27 years, no two people alike."""
    share = float(np.clip((look.age - 0.15) / 0.85 * (1.1 - 0.2 * look.feminine), 0, 1))
    own = np.random.default_rng((look.seed, 300)).uniform(0.75, 1.2, len(wrinkle_table()))
    return {name: float(row["old"] * share * own[i]) for i, (name, row) in enumerate(sorted(wrinkle_table().items()))}


def _creases(look: Look, tile: int, size: int) -> Enlarged | None:
    """(size, size) strength of wrinkles at rest; None where there are none."""
    strengths = at_rest(look)
    if TILES[tile] != "face" or not any(strengths.values()):
        return None
    pictures: dict[str, Any] = {}
    total = np.zeros((256, 256), np.float32)
    for name, row in wrinkle_table().items():
        number, channel = row["mask"]
        if number not in pictures:
            pictures[number] = _picture(f"wrinkles_mask{number}.png", 256)
        total += np.float32((1 + look.worn) * strengths[name] / 255) * pictures[number][..., "rgb".index(channel)]
    return Enlarged(np.minimum(total, 1.5), size)


def _sagging(look: Look, size: int) -> FloatArray:
    """(size, size) height in cm of the face's folds and hollows of age, no two people's alike."""
    own = np.random.default_rng((look.seed, 301)).uniform(0.9, 1.7, len(sags())).astype(np.float32)
    heights = np.tensordot(own, np.stack(list(sags().values())), axes=1)
    return Enlarged(np.float32(look.worn * (1.2 - 0.4 * look.feminine)) * heights, size).whole()


def _noise(look: Look, tile: int, wavelength: float, number: int, step: int = 1) -> FloatArray:
    """(512 / step, 512 / step) smooth noise of unit variance over space."""
    lattice = np.random.default_rng((look.seed, number)).standard_normal((24, 24, 24)).astype(np.float32)
    at = np.moveaxis(_sparse_places(tile, step), -1, 0) / wavelength
    values = map_coordinates(lattice, at, order=3, mode="grid-wrap", prefilter=False)
    return Enlarged(values / 0.5, 512 // step).whole()


def coarse(look: Look, tile: int, step: int = 1) -> FloatArray:
    """(512 / step, 512 / step, 3) linear colour without grain."""
    m, scalp = masks(tile, step), STYLES[look.style][0]
    broad, middle, patch = (_noise(look, tile, size, i, step) for i, size in enumerate((3.2, 1.1, 0.55)))
    light = 1 - 0.6 * look.darkness
    warm = 0.75 * m["cheeks"] + 0.75 * m["nose"] + 0.7 * m["ears"] + 0.3 * m["chin"] - 0.2 * m["forehead"]
    womanly = max(2 * look.feminine - 1, 0)
    uneven = look.worn**2 * (1 - 0.4 * womanly) * (1 - 0.7 * np.maximum(m["neck"], m["scalp"]))
    blood = (0.25 + 0.75 * look.redness) * warm + (0.05 * middle + 0.045 * patch + 0.03 * broad) * (1 + uneven)
    blood *= 1.15 - 0.3 * look.feminine
    blood = light * blood + 0.32 * m["lid"] + 0.35 * m["rim"] + 0.2 * m["under_eye"]
    red = (0.3 + 0.8 * look.lips + 0.5 * look.feminine + 0.5 * womanly) * (1 - 0.5 * look.worn)
    blood += red * m["lips"] * (1 - 0.35 * look.darkness) * (1 + 0.05 * patch)
    melanin = (0.025 * broad + 0.02 * middle) * (1 + 2 * uneven)
    melanin += (0.16 + 0.2 * look.worn) * (1 - 0.5 * womanly) * m["under_eye"]
    melanin += 0.10 * m["lid"] + (0.10 + 0.25 * look.darkness) * m["lips"] - 0.04 * m["neck"]
    shade = 0.9 * m["lip_line"] * m["lips"] + 0.9 * np.clip(1 - m["open"] / 0.55, 0, 1) * (1 - m["mouth"])
    shade += womanly * (_LINED * m["rim"] + 0.18 * m["lid"])
    shade += look.beard * (0.34 * m["beard"] + 0.1 * m["moustache"]) * (0.5 + 0.5 * light)
    if look.worn and TILES[tile] == "face":
        shade += _GROOVE * np.maximum(-_sagging(look, 512 // step), 0)
    colors = np.empty((3, *blood.shape), np.float32)
    for color, own, *tints in zip(colors, look.skin.tolist(), *(one.tolist() for one in _TINTS), strict=True):
        red, brown, dark = tints
        np.exp(np.log(own) - (blood * red + melanin * brown + shade * dark), out=color)
    creases = _creases(look, tile, 512 // step)
    if creases is not None:
        lines = creases.whole() * np.float32(0.8)
        for color, tint in zip(colors, np.moveaxis(_picture("wrinkles_tint.jpg", 512 // step), -1, 0), strict=True):
            color *= 1 + lines * (tint / np.float32(255) - 1)
    hair = scalp * np.clip((cover(look, tile, step) - 0.3 + 0.12 * patch) / 0.6, 0, 1)  # cards lie before its edge
    tint = np.minimum(0.5 * look.hair_color + 0.002 * look.skin, 0.15 * look.hair_color + 0.55 * look.skin)
    _mix(colors, tint, hair)
    if BEARDS[look.whiskers]:
        _mix(colors, tint, BEARDS[look.whiskers] * np.clip((_grown(look, tile, step) - 0.3) / 0.6, 0, 1))
    _mix(colors, np.minimum(look.hair_color, 0.5 * look.skin), 0.4 * look.brows * m["brows"])
    _mix(colors, look.skin * (0.95, 0.66, 0.62), m["socket"])
    _mix(colors, _RIM * (1 - 0.6 * look.darkness), m["wet_line"])
    _mix(colors, _CARUNCLE * (1 - 0.5 * look.darkness), m["caruncle"])
    _mix(colors, _FLESH * (1 - 0.3 * look.darkness), m["mouth"])
    return np.moveaxis(colors, 0, -1)


def cover(look: Look, tile: int, step: int = 1) -> FloatArray:
    """(512 / step, 512 / step) where hair grows on the head, 0..1."""
    scalp = masks(tile, step)["scalp"]
    if look.style == "receding":
        inside = receded(_sparse_places(tile, step))
        scalp = scalp * Enlarged(np.clip(inside / 1.4, 0, 1), 512 // step).whole()
    return np.asarray(scalp)


def _grown(look: Look, tile: int, step: int) -> FloatArray:
    """(512 / step, 512 / step) where a beard with cards grows, 0..1."""
    zone = bearded(look.whiskers, _sparse_places(tile, step))
    return np.asarray(masks(tile, step)["beard"] * Enlarged(zone, 512 // step).whole())


def _sparse_places(tile: int, step: int) -> FloatArray:
    """(256 / ..., 256 / ..., 3) places; they are known at every second texel."""
    skipped = max(step // 2, 1)
    return _places(tile)[::skipped, ::skipped]


def _mix(colors: FloatArray, other: FloatArray, share: FloatArray) -> None:
    """Bring colours (3, h, w) nearer to another (3,)."""
    for color, goal in zip(colors, other.tolist(), strict=True):
        color += share * (goal - color)


def albedo(look: Look, tile: int, size: int) -> FloatArray:
    """(size, size, 3) sRGB bytes."""
    rng = np.random.default_rng((look.seed, 100 + tile))
    m, scalp = masks(tile), STYLES[look.style][0]
    small = size <= _SMALL
    base = [Enlarged(255 * to_srgb(one), size) for one in np.moveaxis(coarse(look, tile, 4 if small else 1), -1, 0)]
    skin = Enlarged((1 - m["scalp"] * scalp) * (1 - np.maximum(m["mouth"], m["socket"])), size)
    grain = gaussian_blur(rng.standard_normal((size, size), np.float32), size / 1400)
    patches = Enlarged(gaussian_blur(rng.standard_normal((size // 4, size // 4), np.float32), size / 1400) * 3, size)
    aged = Enlarged(np.zeros((1, 1)), size)
    if look.worn and not small:
        lines = gaussian_blur(rng.standard_normal((512, 512), np.float32), 2.2)
        veins = np.exp(-((lines / (0.15 * lines.std())) ** 2)) * np.clip(_noise(look, tile, 0.9, 6), 0, 1.5)
        zone = np.clip(m["cheeks"] + 0.8 * m["nose"] + 0.3 * m["chin"], 0, 1)
        aged = Enlarged((0.35 * look.worn) * zone * veins, size)
    spots = Enlarged(np.zeros((1, 1)) if small else _spots(look, tile, rng), size)
    hairs = None  # darkening by the dots of shaved hairs
    share = np.clip(look.beard * m["beard"] + (0.9 * cover(look, tile) if look.style in _SHAVED else 0), 0, 1)
    if share.any():
        hairs = gaussian_blur(_dots(rng, Enlarged(np.float32(0.06) * share, size), size), size / 2600)
    contrast = 1.6 * float(np.clip(np.log(look.skin.mean() / look.hair_color.mean()), 0.0, 2.0))
    pixels = np.empty((size, size, 3), np.uint8)
    for rows in strips(size):
        own = skin[rows]
        blood = float(0.03 * (1 + look.worn)) * own * patches[rows] + aged[rows]
        melanin = own * (np.float32(0.05) * grain[rows] + spots[rows])
        dark = 0.0 if hairs is None else np.minimum(contrast * hairs[rows], contrast)
        for channel, (red, brown) in enumerate(zip(_BLOOD.tolist(), _MELANIN.tolist(), strict=True)):
            # in sRGB's encoding
            light = np.exp((blood * red + melanin * brown + dark) * np.float32(-1 / 2.2))
            pixels[rows, :, channel] = np.clip(base[channel][rows] * light, 0, 255)
    return np.asarray(pixels)


def _spots(look: Look, tile: int, rng: np.random.Generator) -> FloatArray:
    """(1024, 1024) melanin of freckles, moles and the spots of age."""
    m, size = masks(tile), 1024
    zone = m["cheeks"] + 0.8 * m["bridge"] + 0.5 * m["nose"] + 0.25 * m["forehead"] + 0.12 * m["neck"]
    zone = Enlarged(np.clip(zone, 0, 1), size).whole()
    bare = Enlarged((1 - m["lips"]) * (1 - m["scalp"]) * (1 - m["socket"]) * (1 - m["mouth"]), size).whole()
    spots = np.zeros((size, size), np.float32)
    kinds: tuple[tuple[FloatArray, float, float], ...] = (  # share of texels, radius in texels, strength
        (0.004 * look.freckles * zone, 1.7, 0.55),
        (0.0008 * look.freckles * zone, 3.0, 0.5),
        (0.000006 * bare, 1.7, 1.8),
        (0.00016 * look.worn**2 * bare, 2.5, 0.6),
        (0.00006 * look.worn**2 * bare, 5.5, 0.5),
    )
    for density, radius, strength in kinds:
        if not density.any():
            continue
        chosen = rng.random((size, size), np.float32) < density
        dots = np.asarray(chosen * rng.uniform(0.3, 1.0, (size, size)), np.float32)
        if dots.any():
            spots += strength * np.minimum(gaussian_blur(dots, radius) * 2 * np.pi * radius**2, 1.2)
    return np.asarray(spots * (1 - 0.6 * look.darkness) * bare)


def roughness(look: Look, tile: int, size: int) -> FloatArray:
    """(size, size, 3) bytes as glTF packs them: occlusion, roughness, metallic (0)."""
    m = masks(tile)
    oily = 0.5 * m["forehead"] + 0.8 * m["nose"] + 0.3 * m["cheeks"] + 0.5 * m["chin"] + 0.4 * m["bridge"]
    rough = 0.56 - 0.13 * np.clip(oily, 0, 1) - 0.14 * m["lips"] - 0.05 * m["lid"] + 0.06 * m["neck"]
    rough += 0.08 * look.worn**2 + 0.03 * _noise(look, tile, 0.8, 5) + 0.1 * m["scalp"]
    wet = np.maximum.reduce([m["mouth"], m["socket"], m["rim"]])
    rough = np.clip(rough + (0.22 - rough) * wet, 0.1, 1)
    rough += (0.08 - rough) * np.maximum(m["wet_line"], m["caruncle"])
    pixels = np.zeros((size, size, 3), np.uint8)
    for channel, values in enumerate((m["open"] ** np.float32(0.7), rough)):
        enlarged = Enlarged(values, size)
        for rows in strips(size):
            pixels[rows, :, channel] = to_bytes(enlarged[rows])
    return np.asarray(pixels)


def relief(look: Look, tile: int, size: int) -> FloatArray:
    """(size, size, 3) bytes of a tangent-space normal map."""
    places = _places(tile)
    texel = np.linalg.norm(np.gradient(places, axis=1), axis=-1) * places.shape[0] / size
    scale = size / 2048
    texel = Enlarged(np.clip(gaussian_blur(texel, 2), 0.006 / scale, 0.04 / scale), size)  # cm
    height, creases = _height(look, tile, size), _creases(look, tile, size)
    picture = None if creases is None else _picture("wrinkles_normal.jpg", size)
    folds = [] if picture is None else [Enlarged(picture[..., axis], size) for axis in range(2)]
    normals = np.empty((size, size, 3), np.uint8)
    for rows in strips(size):
        above = min(rows.start, 1)  # rows beside these, which the slope at their edges takes
        down = np.gradient(height[rows.start - above : rows.stop + 1], axis=0)[above:][: rows.stop - rows.start]
        own = texel[rows]
        sides = [-np.gradient(height[rows], axis=1) / own, down / own]
        up = _length(sides)
        if creases is not None:
            strong = creases[rows] / up
            pairs = zip(sides, folds, strict=True)
            sides = [side + strong * (fold[rows] - np.float32(128)) for side, fold in pairs]
            up = _length(sides)
        for axis, side in enumerate((*sides, np.float32(1))):
            normals[rows, :, axis] = 128 + side * up
    return np.asarray(normals)


def _length(sides: Sequence[FloatArray]) -> FloatArray:
    """(...) what slopes and 1 are multiplied by for a normal 127.5 long."""
    return np.asarray(np.float32(127.5) / np.sqrt(sides[0] ** 2 + sides[1] ** 2 + np.float32(1)))


def _dots(rng: np.random.Generator, share: Enlarged, size: int) -> FloatArray:
    """(size, size) 1 at that share of texels, by chance, and 0 at the others."""
    dots = np.empty((size, size), np.float32)
    for rows in strips(size):
        np.less(rng.random(dots[rows].shape, np.float32), share[rows], out=dots[rows])
    return dots


def _height(look: Look, tile: int, size: int) -> FloatArray:
    """(size, size) cm: pores, grain, lines of the lips, folds of age."""
    rng = np.random.default_rng((look.seed, 200 + tile))
    m, scale = masks(tile), size / 2048
    skin = (1 - m["lips"]) * (1 - m["mouth"]) * (1 - m["socket"]) * (1 - m["rim"]) * (1 - 0.7 * m["neck"])
    pores = np.clip(0.35 + 0.9 * m["nose"] + 0.7 * m["cheeks"] + 0.4 * m["forehead"] + 0.4 * m["chin"], 0, 1.3) * skin
    sweaty, bare, lips = Enlarged(pores, size), Enlarged(skin, size), Enlarged(m["lips"], size).whole()
    pits = gaussian_blur(_dots(rng, Enlarged(np.full((1, 1), 0.012 / scale**2), size), size), 1.4 * scale)
    grain = rng.standard_normal((size, size), np.float32)
    fine = gaussian_blur(grain, 1.0 * scale)
    fine -= gaussian_blur(grain, 2.8 * scale)
    soft = np.float32(_TEARS) * m["wet_line"]
    if look.worn and TILES[tile] == "face":
        crossed = np.zeros((512, 512), np.float32)
        for widths in ((5.0, 1.5), (1.5, 6.0)):
            lines = gaussian_blur(rng.standard_normal((512, 512), np.float32), widths)
            crossed -= np.exp(-((lines / (0.35 * lines.std())) ** 2))
        soft += _sagging(look, 512) + np.float32(0.007 * look.worn**2) * skin * (1 - m["scalp"]) * crossed
    broad, height = Enlarged(soft, size), pits  # in its place: new pictures cost more than what is done to them
    depth = np.float32(-4 * 0.013 * (1 + 0.6 * look.worn - 0.5 * look.feminine))
    roughness = np.float32(0.0016 * (1 + 1.5 * look.worn**2))
    for rows in strips(size):
        own = sweaty[rows]
        rough = roughness * fine[rows]
        height[rows] = broad[rows] + depth * own * pits[rows] + rough * bare[rows] * (0.6 + 0.4 * own)
    box, lines = _filtered_where(grain, (9 * scale, 1.6 * scale), lips)
    height[box] += np.float32(0.020) * lines * lips[box]
    return height
