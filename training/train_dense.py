"""Trains the network of many landmarks: ``python training/train_dense.py DATA -o OUT.onnx --shards 240 --seed 0``.

DATA is what `dense_heads.py` wrote: renders of synthetic heads, no photo. The first shard, with persons of its own, is
held out; its scores go into the file's metadata.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable, Container
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from dense_heads import SHARD, pupils
from descent import descend
from landmark_data import covered, recolored
from landmark_export import dense_onnx
from landmark_network import MEAN, STD, DenseNetwork
from packed_weights import packed
from scipy.spatial import cKDTree
from script_arguments import add_training
from shards import Shards, batches
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from facepipe.core.atomic import write_bytes
from facepipe.geometry.face_crops import face_crop
from facepipe.geometry.landmarks import MIRRORED
from facepipe.heads.asset import asset

_BATCH = 128
_ZOOM = 1.2  # beyond the aligned crop: no pixel for what is beside a face
_TURN, _SCALE, _SHIFT = 0.06, 0.06, 0.025  # deviations of crops: radians, logarithm, share of a side

FloatArray = npt.NDArray[np.floating]


class Heads(Shards):
    """Pictures and their points, on the device of a training."""

    def __init__(self, folder: Path, numbers: Container[int], device: str) -> None:
        super().__init__(folder, "dense", numbers, device, _shard)

    @property
    def points(self) -> Tensor:
        """(n, p, 2) pixels."""
        return self.columns[1]

    def batch(self, rows: npt.NDArray[np.integer], rng: np.random.Generator | None) -> tuple[Tensor, Tensor]:
        """Normalised crops (b, 3, 192, 192) and their points (b, p, 2) in 0..1; varied where there is a generator."""
        side, size, count = self.images.shape[1], DenseNetwork.SIZE, len(rows)
        at = torch.as_tensor(rows, device=self.device)
        turn, scale, shift, mirror = np.zeros(count), np.zeros(count), np.zeros((count, 2)), np.zeros(count, bool)
        if rng is not None:
            turn, scale = rng.normal(0, _TURN, count), rng.normal(0, _SCALE, count)
            shift, mirror = rng.normal(0, _SHIFT, (count, 2)), rng.random(count) < 0.5
        length = np.exp(scale) / _ZOOM
        cos, sin, flip = length * np.cos(turn), length * np.sin(turn), np.where(mirror, -1.0, 1.0)
        change = self.tensor(np.stack([cos * flip, -sin, sin * flip, cos], axis=1).reshape(-1, 2, 2))
        matrices = self.columns[2][at]  # (b, 2, 3) from aligned crops
        linear = matrices[:, :, :2] @ change
        middle = matrices[:, :, :2].sum(dim=2) * size / 2 + matrices[:, :, 2]
        middle = middle - (linear @ self.tensor(shift * size)[..., None])[..., 0]  # of the crop, in pixels
        points = (self.points[at] - middle[:, None]) @ torch.linalg.inv(linear).mT / size + 0.5
        flipped = torch.as_tensor(mirror, device=self.device)
        points = torch.where(flipped[:, None, None], points[:, mirrored_rows()], points)
        theta = torch.cat([linear * size / side, (2 * middle / side - 1)[..., None]], dim=2)
        grid = affine_grid(theta, [count, 3, size, size], align_corners=False)
        pixels = self.images[at].permute(0, 3, 1, 2).float() / 255
        images = (grid_sample(pixels, grid, "bilinear", "border", align_corners=False) - MEAN) / STD
        return (images if rng is None else covered(recolored(images, rng), rng)), points


def _shard(path: Path) -> tuple[npt.NDArray[np.uint8], FloatArray, FloatArray]:
    """Pictures, their points, and where their aligned crops lie."""
    with np.load(path) as data:
        images, points = data["image"], data["points"]
    matrices = np.stack([face_crop(one[:68], DenseNetwork.SIZE) for one in points])
    return images, points, matrices.astype(np.float32)


@cache
def mirrored_rows() -> list[int]:
    """For each landmark that of the other side."""
    places = asset().points[[*asset().dense, *pupils()]]
    return [*MIRRORED, *(68 + cKDTree(places).query(places * [-1, 1, 1])[1])]


def expected_error_loss(network: DenseNetwork, images: Tensor, points: Tensor) -> Tensor:
    """How likely points are where the network expects them: distances have Laplace distributions in the plane."""
    kind = images.device.type
    with torch.autocast(kind, dtype=torch.bfloat16, enabled=kind == "cuda"):  # many processors have no bfloat16
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


def train(heads: Heads, steps: int, seed: int, keep: Callable[[DenseNetwork, int], None]) -> DenseNetwork:
    """A network after so many steps of Adam, its rate rising and falling once; `keep` gets it on the way."""
    torch.manual_seed(seed)
    network = DenseNetwork(heads.points.shape[1]).to(heads.device, memory_format=torch.channels_last)
    drawn = batches(heads, _BATCH, np.random.default_rng(seed))
    return descend(network, lambda batch: expected_error_loss(network, *batch), drawn, steps, keep)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Train the network of many landmarks on renders of random heads.")
    parser.add_argument("data", type=Path, help="folder of shards that dense_heads.py wrote")
    parser.add_argument("--shards", type=int, default=240, help="how many of them; the first is held out")
    parser.add_argument("--device", default="cuda", help="of torch (default cuda)")
    add_training(parser, steps=20000, batch=f"{_BATCH} pictures")
    options = parser.parse_args()
    torch.set_num_threads(1)
    held_out = Heads(options.data, range(1), options.device)

    def keep(network: DenseNetwork, step: int) -> None:
        found = scores(network.eval(), held_out)
        print(step, found, flush=True)
        write_bytes(options.out, packed(dense_onnx(copy.deepcopy(network).cpu(), metadata(options, found))))
        network.train()

    heads = Heads(options.data, range(1, options.shards), options.device)
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
        "data": f"python training/dense_heads.py DATA --count {SHARD * options.shards} --seed 4",
        "seed": options.seed,
        "held_out": found,
    }


if __name__ == "__main__":
    main()
