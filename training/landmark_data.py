"""Shards of `heads.py` as batches for the landmark network: turned, mirrored, recoloured, covered, scrambled."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from landmark_network import MEAN, SIZE, STD
from torch import Tensor
from torch.nn.functional import affine_grid, avg_pool2d, grid_sample

from facepipe.geometry.landmarks import MIRRORED

FloatArray = npt.NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class Heads:
    """Pictures and what is known of them."""

    images: npt.NDArray[np.uint8]  # (n, S, S, 3)
    landmarks: FloatArray  # (n, 68, 2) in 0..1, NaN where unknown
    presence: FloatArray  # (n,) 0, 0.5 or 1


@dataclass(frozen=True, kw_only=True)
class Batch:
    """What one step learns from."""

    images: Tensor  # (b, 3, 96, 96) normalised
    landmarks: Tensor  # (b, 68, 2)
    known: Tensor  # (b, 68) weights of the landmarks
    presence: Tensor  # (b,)
    judged: Tensor  # (b,) weights of the presence


def read(folder: Path, numbers: range) -> Heads:
    """Shards by number."""
    shards = []
    for number in numbers:
        with np.load(folder / f"shard_{number:03d}.npz") as data:
            shards.append((data["image"], data["landmarks"] / data["image"].shape[1], data["presence"]))
    images, landmarks, presence = (np.concatenate(column) for column in zip(*shards, strict=True))
    return Heads(images=images, landmarks=landmarks, presence=presence)


def plain(heads: Heads, rows: npt.NDArray[np.integer]) -> Batch:
    """Pictures as they are."""
    return _batch(heads, rows, torch.eye(2).expand(len(rows), 2, 2), torch.zeros(len(rows), 2))


def varied(heads: Heads, rows: npt.NDArray[np.integer], rng: np.random.Generator) -> Batch:
    """Pictures as they might have been taken as well."""
    count = len(rows)
    angle, zoom = rng.uniform(-0.3, 0.3, count), 2 ** rng.uniform(-0.25, 0.3, count)
    mirrored = rng.random(count) < 0.5
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=1).reshape(-1, 2, 2)
    turn = turn / zoom[:, None, None]
    turn[mirrored, :, 0] *= -1
    shift = rng.uniform(-0.12, 0.12, (count, 2))
    batch = _batch(heads, rows, *(torch.as_tensor(one, dtype=torch.float32) for one in (turn, shift)))
    landmarks, known = batch.landmarks.clone(), batch.known.clone()
    flip = torch.as_tensor(mirrored)
    landmarks[flip], known[flip] = landmarks[flip][:, MIRRORED], known[flip][:, MIRRORED]
    images = _cut(covered(recolored(batch.images, rng), rng), rng)
    presence, judged = batch.presence.clone(), batch.judged.clone()
    for i in np.flatnonzero(rng.random(count) < 0.07):
        images[i] = _scrambled(images[i], rng)
        known[i], presence[i], judged[i] = 0, 0, 1
    return Batch(images=images, landmarks=landmarks, known=known, presence=presence, judged=judged)


def _batch(heads: Heads, rows: npt.NDArray[np.integer], turn: Tensor, shift: Tensor) -> Batch:
    """Crops whose places p in -1..1 read the pictures at ``turn p + shift``."""
    pixels = torch.as_tensor(heads.images[rows]).permute(0, 3, 1, 2).float() / 255
    grid = affine_grid(torch.cat([turn, shift[..., None]], dim=2), [len(rows), 3, SIZE, SIZE], align_corners=False)
    images = grid_sample(pixels, grid, "bilinear", "border", align_corners=False)
    landmarks = torch.as_tensor(heads.landmarks[rows], dtype=torch.float32)
    landmarks = ((landmarks * 2 - 1 - shift[:, None]) @ torch.linalg.inv(turn).mT + 1) / 2
    known = ((landmarks > 0.01) & (landmarks < 0.99)).all(dim=2).float()
    known[known.mean(dim=1) < 0.4] = 0
    presence = torch.as_tensor(heads.presence[rows], dtype=torch.float32)
    return Batch(
        images=(images - MEAN) / STD,
        landmarks=landmarks.nan_to_num(),
        known=known * torch.where(presence == 1, 1.0, 0.3)[:, None],
        presence=(presence > 0.5).float(),
        judged=(presence != 0.5).float(),
    )


def recolored(images: Tensor, rng: np.random.Generator) -> Tensor:
    """In other light, some without colours, some blurred."""
    count, device = len(images), images.device

    def numbers(low: float, high: float, channels: int = 1) -> Tensor:
        return torch.as_tensor(rng.uniform(low, high, (count, channels, 1, 1)), dtype=torch.float32, device=device)

    def some(share: float) -> Tensor:
        return torch.as_tensor(rng.random((count, 1, 1, 1)) < share, device=device)

    images = images * numbers(0.75, 1.3) * numbers(0.9, 1.1, 3) + numbers(-0.35, 0.35) + numbers(-0.15, 0.15, 3)
    images = torch.where(some(0.12), images.mean(dim=1, keepdim=True), images)
    return torch.where(some(0.15), avg_pool2d(images, 3, 1, 1, count_include_pad=False), images)


def covered(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Some with a rectangle in front."""
    count, size = len(images), images.shape[-1]
    sides = rng.integers(size // 12, size * 2 // 5, (2, count, 1))
    start = (rng.random(sides.shape) * (size - sides)).astype(int)
    along = np.arange(size)
    inside = (along >= start) & (along < start + sides) & (rng.random((count, 1)) < 0.25)  # down, and across
    color, noise = rng.normal(0, 1, (count, 3, 1, 1)), 0.3 * rng.random((count, 1, 1, 1))
    mask, color, noise = (
        torch.as_tensor(one, device=images.device) for one in (inside, np.float32(color), np.float32(noise))
    )
    there = (mask[0, :, :, None] & mask[1, :, None])[:, None]
    return torch.where(there, color + noise * torch.randn_like(images), images)


def _cut(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Pictures that end within the crop: from there on its last pixels go on, or one colour."""
    for i in np.flatnonzero(rng.random(len(images)) < 0.2):
        turn, flip = rng.random() < 0.6, rng.random() < 0.5
        image = images[i].mT if turn else images[i]  # cut from side to side, or from above or below
        image = image.flip(1) if flip else image
        end = int(rng.integers(2, SIZE * 9 // 20))
        plain = torch.as_tensor(rng.normal(0, 1.2, (3, 1, 1)), dtype=torch.float32)
        image[:, :end] = plain if rng.random() < 0.4 else image[:, end : end + 1].clone()
        image = image.flip(1) if flip else image
        images[i] = image.mT if turn else image
    return images


def _scrambled(image: Tensor, rng: np.random.Generator) -> Tensor:
    """No face any more: upside down, or its tiles exchanged."""
    if rng.random() < 0.3:
        return image.flip(1)
    parts = int(rng.choice([2, 3, 4]))
    side = SIZE // parts
    order = rng.permutation(parts * parts)
    while (order == np.arange(parts * parts)).mean() > 0.3:
        order = rng.permutation(parts * parts)
    result = image.clone()
    for to, source in enumerate(order):
        (a, b), (c, d) = divmod(to, parts), divmod(int(source), parts)
        result[:, a * side : (a + 1) * side, b * side : (b + 1) * side] = image[
            :, c * side : (c + 1) * side, d * side : (d + 1) * side
        ]
    return result
