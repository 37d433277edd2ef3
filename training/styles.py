"""How a random person looks: skin, brows, lips, hair, clothes; all of it noise and formulas, nothing of a photo."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import torch
from torch.nn.functional import grid_sample

FloatArray = npt.NDArray[np.floating]

_SKINS = np.array(
    [
        (0.82, 0.60, 0.50),
        (0.72, 0.47, 0.36),
        (0.60, 0.36, 0.26),
        (0.42, 0.23, 0.15),
        (0.24, 0.12, 0.075),
        (0.10, 0.055, 0.038),
    ]
)
_HAIRS = np.array(
    [
        (0.012, 0.010, 0.009),
        (0.035, 0.020, 0.012),
        (0.10, 0.050, 0.025),
        (0.22, 0.12, 0.05),
        (0.45, 0.30, 0.14),
        (0.25, 0.07, 0.02),
        (0.35, 0.34, 0.33),
        (0.75, 0.72, 0.68),
    ]
)
_IRISES = np.array([(0.03, 0.015, 0.008), (0.08, 0.04, 0.015), (0.10, 0.16, 0.22), (0.10, 0.14, 0.06)])
_CLOTHES = np.array([(0.02, 0.02, 0.03), (0.8, 0.8, 0.8), (0.7, 0.12, 0.03), (0.05, 0.1, 0.3), (0.2, 0.2, 0.2)])


class Noise:
    """Smooth values 0..1 on a plane, from a lattice of random numbers."""

    def __init__(self, rng: np.random.Generator, size: int = 64) -> None:
        self._lattice = torch.as_tensor(rng.random((1, 1, size, size)), dtype=torch.float32)
        self._size = size

    def __call__(self, u: FloatArray, v: FloatArray) -> FloatArray:
        """Values at lattice coordinates, repeating beyond the lattice's size."""
        size = self._size
        places = np.stack([u % (size - 1), v % (size - 1)], axis=-1) / (size - 1) * 2 - 1
        grid = torch.as_tensor(places, dtype=torch.float32).reshape(1, 1, -1, 2)
        return grid_sample(self._lattice, grid, align_corners=True).numpy().reshape(u.shape)


@dataclass(frozen=True)
class Style:
    """How one person looks."""

    skin: FloatArray
    hair: FloatArray
    brow: FloatArray  # colour
    iris: FloatArray
    lips: FloatArray  # factor of the skin's colour
    brow_shape: FloatArray  # strength, thickness, rise, tail
    beard: float  # 0 none .. 1 full
    stubble: float
    freckles: float
    wrinkles: float
    makeup: float
    hairline: FloatArray  # heights of the hair's edge at 0, 35, 60, 85, 110 and 180 degrees from the front
    parting: float  # how much the hairline differs between the sides
    thickness: float  # of the hair, units of the common frame
    strands: float  # how ragged its edge is
    curtain: float  # azimuth, radians, beyond which long hair hangs down; above pi: short hair
    cap: bool  # a cap or a scarf in place of hair
    cloth: FloatArray
    collar: float  # height of the cloth's edge
    noises: tuple[Noise, ...] = field(repr=False, default=())


def random_style(rng: np.random.Generator) -> Style:
    """A random look."""
    tone = rng.uniform(0, len(_SKINS) - 1.001)
    low = int(tone)
    skin = _SKINS[low] + (tone - low) * (_SKINS[low + 1] - _SKINS[low])
    dark = tone > 3
    hair = _HAIRS[rng.integers(3) if dark and rng.random() < 0.85 else rng.integers(len(_HAIRS))]
    hair = hair * rng.uniform(0.6, 1.5) * rng.uniform(0.9, 1.1, 3)
    fringe = rng.random()
    front = rng.uniform(6.3, 8.2) if fringe < 0.35 else rng.uniform(8.2, 11.5)
    hairline = np.array(
        [front, front + rng.uniform(-1.2, 0.6), rng.uniform(3.5, 8.5), rng.uniform(-1.5, 6.5), 2.0, -9.0]
    )
    hairline[4] = min(hairline[3], rng.uniform(-8, 5))
    hairline[5] = rng.uniform(-11, -3)
    bald = rng.random() < 0.08
    hairline = hairline + 20 * bald * (rng.random() < 0.6) + 4 * bald
    long = rng.random() < 0.35 and not bald
    return Style(
        skin=np.clip(skin * rng.uniform(0.85, 1.15) * rng.uniform(0.93, 1.07, 3), 0.02, 0.9),
        hair=np.clip(hair, 0.004, 0.9),
        brow=np.clip(hair * rng.uniform(0.3, 1.0), 0.004, 0.5),
        iris=_IRISES[rng.integers(len(_IRISES))] * rng.uniform(0.6, 1.6),
        lips=np.array([1.0, 0.62, 0.62]) ** rng.uniform(0.2, 1.6) * rng.uniform(0.75, 1.05),
        brow_shape=np.array(
            [rng.uniform(0.25, 1), rng.uniform(0.2, 0.55), rng.uniform(-0.25, 0.12), rng.uniform(-0.4, 0.7)]
        ),
        beard=rng.uniform(0.4, 1) if rng.random() < 0.13 else 0.0,
        stubble=rng.uniform(0, 0.6) if rng.random() < 0.3 else 0.0,
        freckles=rng.uniform(0, 1) if rng.random() < 0.2 else 0.0,
        wrinkles=rng.uniform(0, 1) if rng.random() < 0.6 else 0.0,
        makeup=rng.uniform(0, 1) if rng.random() < 0.4 else 0.0,
        hairline=hairline,
        parting=rng.normal(0, 0.9),
        thickness=rng.uniform(0.1, 0.5) if rng.random() < 0.3 else rng.uniform(0.5, 3.2),
        strands=rng.uniform(0.2, 1.6),
        curtain=rng.uniform(0.75, 1.7) if long else 9.0,
        cap=bool(rng.random() < 0.05),
        cloth=_CLOTHES[rng.integers(len(_CLOTHES))] * rng.uniform(0.4, 1.4, 3) + rng.uniform(0, 0.15, 3),
        collar=rng.uniform(-17, -9),
        noises=tuple(Noise(rng) for _ in range(4)),
    )


def hair_height(style: Style, points: FloatArray) -> FloatArray:
    """(n,) how far points (n, 3) of the common frame lie within the hair, by height; negative outside."""
    angle = np.arctan2(points[:, 0], points[:, 2] - 1.0)
    around = np.abs(angle)
    edge = np.interp(around, np.radians([0, 35, 60, 85, 110, 180]), style.hairline)
    edge = edge + style.parting * np.sin(1.5 * angle) * (around < 1.6)
    strand = style.noises[0](angle * 22 + points[:, 1] * 0.25, points[:, 1] * 0.12 + 5.0) - 0.5
    strand = strand + 0.6 * (style.noises[1](angle * 60, points[:, 1] * 0.2) - 0.5)
    return points[:, 1] - edge + strand * style.strands * 1.6 * (not style.cap)


def is_neck(points: FloatArray) -> npt.NDArray[np.bool_]:
    """(n,) whether points (n, 3) of the common frame lie below the jaw."""
    jaw = np.interp(points[:, 2], [0, 4.5, 6.0, 7.3, 8.8, 10.4], [-3, -3.5, -5.2, -6.7, -7.4, -8.1])
    return np.asarray(points[:, 1] < jaw)
