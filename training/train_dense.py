"""Trains the network of many landmarks: ``python training/train_dense.py DATA -o OUT.onnx --shards 24 --seed 0``.

DATA is what `dense_heads.py` wrote: renders of synthetic heads, no photo. The first shard, with persons of its own, is
held out; its scores go into the file's metadata.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from dense_heads import pupils
from descent import descend
from landmark_data import covered, recolored
from landmark_export import dense_onnx
from landmark_network import MEAN, STD, DenseNetwork
from scipy.spatial import cKDTree
from script_arguments import add_training
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from facepipe.core.atomic import write_bytes
from facepipe.geometry.landmarks import MIRRORED
from facepipe.heads.asset import asset
from facepipe.learn.features.crops import face_crop, to_crop

_BATCH = 16
_ZOOM = 1.2  # beyond the aligned crop: no pixel for what is beside a face
_TURN, _SCALE, _SHIFT = 0.06, 0.06, 0.025  # deviations of crops: radians, logarithm, share of a side

FloatArray = npt.NDArray[np.floating]


class Heads:
    """Pictures and their points."""

    def __init__(self, folder: Path, numbers: range) -> None:
        shards = [np.load(folder / f"dense_{number:03d}.npz") for number in numbers]
        self.images = np.concatenate([shard["image"] for shard in shards])  # (n, S, S, 3) uint8
        self.points = np.concatenate([shard["points"] for shard in shards])  # (n, p, 2) pixels

    def batch(self, rows: npt.NDArray[np.integer], rng: np.random.Generator | None) -> tuple[Tensor, Tensor]:
        """Normalised crops (b, 3, 192, 192) and their points (b, p, 2) in 0..1; varied where there is a generator."""
        side, size = self.images.shape[1], DenseNetwork.SIZE
        matrices = np.stack([face_crop(self.points[row, :68], size) for row in rows])
        mirror = np.zeros(len(rows), bool) if rng is None else rng.random(len(rows)) < 0.5
        for matrix, flip in zip(matrices, mirror, strict=True):
            middle = matrix @ (size / 2, size / 2, 1)
            turn, scale, shift = (0.0, 0.0, np.zeros(2))
            if rng is not None:
                turn, scale, shift = rng.normal(0, _TURN), rng.normal(0, _SCALE), rng.normal(0, _SHIFT, 2) * size
            cos, sin = np.exp(scale) / _ZOOM * np.array([np.cos(turn), np.sin(turn)])
            matrix[:, :2] = matrix[:, :2] @ [[cos, -sin], [sin, cos]] @ np.diag([-1.0 if flip else 1.0, 1.0])
            matrix[:, 2] = middle - matrix[:, :2] @ (size / 2 + shift)
        linear, origin = matrices[:, :, :2], matrices[:, :, 2]
        points = np.stack([to_crop(*pair) for pair in zip(self.points[rows], matrices, strict=True)])
        points[mirror] = points[mirror][:, mirrored_rows()]
        shift = (2 * (origin + linear @ np.full(2, size / 2)) / side) - 1
        grid = affine_grid(
            torch.as_tensor(np.concatenate([linear * size / side, shift[..., None]], axis=2), dtype=torch.float32),
            [len(rows), 3, size, size],
            align_corners=False,
        )
        pixels = torch.as_tensor(self.images[rows]).permute(0, 3, 1, 2).float() / 255
        images = (grid_sample(pixels, grid, "bilinear", "border", align_corners=False) - MEAN) / STD
        if rng is not None:
            images = covered(recolored(images, rng), rng)
        return images, torch.as_tensor(points / size, dtype=torch.float32)


def mirrored_rows() -> list[int]:
    """For each landmark that of the other side."""
    places = asset().points[[*asset().dense, *pupils()]]
    return [*MIRRORED, *(68 + cKDTree(places).query(places * [-1, 1, 1])[1])]


def expected_error_loss(network: DenseNetwork, images: Tensor, points: Tensor) -> Tensor:
    """How likely points are where the network expects them: distances have Laplace distributions in the plane."""
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found, doubt = network(images)
    known = ((points > 0) & (points < 1)).all(dim=2)
    error = ((found - points) * network.SIZE).norm(dim=2)[known]
    doubt = doubt[known]
    return (error * torch.exp(-doubt) + 2 * doubt).mean() + 0.2 * error.mean()


def scores(network: DenseNetwork, heads: Heads) -> dict[str, float]:
    """Mean errors over the distance of the outer eye corners, on pictures as they are."""
    rows = []
    with torch.no_grad():
        for start in range(0, len(heads.images), 50):
            images, points = heads.batch(np.arange(start, min(start + 50, len(heads.images))), None)
            found, doubt = network(images)
            across = (points[:, 36] - points[:, 45]).norm(dim=1, keepdim=True)
            rows.append(torch.stack([(found - points).norm(dim=2) / across, 2 * doubt.exp() / network.SIZE / across]))
    error, doubt = torch.cat(rows, dim=1)
    ends = {"contour": (0, 17), "inner": (17, 68), "eyes": (36, 48), "mouth": (48, 68), "dense": (68, None)}
    parts = {name: slice(*pair) for name, pair in ends.items()}
    result = {f"nme_{name}": round(error[:, part].mean().item(), 4) for name, part in parts.items()}
    return {**result, "expected": round(doubt.mean().item(), 4), "pictures": len(heads.images)}


def batches(heads: Heads, rng: np.random.Generator) -> Iterator[tuple[Tensor, Tensor]]:
    """Varied pictures in random order, without end."""
    while True:
        order = rng.permutation(len(heads.images))
        for start in range(0, len(order) - _BATCH + 1, _BATCH):
            yield heads.batch(order[start : start + _BATCH], rng)


def train(heads: Heads, steps: int, seed: int, keep: Callable[[DenseNetwork, int], None]) -> DenseNetwork:
    """A network after so many steps of Adam, its rate rising and falling once; `keep` gets it on the way."""
    torch.manual_seed(seed)
    network = DenseNetwork(heads.points.shape[1]).to(memory_format=torch.channels_last)
    drawn = batches(heads, np.random.default_rng(seed))
    return descend(network, lambda batch: expected_error_loss(network, *batch), drawn, steps, keep)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Train the network of many landmarks on renders of random heads.")
    parser.add_argument("data", type=Path, help="folder of shards that dense_heads.py wrote")
    parser.add_argument("--shards", type=int, default=24, help="how many of them; the first is held out")
    add_training(parser, steps=8000, batch=f"{_BATCH} pictures")
    options = parser.parse_args()
    torch.set_num_threads(1)
    held_out = Heads(options.data, range(1))

    def keep(network: DenseNetwork, step: int) -> None:
        found = scores(network.eval(), held_out)
        print(step, found, flush=True)
        write_bytes(options.out, dense_onnx(network, metadata(options, found)))
        network.train()

    heads = Heads(options.data, range(1, options.shards))
    keep(train(heads, options.steps, options.seed, keep), options.steps)


def metadata(options: argparse.Namespace, found: dict[str, float]) -> dict[str, object]:
    """What the file says of itself."""
    command = f"python training/train_dense.py DATA -o {options.out.name} --shards {options.shards}"
    return {
        "kind": "dense-landmarks",
        "size": DenseNetwork.SIZE,
        "zoom": _ZOOM,
        "mirrored": [int(row) for row in mirrored_rows()],
        "mean": [MEAN] * 3,
        "std": [STD] * 3,
        "order": "RGB",
        "crop": "face",
        "trained_on": "synthetic heads: renders of people drawn from facepipe's head (of ICT-FaceKit, MIT); no photos",
        "training": f"{command} --steps {options.steps} --seed {options.seed}",
        "data": f"python training/dense_heads.py DATA --count {300 * options.shards} --seed 4",
        "seed": options.seed,
        "held_out": found,
    }


if __name__ == "__main__":
    main()
