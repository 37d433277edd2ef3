"""Arguments that several of the scripts take."""

from __future__ import annotations

import argparse
from pathlib import Path

_ICT = Path(__file__).parents[2] / "shared/data/ict_facekit/ict_facekit.npz"


def add_heads(parser: argparse.ArgumentParser, *, seed: int) -> None:
    """Where random heads come from.

    :param seed: the default
    """
    parser.add_argument("--seed", type=int, default=seed, help=f"of the heads (default {seed})")
    parser.add_argument("--ict", type=Path, default=_ICT, help="ict_facekit.npz")


def add_shards(parser: argparse.ArgumentParser, *, count: int, shard: int) -> None:
    """How many pictures are written where.

    :param count: the default
    :param shard: pictures a file
    """
    parser.add_argument("out", type=Path, help="folder for the shards")
    parser.add_argument("--count", type=int, default=count, help=f"pictures, in shards of {shard} (default {count})")
    parser.add_argument("--first", type=int, default=0, help="number of the first shard (default 0)")


def add_training(parser: argparse.ArgumentParser, *, steps: int, batch: str) -> None:
    """Of what length a training is, and where its network goes.

    :param steps: the default
    :param batch: what a step sees
    """
    parser.add_argument("-o", "--out", type=Path, required=True, help="the ONNX file")
    parser.add_argument("--steps", type=int, default=steps, help=f"batches of {batch} (default {steps})")
    parser.add_argument("--seed", type=int, default=0, help="of weights and batches (default 0)")
