"""Train identity and attributes of the feature network once more, on more heads, and leave the rest of it as it is.

usage: python training/features_second_stage.py FIRST.onnx HEADS LOOKS --more FACES -o face_features.onnx [--seed 0]

FIRST.onnx is what `train_features.py` made of HEADS and LOOKS; FACES is a folder of `features_heads.py` with more
persons. The deepest features of every picture, in `PASSES` lights, are computed once; what reads identity and
attributes off them is small and quick to train for long. Persons held out from the first stage stay so.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
import onnxruntime
import torch
from features_augment import relight, scene
from features_data import FloatArray, Heads, IntArray, joined, read, split
from features_losses import IdentityLoss, attribute_loss
from features_network import EMBEDDING, FeatureNetwork, normalised
from features_scores import held_out_scores
from onnx import helper, numpy_helper
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_weights
from train_features import HELD_OUT, say

from facepipe.atomic import write_bytes

PASSES, BATCH = 4, 128
RATE, DECAY, DROPPED = 2e-3, 0.1, 0.2
IDENTITY, ATTRIBUTES = 0.2, 4.0  # weights of the losses
PROPERTY = "facepipe.features"
_LAYERS = {"summary_0_0": "summary.0", "identity_0": "identity", "inner_0_0": "inner.0"}  # in the file, in the network


def main() -> None:
    """Compute features, train, score, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=Path, help="ONNX file of the first stage")
    parser.add_argument("data", type=Path, nargs="+", help="folders that the first stage was trained on")
    parser.add_argument("--more", type=Path, help="folder of more persons")
    parser.add_argument("-o", dest="out", type=Path, required=True, help="the ONNX file")
    parser.add_argument("--steps", type=int, default=5000, help=f"batches of {BATCH} pictures (default 5000)")
    parser.add_argument("--seed", type=int, default=0, help="of weights, batches and lights (default 0)")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(arguments.seed)
    model = onnx.load(arguments.first)
    said = description(model)
    training, held_out = divided(arguments.data, arguments.more, said["seed"])
    trained = train(deepest(model, training, arguments.seed), training, arguments.steps, arguments.seed)
    exchange(model, trained)
    blind = np.nanmean(training.attributes, axis=0)
    said["held_out"] = held_out_scores(Runner(model), held_out, blind)
    said["trained_on"] = (
        f"synthetic heads only, in two stages: {said['trained_on'].split(': ')[-1]}, then {counted(training)}"
    )
    said["command"] += f" && python training/features_second_stage.py {arguments.first.name} HEADS LOOKS --more FACES"
    said["command"] += f" -o {arguments.out.name} --steps {arguments.steps} --seed {arguments.seed}"
    say(json.dumps(said["held_out"], indent=2))
    helper.set_model_props(model, {PROPERTY: json.dumps(said)})
    onnx.checker.check_model(model, full_check=True)
    write_bytes(arguments.out, model.SerializeToString(deterministic=True))


def divided(folders: list[Path], more: Path | None, seed: int) -> tuple[Heads, Heads]:
    """Training and held-out heads; those of the first stage as it divided them."""
    parts = [split(read(folders), HELD_OUT, np.random.default_rng(seed))]
    if more is not None:
        parts.append(split(read([more]), HELD_OUT, np.random.default_rng(seed)))
    training, held_out = (joined(part) for part in zip(*parts, strict=True))
    of_use = training.changing | np.isfinite(training.attributes[:, 0])
    return training.take(np.flatnonzero(of_use)), held_out


def counted(heads: Heads) -> str:
    """How many there are."""
    return f"{len(heads)} renders of {len(np.unique(heads.identities))} random heads"


def description(model: Any) -> dict[str, Any]:
    """What the file says of itself."""
    (found,) = (json.loads(one.value) for one in model.metadata_props if one.key == PROPERTY)
    return dict(found)


class Runner:
    """An ONNX model as a function of normalised images, in onnxruntime on one thread."""

    def __init__(self, model: Any) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(model.SerializeToString(), options)

    def __call__(self, images: Tensor) -> tuple[Tensor, ...]:
        return tuple(torch.as_tensor(one) for one in self._session.run(None, {"image": images.numpy()}))


