"""Changes of a picture that leave its head as it is: the features shall depend on shape, little on light and colour."""

from __future__ import annotations

from typing import NamedTuple

import torch
from features_data import Heads, IntArray
from features_network import CLASSES, LABEL_SIZE, SIZE
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d, interpolate


class Scene(NamedTuple):
    """What stays of a batch in every light."""

    images: Tensor  # (b, 3, 128, 128) sRGB 0..1
    classes: Tensor  # (b, 64, 64)
    cleared: Tensor  # (b, 64, 64) bool: hair that is taken away
    marks: Tensor  # (b, 68, 2) landmarks, -1..1 of the picture


def scene(heads: Heads, rows: IntArray, random: Generator) -> Scene:
    """Heads turned, scaled and shifted as much as landmarks found in a photo are off; a quarter loses its hair."""
    moved = beside(len(rows), random)
    images, classes = heads.cropped(rows, LABEL_SIZE, moved)
    cleared = (classes == CLASSES.index("hair")) & (_uniform(random, len(rows), 1, 1) < 0.25)
    marks = seen_beside(torch.as_tensor(heads.marks[rows]), moved)
    return Scene(images, torch.where(cleared, 0, classes), cleared, marks)


def seen_beside(marks: Tensor, moved: Tensor) -> Tensor:
    """Points (b, m, 2) of crops in the ones beside them, by matrices (b, 2, 3) as of `beside`."""
    return (marks - moved[:, None, :, 2]) @ torch.linalg.inv(moved[:, :, :2]).mT


def beside(count: int, random: Generator) -> Tensor:
    """(b, 2, 3) from crops to those that landmarks ask for, both -1..1: some 5 degrees, 5 % and 3 pixels apart."""
    turn, scale = 0.09 * _normal(random, count), 1 + 0.05 * _normal(random, count)
    cos, sin = torch.cos(turn) * scale, torch.sin(turn) * scale
    shift = 0.045 * _normal(random, count, 2)
    return torch.stack([torch.stack([cos, -sin, shift[:, 0]], -1), torch.stack([sin, cos, shift[:, 1]], -1)], 1)


def relight(shown: Scene, random: Generator) -> Tensor:
    """Pictures (b, 3, 128, 128) of sRGB 0..1 in other light, colours, sharpness and surroundings, anew at each call."""
    images = _softened(_surroundings(shown, random), random)
    count = len(images)
    shading = 0.35 * _field(random, count, 1, 3) + 0.08 * _field(random, count, 3, 3)
    gain = 0.25 * _normal(random, count, 1, 1, 1) + 0.12 * _normal(random, count, 3, 1, 1)
    gamma = torch.exp(0.25 * _normal(random, count, 1, 1, 1))
    images = images.clamp(min=1e-3).pow(gamma) * _grown(torch.exp(shading + gain))
    saturation = (1.1 * _uniform(random, count, 1, 1, 1) - 0.1).clamp(min=0)
    images = torch.lerp(images.mean(1, keepdim=True).expand_as(images), images, saturation)
    images = torch.lerp(torch.tensor(0.4), images, torch.exp(0.15 * _normal(random, count, 1, 1, 1)))
    noise = 0.05 * _uniform(random, count, 1, 1, 1) ** 2 * _normal(random, *images.shape)
    return _covered(images + noise, random).clamp(0, 1)


def _surroundings(shown: Scene, random: Generator) -> Tensor:
    """Two in five backgrounds, and hair that is taken away, exchanged for blotches of two sizes."""
    images, count = shown.images, len(shown.images)
    chosen = ((_uniform(random, count, 1, 1) < 0.4) & (shown.classes == 0)) | shown.cleared
    behind = interpolate(chosen[:, None].to(images.dtype), size=images.shape[2:], mode="bilinear")
    blotches = 0.5 + 0.25 * _field(random, count, 3, 4) + 0.15 * _field(random, count, 3, 24)
    return torch.lerp(images, _grown(blotches.clamp(0, 1)), behind)


def _softened(images: Tensor, random: Generator) -> Tensor:
    """Mixed with a blurred copy of itself, two in five."""
    blurred = _grown(avg_pool2d(images, 4))
    return torch.lerp(images, blurred, (_uniform(random, len(images), 1, 1, 1) - 0.6).clamp(min=0) / 0.4)


def _covered(images: Tensor, random: Generator) -> Tensor:
    """A bar of one colour over one in five."""
    count = len(images)
    places = (torch.arange(SIZE) + 0.5) / SIZE
    centre, half = _uniform(random, 2, count, 1), 0.02 + 0.1 * _uniform(random, 2, count, 1)
    inside = (places - centre).abs() < half
    bar = (inside[0][:, :, None] & inside[1][:, None, :])[:, None] & (_uniform(random, count, 1, 1, 1) < 0.2)
    return torch.where(bar, _uniform(random, count, 3, 1, 1), images)


def _field(random: Generator, count: int, channels: int, cells: int) -> Tensor:
    """Smooth noise of deviation about 1, at a quarter of the resolution."""
    coarse = _normal(random, count, channels, cells, cells)
    return interpolate(coarse, size=(SIZE // 4, SIZE // 4), mode="bicubic", align_corners=False)


def _grown(quarter: Tensor) -> Tensor:
    return interpolate(quarter, size=(SIZE, SIZE), mode="bilinear", align_corners=False)


def _normal(random: Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=random)


def _uniform(random: Generator, *shape: int) -> Tensor:
    return torch.rand(*shape, generator=random)
