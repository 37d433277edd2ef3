"""Trains the network that tells face, hair and the rest: ``python training/train_mask.py DATA -o OUT.onnx --seed 0``.

DATA is what `mask_heads.py` wrote: renders of synthetic heads, no photo. The first shard, with persons of its own, is
held out; its scores go into the file's metadata.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable, Container
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from descent import descend
from landmark_data import recolored
from landmark_export import mask_onnx
from landmark_network import MEAN, STD, MaskNetwork
from mask_heads import SHARD
from packed_weights import packed
from script_arguments import add_training
from shards import Shards, batches
from torch import Tensor
from torch.nn.functional import affine_grid, avg_pool2d, grid_sample, log_softmax

from facepipe.core.atomic import write_bytes

_BATCH = 128
_TURN, _SMALLEST, _SHIFT = 0.15, 0.65, 0.12  # of windows: radians, share of a picture's side, and of theirs


class Heads(Shards):
    """Pictures and what they show, on the device of a training."""

    def __init__(self, folder: Path, numbers: Container[int], device: str) -> None:
        super().__init__(folder, "mask", numbers, device, _shard)

    def batch(self, rows: npt.NDArray[np.integer], rng: np.random.Generator | None) -> tuple[Tensor, Tensor]:
        """Normalised windows (b, 3, 192, 192) and shares of the classes in them (b, 3, 96, 96)."""
        size, count = MaskNetwork.SIZE, len(rows)
        turn, scale, shift = np.zeros(count), np.ones(count), np.zeros((count, 2))
        flip = np.ones(count)
        if rng is not None:
            turn, scale = rng.normal(0, _TURN, count), rng.uniform(_SMALLEST, 1.05, count)
            shift, flip = rng.normal(0, _SHIFT, (count, 2)), rng.choice([-1.0, 1.0], count)
        cos, sin = scale * np.cos(turn), scale * np.sin(turn)
        theta = np.stack([cos * flip, -sin, shift[:, 0], sin * flip, cos, shift[:, 1]], axis=1).reshape(-1, 2, 3)
        grid = affine_grid(self.tensor(theta), [count, 3, size, size], align_corners=False)
        at = torch.as_tensor(rows, device=self.device)
        images, shares = (column[at].permute(0, 3, 1, 2).float() / 255 for column in self.columns)
        images = (grid_sample(images, grid, "bilinear", "border", align_corners=False) - MEAN) / STD
        shares = avg_pool2d(grid_sample(shares, grid, "bilinear", "border", align_corners=False), 2)
        other = (1 - shares.sum(dim=1, keepdim=True)).clamp(min=0)
        return images if rng is None else recolored(images, rng), torch.cat([shares, other], dim=1)


def _shard(path: Path) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    with np.load(path) as data:
        return data["image"], data["shares"]


def cross_entropy(network: MaskNetwork, images: Tensor, shares: Tensor) -> Tensor:
    """Between shares and what the network gives."""
    kind = images.device.type
    with torch.autocast(kind, dtype=torch.bfloat16, enabled=kind == "cuda"):  # many processors have no bfloat16
        found = network(images)
    return -(shares * log_softmax(found, dim=1)).sum(dim=1).mean()


def scores(network: MaskNetwork, heads: Heads) -> dict[str, float]:
    """Intersection over union of each class, where it covers most of a cell, on pictures as they are."""
    both = torch.zeros(2, len(MaskNetwork.CLASSES))
    with torch.no_grad():
        for start in range(0, len(heads.images), 40):
            images, shares = heads.batch(np.arange(start, min(start + 40, len(heads.images))), None)
            found, true = network(images).argmax(dim=1), shares.argmax(dim=1)
            for number in range(len(MaskNetwork.CLASSES)):
                one, other = found == number, true == number
                both[0, number] += (one & other).sum().cpu()
                both[1, number] += (one | other).sum().cpu()
    shares = (both[0] / both[1].clamp(min=1)).tolist()
    named = {f"iou_{name}": round(value, 4) for name, value in zip(MaskNetwork.CLASSES, shares, strict=True)}
    return {**named, "pictures": len(heads.images)}


def train(heads: Heads, steps: int, seed: int, keep: Callable[[MaskNetwork, int], None]) -> MaskNetwork:
    """A network after so many steps of Adam, its rate rising and falling once; `keep` gets it on the way."""
    torch.manual_seed(seed)
    network = MaskNetwork().to(heads.device, memory_format=torch.channels_last)
    drawn = batches(heads, _BATCH, np.random.default_rng(seed))
    return descend(network, lambda batch: cross_entropy(network, *batch), drawn, steps, keep)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Train the network that tells face, hair and the rest.")
    parser.add_argument("data", type=Path, help="folder of shards that mask_heads.py wrote")
    parser.add_argument("--shards", type=int, default=80, help="how many of them; the first is held out (default 80)")
    parser.add_argument("--device", default="cuda", help="of torch (default cuda)")
    add_training(parser, steps=12000, batch=f"{_BATCH} pictures")
    options = parser.parse_args()
    torch.set_num_threads(1)
    held_out = Heads(options.data, range(1), options.device)

    def keep(network: MaskNetwork, step: int) -> None:
        found = scores(network.eval(), held_out)
        print(step, found, flush=True)
        write_bytes(options.out, packed(mask_onnx(copy.deepcopy(network).cpu(), metadata(options, found))))
        network.train()

    heads = Heads(options.data, range(1, options.shards), options.device)
    keep(train(heads, options.steps, options.seed, keep), options.steps)


def metadata(options: argparse.Namespace, found: dict[str, float]) -> dict[str, object]:
    """What the file says of itself."""
    command = f"python training/train_mask.py DATA -o {options.out.name} --shards {options.shards}"
    return {
        "kind": "face-mask",
        "size": MaskNetwork.SIZE,
        "classes": list(MaskNetwork.CLASSES),
        "mean": [MEAN] * 3,
        "std": [STD] * 3,
        "order": "RGB",
        "crop": "face",
        "trained_on": "synthetic heads: renders of people drawn from facepipe's head (of ICT-FaceKit, MIT); no photos",
        "training": f"{command} --steps {options.steps} --seed {options.seed}",
        "data": f"python training/mask_heads.py DATA --count {SHARD * options.shards} --seed 5",
        "seed": options.seed,
        "held_out": found,
    }


if __name__ == "__main__":
    main()
