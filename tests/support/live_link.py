"""Recordings as Live Link Face writes them, of our own making."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from facepipe.rig.conventions import ARKIT_SHAPES

ANGLES = tuple(f"{part}{angle}" for part in ("Head", "LeftEye", "RightEye") for angle in ("Yaw", "Pitch", "Roll"))
COLUMNS = (*(name[0].upper() + name[1:] for name in sorted(ARKIT_SHAPES)), *ANGLES)


def performance(frames: int, seed: int = 0) -> np.ndarray:
    """(frames, 61) smooth weights 0..1 and angles up to 0.4 rad, in the order of `COLUMNS`, 4 digits."""
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(0.02, 0.15, len(COLUMNS)), rng.uniform(0, 6.28, len(COLUMNS))
    waves = 0.5 + 0.5 * np.sin(np.arange(frames)[:, None] * rate + phase)
    waves[:, -len(ANGLES) :] = 0.8 * waves[:, -len(ANGLES) :] - 0.4
    return np.round(waves, 4)


def timecode(frame: int, fps: int, sub: str = "") -> str:
    """HH:MM:SS:FF of a frame since 11:59:58:00."""
    seconds, left = divmod(frame, fps)
    seconds += 11 * 3600 + 59 * 60 + 58
    return f"{seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}:{left:02}{sub}"


def write(
    path: Path,
    values: np.ndarray,
    fps: int = 60,
    columns: Sequence[str] = COLUMNS,
    frames: Sequence[int] | None = None,
    sub: str = ".250",
    replaced: Mapping[int, str] | None = None,
) -> Path:
    """A recording; `replaced` lines (by number, the header is 1) stand as given."""
    header = ["Timecode", "BlendShapeCount", *columns]
    lines = [",".join(header)]
    for frame, row in zip(range(len(values)) if frames is None else frames, values, strict=True):
        lines.append(",".join([timecode(frame, fps, sub), "61", *(f"{value:.4f}" for value in row)]))
    for number, line in (replaced or {}).items():
        lines[number - 1] = line
    path.write_text("\n".join(lines) + "\n")
    return path
