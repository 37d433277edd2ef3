"""Go on with the feature network: landmarks, and identity and attributes read off them.

usage: python training/features_second_stage.py FIRST.onnx GEOMETRY.npz HEADS LOOKS --more FACES -o face_features.onnx
           [--steps 1200] [--seed 0]

FIRST.onnx is what `train_features.py` made of HEADS and LOOKS; its heads of identity and attributes, too coarse, are
replaced. What landmarks show is learned from GEOMETRY.npz (`features_geometry.py`) first, then all together from
pictures, more of them in FACES (`features_heads.py --views 1`). Persons held out from the first stage stay so.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
import onnx
import torch
from features_augment import relight, scene
from features_data import Heads, IntArray, joined, read, split
from features_export import to_onnx
from features_losses import attribute_loss, class_weights, light_loss, semantic_loss
from features_marked import MarkedNetwork, take_trunk
from features_network import SIZE, normalised
from features_reader import Modes, read_off
from features_scores import held_out_scores
from packed_weights import packed
from script_arguments import add_training
from torch import Tensor, nn
from torch.nn.functional import smooth_l1_loss
from train_features import BATCH, HELD_OUT, batches, say

from facepipe.core.atomic import write_bytes
from facepipe.rig.torch.one_thread import short_floats

RATE = 6e-4
WEIGHTS = {"semantics": 1.0, "light": 0.3, "marks": 0.3, "shape": 0.5, "attributes": 1.0}


def main() -> None:
    """Train, score, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=Path, help="ONNX file of the first stage")
    parser.add_argument("geometry", type=Path, help="landmarks of features_geometry.py")
    parser.add_argument("data", type=Path, nargs="+", help="folders that the first stage was trained on")
    parser.add_argument("--more", type=Path, required=True, help="folder of more persons")
    add_training(parser, steps=1200, batch=f"{BATCH} heads")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(arguments.seed)
    model = onnx.load(arguments.first)
    (said,) = (json.loads(prop.value) for prop in model.metadata_props if prop.key == "facepipe.features")
    training, held_out = divided(arguments.data, arguments.more, said["seed"])
    reader, modes = read_off(arguments.geometry, training.names, arguments.seed)
    say("landmarks are read")
    network = MarkedNetwork(reader)
    take_trunk(network, model)
    train(network, training, modes, arguments.steps, arguments.seed)
    said["held_out"] = held_out_scores(network, held_out, np.nanmean(training.attributes, axis=0))
    people = len(np.unique(training.identities))
    said["trained_on"] += f"; second stage: {len(training)} renders of {people} random heads and landmarks of more"
    said["command"] += f" && python training/features_second_stage.py {arguments.first.name} GEOMETRY.npz HEADS LOOKS"
    said["command"] += f" --more FACES -o {arguments.out.name} --steps {arguments.steps} --seed {arguments.seed}"
    say(json.dumps(said["held_out"], indent=2))
    write_bytes(arguments.out, packed(to_onnx(network, said)))


def divided(folders: list[Path], more: Path, seed: int) -> tuple[Heads, Heads]:
    """Training and held-out heads; those of the first stage as it divided them."""
    parts = [split(read(one), HELD_OUT, np.random.default_rng(seed)) for one in (folders, [more])]
    training, held_out = (joined(part) for part in zip(*parts, strict=True))
    return training, held_out


def train(network: MarkedNetwork, heads: Heads, modes: Modes, steps: int, seed: int) -> None:
    """`steps` of AdamW with a rate that rises once and falls to nothing."""
    network.to(memory_format=torch.channels_last)
    weights = class_weights(torch.as_tensor(heads.labels[:: max(1, len(heads) // 1000)]))
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps, pct_start=0.15)
    rows, random = batches(heads, np.random.default_rng(seed)), torch.Generator().manual_seed(seed)
    start, sums = time.perf_counter(), dict.fromkeys(WEIGHTS, 0.0)
    network.train()
    for step in range(1, steps + 1):
        terms = losses(network, heads, next(rows), modes, weights, random)
        optimizer.zero_grad()
        torch.stack([WEIGHTS[name] * term for name, term in terms.items()]).sum().backward()
        nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        schedule.step()
        sums = {name: sums[name] + term.item() for name, term in terms.items()}
        if step % 50 == 0:
            shown = " ".join(f"{name} {value / 50:.3f}" for name, value in sums.items())
            say(f"{step:6d} of {steps}, {time.perf_counter() - start:5.0f} s: {shown}")
            sums = dict.fromkeys(sums, 0.0)
    network.eval()


def losses(
    network: MarkedNetwork, heads: Heads, rows: IntArray, modes: Modes, weights: Tensor, random: torch.Generator
) -> dict[str, Tensor]:
    """Term -> loss of the heads `rows`, each in two lights."""
    shown = scene(heads, rows, random)
    lit = torch.cat([relight(shown, random) for _ in range(2)])
    with short_floats():
        found, merged = network.decoded(normalised(lit).contiguous(memory_format=torch.channels_last))
        logits, heat = network.semantics(network.merges[0](merged[0])), network.heat(merged[1])
    marks = heat.float().flatten(2).softmax(2) @ network.cells
    embedding, values = network.reader(marks)
    twice = np.concatenate([rows, rows])
    targets = modes(torch.as_tensor(heads.shapes[twice]))
    known = targets.isfinite()[:, 0]
    return {
        "semantics": semantic_loss(logits.float(), shown.classes.repeat(2, 1, 1), weights),
        "light": light_loss([one.float() for one in found[:3]]),
        "marks": marks_loss(marks, shown.marks.repeat(2, 1, 1)),
        "shape": (embedding[known] - targets[known]).square().mean(),
        "attributes": attribute_loss(values, torch.as_tensor(heads.attributes[twice])),
    }


def marks_loss(found: Tensor, truth: Tensor) -> Tensor:
    """Mean distance in pixels of landmarks (b, 68, 2), -1..1 of the picture, those outside of it left out."""
    inside = (truth.abs() < 0.98).all(dim=2)
    return smooth_l1_loss(found[inside] * SIZE / 2, truth[inside] * SIZE / 2) * 2


if __name__ == "__main__":
    main()
