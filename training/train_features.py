"""Train the feature network of photo fits on renders of random heads, and write it as ONNX.

usage: python training/train_features.py HEADS LOOKS -o face_features.onnx [--seed 0] [--steps 5000]

HEADS and LOOKS are folders of shards that `training/heads.py` and `training/features_heads.py` wrote. One residual
network with one trunk learns three kinds of features together: content (features of several depths, and semantic
probabilities), identity and attributes (the head's sliders of bones). Identity is learned from LOOKS alone, where the
pictures of a person share the shape of the head and nothing else. Every batch shows each head in two lights. A share of
the persons is held out for the scores, which are printed and written into the file's metadata. Single-threaded; the
same seed gives the same file on the same kind of processor.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from features_augment import relight, scene
from features_data import Heads, IntArray, read, split
from features_export import to_onnx
from features_losses import IdentityLoss, attribute_loss, class_weights, light_loss, semantic_loss
from features_network import CLASSES, CONTENT, EMBEDDING, MEAN, SIZE, STD, FeatureNetwork, normalised
from features_scores import held_out_scores
from script_arguments import add_training
from torch import Tensor, nn

from facepipe.core.atomic import write_bytes
from facepipe.rig.torch.one_thread import short_floats

HELD_OUT = 0.08  # share of the heads
BATCH = 16  # heads, each seen twice
RATE, DECAY = 2e-3, 1e-2
WEIGHTS = {"semantics": 1.0, "identity": 0.2, "attributes": 4.0, "light": 0.3}


def main() -> None:
    """Train, score, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="+", help="folders of shards")
    add_training(parser, steps=5000, batch=f"{BATCH} heads in two lights")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(arguments.seed)
    training, held_out = split(read(arguments.data), HELD_OUT, np.random.default_rng(arguments.seed))
    say(f"{len(training)} pictures to train on, {len(held_out)} held out")
    network = train(training, arguments.steps, arguments.seed)
    scores = held_out_scores(network, held_out, np.nanmean(training.attributes, axis=0))
    say(json.dumps(scores, indent=2))
    command = f"python training/train_features.py HEADS LOOKS -o {arguments.out.name}"
    command = f"{command} --steps {arguments.steps} --seed {arguments.seed}"
    write_bytes(arguments.out, to_onnx(network, metadata(training, scores, command, arguments.seed)))


def train(heads: Heads, steps: int, seed: int) -> FeatureNetwork:
    """The network after `steps` of AdamW with a rate that rises once and falls to nothing."""
    network = FeatureNetwork(len(heads.names)).to(memory_format=torch.channels_last)
    losses = Losses(heads)
    free = [*network.parameters(), *losses.parameters()]
    optimizer = torch.optim.AdamW(free, lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps, pct_start=0.1)
    rows, random = batches(heads, np.random.default_rng(seed)), torch.Generator().manual_seed(seed)
    start, sums = time.perf_counter(), dict.fromkeys(WEIGHTS, 0.0)
    network.train()
    for step in range(1, steps + 1):
        terms = losses(network, next(rows), random)
        optimizer.zero_grad()
        torch.stack([WEIGHTS[name] * term for name, term in terms.items()]).sum().backward()
        nn.utils.clip_grad_norm_(free, 5.0)
        optimizer.step()
        schedule.step()
        sums = {name: sums[name] + term.item() for name, term in terms.items()}
        if step % 100 == 0:
            shown = " ".join(f"{name} {value / 100:.3f}" for name, value in sums.items())
            say(f"{step:6d} of {steps}, {time.perf_counter() - start:5.0f} s: {shown}")
            sums = dict.fromkeys(sums, 0.0)
    return network.eval()


def batches(heads: Heads, random: np.random.Generator) -> Iterator[IntArray]:
    """Without end: rows of `BATCH` pictures, of persons whose look changes and of others in turn."""
    kinds = [np.flatnonzero(kind) for kind in (heads.changing, ~heads.changing) if kind.any()]
    streams = itertools.cycle([_shuffled(rows, random) for rows in kinds])
    while True:
        yield np.array([next(next(streams)) for _ in range(BATCH)])


def _shuffled(rows: IntArray, random: np.random.Generator) -> Iterator[int]:
    while True:
        yield from random.permutation(rows).tolist()


class Losses(nn.Module):
    """The terms of the joint loss on a batch."""

    def __init__(self, heads: Heads) -> None:
        super().__init__()
        self._heads = heads
        self._weights = class_weights(torch.as_tensor(heads.labels[:: max(1, len(heads) // 1000)]))
        persons, first = np.unique(heads.identities[heads.changing], return_index=True)
        self._numbers = torch.as_tensor(np.searchsorted(persons, heads.identities))
        self._changing = torch.as_tensor(heads.changing)
        self.identity = IdentityLoss(len(persons), torch.as_tensor(heads.shapes[heads.changing][first]), EMBEDDING)

    def forward(self, network: FeatureNetwork, rows: IntArray, random: torch.Generator) -> dict[str, Tensor]:
        """Term -> loss of the heads `rows`, each in two lights."""
        shown = scene(self._heads, rows, random)
        lit = torch.cat([relight(shown, random) for _ in range(2)])
        values = normalised(lit).contiguous(memory_format=torch.channels_last)
        with short_floats():
            raw = network.raw(values)
        twice = np.concatenate([rows, rows])
        of_persons = twice[self._changing[twice].numpy()]
        embedding = raw.embedding.float()[self._changing[twice]]
        shapes = torch.as_tensor(self._heads.shapes[of_persons])
        attributes = torch.as_tensor(self._heads.attributes[twice])
        return {
            "semantics": semantic_loss(raw.logits.float(), shown.classes.repeat(2, 1, 1), self._weights),
            "identity": self.identity(embedding, self._numbers[of_persons], shapes),
            "attributes": attribute_loss(raw.attributes.float(), attributes),
            "light": light_loss([one.float() for one in raw.content]),
        }


def metadata(heads: Heads, scores: dict[str, Any], command: str, seed: int) -> dict[str, object]:
    """What the file says of itself."""
    return {
        "kinds": {"content": list(CONTENT), "identity": ["identity"], "attributes": ["attributes"]},
        "size": SIZE,
        "mean": [MEAN] * 3,
        "std": [STD] * 3,
        "order": "RGB",
        "crop": "face",
        "labels": list(CLASSES),
        "logits": False,
        "names": list(heads.names),
        "trained_on": f"synthetic heads only: {len(heads)} renders of {len(np.unique(heads.identities))} random heads",
        "command": command,
        "seed": seed,
        "held_out": scores,
    }


def say(text: str) -> None:
    """Progress."""
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


if __name__ == "__main__":
    main()
