"""What heads wear: hair and clothes, as triangles behind the head's own."""

from __future__ import annotations

from dataclasses import dataclass

import head_sources as heads
import numpy as np
import numpy.typing as npt
import torch
from styles import Style, hair_height

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

HAIR = 100  # what a triangle of hair shows, beside the kinds of `head_sources`


@dataclass(frozen=True)
class Dress:
    """Hair and clothes."""

    points: torch.Tensor
    normals: torch.Tensor
    triangles: torch.Tensor  # numbered behind the head's points
    kinds: IntArray
    canonical: FloatArray


def dressed(topology: heads.Topology, points: torch.Tensor, normals: torch.Tensor, style: Style) -> Dress:
    canonical = topology.canonical
    cloth, cloth_normals, cloth_triangles = _shoulders(style)
    pieces = [(cloth, cloth_normals, cloth_triangles, cloth.numpy().astype(np.float64), heads.CLOTH)]
    inside = hair_height(style, canonical)
    skin = topology.triangles[torch.as_tensor(topology.kinds == heads.SKIN)]
    covered = (inside[skin.numpy()] > -0.8).any(axis=1)
    if covered.any():
        used, flat = np.unique(skin.numpy()[covered], return_inverse=True)
        at = canonical[used]
        lumps = 0.6 + 0.8 * style.noises[2](np.arctan2(at[:, 0], at[:, 2]) * 2.5 + 9, at[:, 1] * 0.25)
        rise = style.thickness * lumps * np.clip((inside[used] + 0.4) / 3, 0, 1) ** 0.7 + 0.08
        shell = points[used] + normals[used] * torch.as_tensor(rise, dtype=torch.float32)[:, None]
        pieces.append((shell, normals[used], torch.as_tensor(flat.reshape(-1, 3)), at, HAIR))
    if style.curtain < 4:
        pieces.append((*_curtain(style), HAIR))
    first = len(points)
    triangles, kinds = [], []
    for own, _, faces, _, kind in pieces:
        triangles.append(faces + first)
        kinds.append(np.full(len(faces), kind))
        first += len(own)
    return Dress(
        torch.cat([one[0] for one in pieces]),
        torch.cat([one[1] for one in pieces]),
        torch.cat(triangles),
        np.concatenate(kinds),
        np.concatenate([one[3] for one in pieces]),
    )


def _grid(rows: int, columns: int) -> torch.Tensor:
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    return torch.as_tensor(
        np.concatenate(
            [
                np.column_stack([first, first + columns, first + 1]),
                np.column_stack([first + 1, first + columns, first + columns + 1]),
            ]
        )
    )


def _shoulders(style: Style) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A collar and what is below it, as rings."""
    levels = np.linspace(0, 1, 9)[:, None]
    angle = np.linspace(-np.pi, np.pi, 33)[None]
    y = style.collar - 22 * levels + 0 * angle
    wide = 6.6 + 1.5 * levels + 17 * np.clip((levels - 0.2) / 0.8, 0, 1) ** 0.7
    deep = 6.6 + 1.2 * levels + 6 * np.clip((levels - 0.2) / 0.8, 0, 1)
    points = np.stack([wide * np.sin(angle), y + 1.2 * np.cos(angle) * -1, deep * np.cos(angle) - 1.0], axis=-1)
    normals = np.stack([np.sin(angle) + 0 * levels, 0.45 + 0 * y, np.cos(angle) + 0 * levels], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return *(torch.as_tensor(one.reshape(-1, 3), dtype=torch.float32) for one in (points, normals)), _grid(9, 33)


def _curtain(style: Style) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, FloatArray]:
    """Long hair: a sheet around the head that is open in front."""
    levels = np.linspace(0, 1, 14)[:, None]
    angle = np.linspace(style.curtain, 2 * np.pi - style.curtain, 41)[None]
    y = 9.0 - levels * 24 + 0 * angle
    swell = style.thickness * 0.6 + 0.5 * (style.noises[2](angle * 3 + 0 * levels, y * 0.2) - 0.3)
    wide = 8.7 + swell - 2.5 * np.clip(0.35 - levels, 0, 1) * 3
    points = np.stack([wide * np.sin(angle), y, wide * 1.05 * np.cos(angle) + 1.0], axis=-1).reshape(-1, 3)
    normals = np.stack([np.sin(angle) + 0 * y, 0.1 + 0 * y, np.cos(angle) + 0 * y], axis=-1).reshape(-1, 3)
    canonical = points.copy()
    canonical[:, 1] += 40  # inside the hair whatever the hairline
    tensors = (torch.as_tensor(one, dtype=torch.float32) for one in (points, normals))
    return *tensors, _grid(14, 41), canonical