def deepest(model: Any, heads: Heads, seed: int) -> FloatArray:
    """(`PASSES`, n, 128, 8, 8) half-precision features that identity and attributes are read off, in random lights."""
    name = next(node.input[0] for node in model.graph.node if "summary_0_0.weight" in node.input)
    cut = onnx.ModelProto()
    cut.CopyFrom(model)
    del cut.graph.output[:]
    cut.graph.output.append(helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None))
    run, random = Runner(cut), torch.Generator().manual_seed(seed)
    found = []
    for number in range(PASSES):
        rows = np.array_split(np.arange(len(heads)), max(1, len(heads) // 64))
        parts = [run(normalised(relight(scene(heads, part, random), random)))[0].half().numpy() for part in rows]
        found.append(np.concatenate(parts))
        say(f"features in light {number + 1} of {PASSES}")
    return np.stack(found)


class Persons(NamedTuple):
    """Who the pictures show, as the identity loss counts."""

    numbers: IntArray  # (n,), -1 for those with one picture, whose looks can't be told from who they are
    shapes: Tensor  # (persons, k)


def persons(heads: Heads) -> Persons:
    """Of all pictures with a known shape."""
    _, first, back, counts = np.unique(heads.identities, return_index=True, return_inverse=True, return_counts=True)
    several = (counts > 1) & np.isfinite(heads.shapes[first, 0])
    numbers = np.where(several, np.cumsum(several) - 1, -1)
    known = first[np.isfinite(heads.shapes[first, 0])]
    return Persons(numbers[back], torch.as_tensor(heads.shapes[known]))


def train(features: FloatArray, heads: Heads, steps: int, seed: int) -> FeatureNetwork:
    """A network of which only what reads identity and attributes is trained."""
    network, whom = FeatureNetwork(len(heads.names)), persons(heads)
    loss = IdentityLoss(int(whom.numbers.max()) + 1, whom.shapes, EMBEDDING)
    parts = (network.summary, network.identity, network.inner, network.attributes, loss)
    free = [one for part in parts for one in part.parameters()]
    optimizer = torch.optim.AdamW(free, lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps, pct_start=0.1)
    random, dropout = np.random.default_rng(seed), nn.Dropout2d(DROPPED)
    network.train()
    for step in range(1, steps + 1):
        rows = random.integers(len(heads), size=BATCH)
        deep = torch.as_tensor(features[random.integers(PASSES, size=BATCH), rows]).float()
        summary = network.summary(dropout(deep))
        embedding = network.identity(summary).flatten(1)
        known = heads.changing[rows]
        numbers, shapes = torch.as_tensor(whom.numbers[rows[known]]), torch.as_tensor(heads.shapes[rows[known]])
        identity = loss(embedding[torch.as_tensor(known)], numbers, shapes)
        values = network.attributes(network.inner(summary)).flatten(1)
        attributes = attribute_loss(values, torch.as_tensor(heads.attributes[rows]))
        optimizer.zero_grad()
        (IDENTITY * identity + ATTRIBUTES * attributes).backward()
        optimizer.step()
        schedule.step()
        if step % 500 == 0:
            say(f"{step:6d} of {steps}: identity {identity.item():.3f} attributes {attributes.item():.3f}")
    return network.eval()


def exchange(model: Any, network: FeatureNetwork) -> None:
    """Put the layers that `train` trained in the place of the model's, their normalisation folded."""
    fresh: dict[str, Tensor] = {}
    for name, path in _LAYERS.items():
        conv, norm = network.get_submodule(path)
        weight, bias = fuse_conv_bn_weights(
            conv.weight, conv.bias, norm.running_mean, norm.running_var, norm.eps, norm.weight, norm.bias
        )
        fresh |= {f"{name}.weight": weight, f"{name}.bias": bias}
    fresh |= {"attributes.weight": network.attributes.weight, "attributes.bias": network.attributes.bias}
    for constant in model.graph.initializer:
        if constant.name in fresh:
            constant.CopyFrom(numpy_helper.from_array(fresh.pop(constant.name).detach().numpy(), constant.name))
    if fresh:
        raise ValueError(f"the file has no {', '.join(fresh)}, expected one that train_features.py wrote")


if __name__ == "__main__":
    main()
