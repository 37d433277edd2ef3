"""What makes a render look like a photo, and what is no face: backgrounds, things in front, lenses and files."""

from __future__ import annotations

import io

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter

FloatArray = npt.NDArray[np.floating]


def resized(image: FloatArray, size: int) -> FloatArray:
    """(size, size, c) of a square image, smooth in both directions."""
    pixels = torch.as_tensor(np.ascontiguousarray(image), dtype=torch.float32).permute(2, 0, 1)[None]
    out = torch.nn.functional.interpolate(pixels, size=(size, size), mode="bilinear", antialias=True)
    return out[0].permute(1, 2, 0).numpy()


def muted(rng: np.random.Generator) -> FloatArray:
    """(3,) a colour, seldom a bright one."""
    gray = rng.uniform(0, 1)
    return np.clip(gray + (rng.uniform(0, 1, 3) - 0.5) * rng.choice([0.15, 0.4, 1.2]), 0, 1)


def background(size: int, rng: np.random.Generator) -> FloatArray:
    """(size, size, 3) sRGB: planes, gradients, stripes, clouds, shapes, and mixtures of them."""
    image = np.tile(muted(rng), (size, size, 1))
    y, x = np.mgrid[0:size, 0:size] / size
    for _ in range(rng.integers(1, 4)):
        other = muted(rng)
        kind = rng.integers(5)
        way = rng.uniform(0, 2 * np.pi)
        along = x * np.cos(way) + y * np.sin(way)
        if kind == 0:
            share = np.clip((along - along.min()) / np.ptp(along), 0, 1)
        elif kind == 1:
            share = (np.sin(along * rng.uniform(8, 90) + rng.uniform(0, 6)) > rng.uniform(-0.5, 0.5)).astype(float)
        elif kind == 2:
            coarse = rng.random((int(rng.integers(3, 24)),) * 2 + (1,))
            share = resized(coarse, size)[..., 0]
        elif kind == 3:
            share = _shapes(size, rng)
        else:
            share = gaussian_filter(rng.random((size, size)), rng.uniform(0.5, 4))
            share = np.clip((share - share.mean()) / (share.std() + 1e-6) * 0.25 + 0.5, 0, 1)
        amount = (share * rng.uniform(0.3, 1))[..., None]
        image = image * (1 - amount) + other * amount
    if rng.random() < 0.4:
        image = gaussian_filter(image, (rng.uniform(0.5, 6),) * 2 + (0,))
    return image


def _shapes(size: int, rng: np.random.Generator) -> FloatArray:
    """(size, size) 0..1: ellipses, boxes and lines."""
    canvas = Image.new("L", (size, size), 0)
    draw = ImageDraw.Draw(canvas)
    for _ in range(rng.integers(1, 12)):
        a, b = np.sort(rng.uniform(-0.2, 1.2, (2, 2)) * size, axis=0)
        shade = int(rng.integers(60, 256))
        kind = rng.integers(3)
        if kind == 0:
            draw.ellipse((*a, *b), fill=shade)
        elif kind == 1:
            draw.rectangle((*a, *b), fill=shade)
        else:
            draw.line((a[0], b[1], b[0], a[1]), fill=shade, width=int(rng.integers(1, 12)))
    return np.asarray(canvas, dtype=float) / 255


def blobs(size: int, rng: np.random.Generator) -> FloatArray:
    """(size, size, 3) what has a face's colour or roundness and is none: ovals with a few dark spots, out of place."""
    image = background(size, rng)
    skin = np.array([0.9, 0.7, 0.6]) * rng.uniform(0.3, 1.05) * rng.uniform(0.8, 1.1, 3)
    y, x = np.mgrid[0:size, 0:size] / size - rng.uniform(0.35, 0.65, 2)[:, None, None]
    way = rng.uniform(0, np.pi)
    a, b = x * np.cos(way) + y * np.sin(way), y * np.cos(way) - x * np.sin(way)
    radius = np.hypot(a / rng.uniform(0.2, 0.5), b / rng.uniform(0.2, 0.5))
    share = np.clip((1 - radius) * rng.uniform(4, 30), 0, 1)[..., None]
    lit = 0.7 + 0.5 * (a * rng.normal() + b * rng.normal()) + 0.05 * rng.normal(size=1)
    image = image * (1 - share) + np.clip(skin * lit[..., None], 0, 1) * share
    for _ in range(rng.integers(0, 4)):
        at = rng.uniform(0.25, 0.75, 2)
        spread = rng.uniform(0.004, 0.02, 2)
        yy, xx = np.mgrid[0:size, 0:size] / size
        spot = np.exp(-((xx - at[0]) ** 2 / spread[0] ** 1.2 + (yy - at[1]) ** 2 / spread[1] ** 1.2))[..., None]
        image = image * (1 - spot) + rng.uniform(0, 1, 3) * spot
    return image


