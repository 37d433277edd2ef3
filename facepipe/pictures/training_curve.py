"""How a training went on: what was left of learned and of watched frames, by step."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.pictures.curves import loss_curves
from facepipe.pictures.face_picture import save_png

WIDTH = 1600
NOTE = "error of frames that are learned and of others, RMS, in shares of what is not straight, by step"


def draw_training_curve(curve: FloatArray, path: Path) -> None:
    """Write a PNG.

    :param curve: (checks, 3) step, learned, watched; without any, the picture says that no steps were made
    :raises InputError: a file that can't be written
    """
    history = []
    if len(curve):
        steps = np.arange(int(curve[-1, 0]) + 1)
        pairs = zip(*(np.interp(steps, curve[:, 0], curve[:, column]).tolist() for column in (1, 2)), strict=True)
        history = [{"learned": one, "watched": other} for one, other in pairs]
    save_png(loss_curves(history, WIDTH, note=NOTE), path)
