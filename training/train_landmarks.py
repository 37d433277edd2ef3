"""Trains the landmark network: ``python training/train_landmarks.py DATA -o OUT.onnx --shards 16 --seed 0``.

DATA is what `heads.py` wrote: renders of synthetic heads, no photo. The first shard, with persons of its own, is held
out; its scores go into the file's metadata.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import landmark_data
import numpy as np
import torch
from descent import descend
from landmark_export import to_onnx
from landmark_network import CELLS, MEAN, SIZE, STD, LandmarkNetwork
from packed_weights import packed
from script_arguments import add_training
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, smooth_l1_loss

from facepipe.core.atomic import write_bytes
from facepipe.rig.torch.one_thread import short_floats

_BATCH = 32
_SPREAD = 2.0  # square cells that the heat of a landmark shall cover
_SPREAD_SHARE, _PRESENCE_SHARE = 0.05, 1.0


def joint_loss(network: LandmarkNetwork, batch: landmark_data.Batch) -> Tensor:
    """Distance of landmarks in pixels, spread of the heat, and presence."""
    with short_floats():
        landmarks, presence, heat = network(batch.images)
    weight = batch.known / batch.known.sum().clamp(min=1)
    error = smooth_l1_loss(landmarks * SIZE, batch.landmarks * SIZE, reduction="none").sum(dim=2)
    share = heat.softmax(dim=2)
    spread = (share @ network.cells.square().sum(dim=1)) - landmarks.square().sum(dim=2)
    spread = (spread * CELLS**2 - _SPREAD).abs()
    judged = binary_cross_entropy_with_logits(presence[:, 0].float(), batch.presence, batch.judged)
    return ((error + _SPREAD_SHARE * spread.clamp(max=20)) * weight).sum() + _PRESENCE_SHARE * judged


def scores(network: LandmarkNetwork, heads: landmark_data.Heads) -> dict[str, float]:
    """Mean error over the distance of the outer eye corners and how well presence is found, on pictures as they are."""
    found = []
    with torch.no_grad():
        for start in range(0, len(heads.images), 50):
            batch = landmark_data.plain(heads, np.arange(start, min(start + 50, len(heads.images))))
            landmarks, presence, _ = network(batch.images)
            error = (landmarks - batch.landmarks).norm(dim=2)
            across = (batch.landmarks[:, 36] - batch.landmarks[:, 45]).norm(dim=1, keepdim=True)
            whole = (batch.known == 1).all(dim=1, keepdim=True) & (across > 0.1)
            rows = torch.cat([error / across, whole, presence.sigmoid(), batch.presence[:, None]], dim=1)
            found.append(torch.cat([rows, batch.judged[:, None]], dim=1))
    table = torch.cat(found)
    error = table[table[:, 68] == 1, :68]
    present, real = table[table[:, 71] == 1, 69] > 0.5, table[table[:, 71] == 1, 70] == 1
    return {
        "nme_inner": round(error[:, 17:].mean().item(), 4),
        "nme_contour": round(error[:, :17].mean().item(), 4),
        "presence_found": round(present[real].float().mean().item(), 4),
        "presence_false": round(present[~real].float().mean().item(), 4),
        "pictures": len(heads.images),
    }


def batches(heads: landmark_data.Heads, rng: np.random.Generator) -> Iterator[landmark_data.Batch]:
    """Varied pictures in random order, without end."""
    while True:
        order = rng.permutation(len(heads.images))
        for start in range(0, len(order) - _BATCH + 1, _BATCH):
            yield landmark_data.varied(heads, order[start : start + _BATCH], rng)


def train(
    heads: landmark_data.Heads, steps: int, seed: int, keep: Callable[[LandmarkNetwork, int], None]
) -> LandmarkNetwork:
    """A network after so many steps of Adam, its rate rising and falling once; `keep` gets it on the way."""
    torch.manual_seed(seed)
    network = LandmarkNetwork().to(memory_format=torch.channels_last)
    drawn = batches(heads, np.random.default_rng(seed))
    return descend(network, lambda batch: joint_loss(network, batch), drawn, steps, keep)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Train the landmark network on renders of random heads.")
    parser.add_argument("data", type=Path, help="folder of shards that heads.py wrote")
    parser.add_argument("--shards", type=int, default=16, help="how many of them; the first is held out")
    add_training(parser, steps=5000, batch=f"{_BATCH} pictures")
    options = parser.parse_args()
    torch.set_num_threads(1)
    held_out = landmark_data.read(options.data, range(1))

    def keep(network: LandmarkNetwork, step: int) -> None:
        found = scores(network.eval(), held_out)
        print(step, found, flush=True)
        write_bytes(options.out, packed(to_onnx(network, metadata(options, found))))
        network.train()

    heads = landmark_data.read(options.data, range(1, options.shards))
    keep(train(heads, options.steps, options.seed, keep), options.steps)


def metadata(options: argparse.Namespace, found: dict[str, float]) -> dict[str, object]:
    """What the file says of itself."""
    command = f"python training/train_landmarks.py DATA -o {options.out.name} --shards {options.shards}"
    return {
        "kind": "landmarks",
        "size": SIZE,
        "mean": [MEAN] * 3,
        "std": [STD] * 3,
        "order": "RGB",
        "crop": "face",
        "trained_on": "synthetic heads: renders of people drawn from facepipe's head (of ICT-FaceKit, MIT); no photos",
        "training": f"{command} --steps {options.steps} --seed {options.seed}",
        "data": f"python training/heads.py DATA --count {500 * options.shards} --seed 0",
        "seed": options.seed,
        "held_out": found,
    }


if __name__ == "__main__":
    main()
