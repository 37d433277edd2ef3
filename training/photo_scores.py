"""How a landmark network does on real photos: ``python training/photo_scores.py PHOTO... [--network FILE]``.

Each photo has the 68 landmarks of its face beside it, by hand or by another detector, in STEM.landmarks.json. The face
is looked for in the square around it, which is shown in several ways: mirrored, turned, moved, small, bright, dark,
blurred, noisy. Printed, in percent of the distance of the outer eye corners: how far inner and contour landmarks are
off, and how far all of them are from those found in the square as it is, which needs no truth.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from scipy.ndimage import gaussian_filter

from facepipe.geometry.face_crops import from_crop
from facepipe.geometry.landmarks import MIRRORED
from facepipe.networks import find_landmarks, landmark_model
from facepipe.networks.files import sample_crop
from facepipe.photo.fit import read_landmarks, read_photo

FloatArray = npt.NDArray[np.floating]

_SIDE = 240  # pixels of the square
_WIDE = 2.2  # its side over that of the face
_NEAR = 0.3  # of the eye distance: landmarks farther from the truth than this are of something else


def views(marks: FloatArray) -> Iterator[tuple[str, FloatArray, int]]:
    """Names, matrices from the view's pixels to the photo's, and pixels a side of views of a face."""
    low, high = marks.min(axis=0), marks.max(axis=0)
    middle, unit = (low + high) / 2, (high - low).max() * _WIDE / _SIDE

    def seen(linear: FloatArray, shift: tuple[float, float], side: int) -> FloatArray:
        linear = linear * unit
        return np.column_stack([linear, middle + np.array(shift) * unit - linear @ np.full(2, side / 2)])

    for name in ("plain", "bright", "dark", "blurred", "noisy"):
        yield name, seen(np.eye(2), (0, 0), _SIDE), _SIDE
    yield "mirrored", seen(np.diag([-1.0, 1.0]), (0, 0), _SIDE), _SIDE
    for degrees in (-30, -15, 15, 30):
        cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        yield f"turned {abs(degrees)}", seen(np.array([[cos, -sin], [sin, cos]]), (0, 0), _SIDE), _SIDE
    yield "half size", seen(2 * np.eye(2), (0, 0), _SIDE // 2), _SIDE // 2
    for shift in ((28.0, 12.0), (-28.0, -24.0)):
        yield "moved", seen(np.eye(2), shift, _SIDE), _SIDE


def changed(name: str, image: FloatArray) -> FloatArray:
    """The picture (h, w, 3) in other light, or by a worse camera."""
    changes = {
        "bright": lambda: image**0.5,
        "dark": lambda: 0.6 * image**2,
        "blurred": lambda: gaussian_filter(image, (2, 2, 0)),
        "noisy": lambda: image + np.random.default_rng(0).normal(0, 0.08, image.shape),
    }
    return np.clip(changes[name](), 0, 1) if name in changes else image


def scores(photo: Path, network: Path) -> list[tuple[str, FloatArray, int]]:
    """View -> (3,) errors, NaN where the face was missed, and the number of faces found where none is."""
    shown = read_photo(photo)
    truth = read_landmarks(photo.with_suffix(".landmarks.json"), shown).points
    across, pixels = np.linalg.norm(truth[36] - truth[45]), torch.as_tensor(shown.pixels, dtype=torch.float32)
    rows, plain = [], np.full((68, 2), np.nan)
    for name, matrix, side in views(truth):
        image = changed(name, sample_crop(pixels, matrix, side)[0].permute(1, 2, 0).numpy())
        found = [from_crop(face.landmarks, matrix) for face in find_landmarks(image, network)]
        found = [marks[MIRRORED] if name == "mirrored" else marks for marks in found]
        off = [np.linalg.norm(marks - truth, axis=1) / across for marks in found]
        hits = [i for i, one in enumerate(off) if one[17:].mean() < _NEAR]
        errors = np.full(3, np.nan)
        if hits:
            best = min(hits, key=lambda i: float(off[i].mean()))
            plain = found[best] if name == "plain" else plain
            moved = np.linalg.norm(found[best] - plain, axis=1).mean() / across if name != "plain" else np.nan
            errors = np.array([off[best][17:].mean(), off[best][:17].mean(), moved])
        rows.append((name, errors, len(found) - bool(hits)))
    return rows


def line(name: str, rows: list[tuple[str, FloatArray, int]]) -> str:
    """The mean of some rows of `scores`."""
    table = np.array([errors for _, errors, _ in rows])
    count = int(np.isfinite(table[:, 0]).sum())
    means = [column[np.isfinite(column)] for column in table.T]
    shown = "".join(f"{100 * column.mean():9.2f}" if len(column) else f"{'-':>9s}" for column in means)
    return f"{name:28s}{count:4d} of {len(rows):3d}{shown}{sum(false for *_, false in rows):7d}"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Score a landmark network on real photos.")
    parser.add_argument("photos", type=Path, nargs="+", help="pictures with STEM.landmarks.json beside them")
    parser.add_argument("--network", type=Path, default=landmark_model(), help="ONNX file (default facepipe's own)")
    options = parser.parse_args()
    every: list[tuple[str, FloatArray, int]] = []
    print(f"{'':28s}{'found':>11s}{'inner':>9s}{'contour':>9s}{'steady':>9s}{'false':>7s}")
    for photo in options.photos:
        rows = scores(photo, options.network)
        print(line(photo.name, rows), flush=True)
        every += rows
    for name in dict.fromkeys(name for name, *_ in every):
        print(line(name, [row for row in every if row[0] == name]))
    print(line("all", every))


if __name__ == "__main__":
    main()