def occlude(
    image: FloatArray, labels: npt.NDArray[np.integer], marks: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """The picture (sRGB) with glasses or things in front of the face; labels are changed in place below things."""
    kind = rng.random()
    if kind < 0.12:
        return _glasses(image, marks, rng)[0]
    if kind < 0.22:
        image, cover = _thing(image, marks, rng)
        labels[cover > 0.5] = 0
    return image


def often_occluded(image: FloatArray, marks: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """The picture (sRGB) with glasses, hands and things in front of the face, and (S, S) 0..1 where they are."""
    cover = np.zeros(image.shape[:2])
    for share, kind in ((0.25, _glasses), (0.2, _hand), (0.2, _thing)):
        if rng.random() < share:
            image, more = kind(image, marks, rng)
            cover = np.maximum(cover, more)
    return image, cover


def _glasses(image: FloatArray, marks: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    size = len(image)
    eyes = marks[36:42].mean(axis=0), marks[42:48].mean(axis=0)
    across = np.linalg.norm(eyes[1] - eyes[0])
    if not 8 < across < size:
        return image, np.zeros((size, size))
    canvas = Image.new("L", (4 * size, 4 * size), 0)
    tint = Image.new("L", (4 * size, 4 * size), 0)
    draw, dark = ImageDraw.Draw(canvas), ImageDraw.Draw(tint)
    width = max(int(4 * across * rng.uniform(0.015, 0.07)), 2)
    unit = (eyes[1] - eyes[0]) / across
    down = np.array([-unit[1], unit[0]])
    radii = across * rng.uniform(0.28, 0.42), across * rng.uniform(0.2, 0.36)
    power = rng.choice([1.0, 0.6, 0.4])
    turn = np.linspace(0, 2 * np.pi, 48)
    ring = np.stack(
        [np.abs(np.cos(turn)) ** power * np.sign(np.cos(turn)), np.abs(np.sin(turn)) ** power * np.sign(np.sin(turn))]
    )
    for eye in eyes:
        places = (eye + ring[0][:, None] * radii[0] * unit + (ring[1][:, None] * radii[1] + 0.05 * across) * down) * 4
        outline = [tuple(p) for p in places]
        draw.line(outline, fill=255, width=width, joint="curve")
        dark.polygon(outline, fill=255)
    inner = [4 * (eyes[0] + radii[0] * unit), 4 * (eyes[1] - radii[0] * unit)]
    draw.line([tuple(p) for p in inner], fill=255, width=width)
    for eye, ear, side in ((eyes[0], marks[0], -1), (eyes[1], marks[16], 1)):
        draw.line([tuple(4 * (eye + side * radii[0] * unit)), tuple(4 * ear)], fill=255, width=width)
    frame, lens = (
        np.asarray(one.resize((size, size), Image.Resampling.BOX), float)[..., None] / 255 for one in (canvas, tint)
    )
    shaded = rng.uniform(0.6, 0.95) if rng.random() < 0.15 else rng.uniform(0, 0.12)
    image = image * (1 - lens * shaded) + lens * shaded * rng.uniform(0, 0.2)
    return image * (1 - frame) + frame * rng.uniform(0, 0.5, 3), np.maximum(frame, lens * (shaded > 0.5))[..., 0]


def _hand(image: FloatArray, marks: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Fingers beside each other, and a palm that they come from, in the colour of the face's middle."""
    size = len(image)
    across = np.linalg.norm(marks[45] - marks[36])
    middle = np.clip(marks[27:36].mean(axis=0).astype(int), 3, size - 4)
    skin = image[middle[1] - 3 : middle[1] + 4, middle[0] - 3 : middle[0] + 4].mean(axis=(0, 1)) * rng.uniform(0.6, 1.2)
    radius, way = across * rng.uniform(0.08, 0.12), rng.normal(0, 1.0)
    along = np.array([np.sin(way), np.cos(way)])  # from tips to the palm, mostly downwards
    beside = np.array([along[1], -along[0]])
    tip = marks[rng.integers(len(marks))] + rng.normal(0, 0.2 * across, 2)
    places = np.stack(np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5), axis=-1)
    cover, light = np.zeros((size, size)), np.zeros((size, size))
    fingers = int(rng.integers(1, 6))
    for i in range(fingers):
        start = tip + beside * radius * 2 * i * rng.uniform(0.9, 1.1) - along * across * rng.uniform(-0.15, 0.15)
        bent = rng.normal(0, 0.08)
        end = start + (along + bent * beside) * across * rng.uniform(0.7, 1.0)
        share = np.clip(((places - start) @ (end - start)) / ((end - start) ** 2).sum(), 0, 1)[..., None]
        off = np.linalg.norm(places - start - share * (end - start), axis=-1) / radius
        inside = np.clip((1 - off) * radius, 0, 1)
        light = np.where(inside > cover, 1 - 0.45 * np.clip(off, 0, 1) ** 2, light)
        cover = np.maximum(cover, inside)
    palm = tip + along * across * 1.15 + beside * radius * (fingers - 1)
    radii = across * np.array([0.5, 0.45])
    off = np.linalg.norm((places - palm) @ np.stack([along, beside], axis=1) / radii, axis=-1)
    inside = np.clip((1 - off) * radius, 0, 1)
    light = np.where(inside > cover, 1 - 0.2 * np.clip(off, 0, 1) ** 2, light)
    cover = np.maximum(cover, inside)
    lit = light + 0.15 * rng.normal() * ((places - palm) @ beside) / across
    return image + cover[..., None] * (np.clip(skin * lit[..., None], 0, 1) - image), cover


def _thing(image: FloatArray, marks: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    size = len(image)
    center = marks[rng.integers(17)] + rng.normal(0, 0.06 * size, 2)
    way = rng.uniform(0, np.pi)
    y, x = np.mgrid[0:size, 0:size] + 0.5
    a = (x - center[0]) * np.cos(way) + (y - center[1]) * np.sin(way)
    b = (y - center[1]) * np.cos(way) - (x - center[0]) * np.sin(way)
    radius = np.hypot(a / (size * rng.uniform(0.08, 0.25)), b / (size * rng.uniform(0.04, 0.12)))
    share = np.clip((1 - radius) * 8, 0, 1)[..., None]
    color = np.array([0.8, 0.6, 0.5]) * rng.uniform(0.3, 1.1) if rng.random() < 0.5 else rng.uniform(0, 1, 3)
    return image * (1 - share) + np.clip(color * (1 - 0.3 * radius[..., None] ** 2), 0, 1) * share, share[..., 0]


def photographed(image: FloatArray, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """8-bit sRGB of a picture (sRGB 0..1) after contrast, a lens, a sensor and a file."""
    contrast, mean = rng.uniform(0.8, 1.25), image.mean()
    image = (image - mean) * contrast + mean + rng.uniform(-0.06, 0.06)
    image = np.clip(image, 0, 1) ** rng.uniform(0.8, 1.25) * rng.uniform(0.92, 1.06, 3)
    gray = image.mean(axis=2, keepdims=True)
    image = gray + (image - gray) * (rng.uniform(0, 0.3) if rng.random() < 0.08 else rng.uniform(0.7, 1.3))
    if rng.random() < 0.35:
        image = gaussian_filter(image, (rng.uniform(0.3, 1.6),) * 2 + (0,))
    if rng.random() < 0.2:
        small = resized(image, int(len(image) * rng.uniform(0.3, 0.7)))
        image = resized(small, len(image)).astype(float)
    if rng.random() < 0.6:
        image = image + rng.normal(0, min(rng.exponential(0.012), 0.06), image.shape)
    if rng.random() < 0.15:
        image = image + 0.7 * (image - gaussian_filter(image, (1, 1, 0)))
    pixels = np.asarray(np.clip(image, 0, 1) * 255 + 0.5, dtype=np.uint8)
    if rng.random() < 0.4:
        store = io.BytesIO()
        Image.fromarray(pixels).save(store, "JPEG", quality=int(rng.integers(30, 95)))
        pixels = np.array(Image.open(store))
    return pixels
