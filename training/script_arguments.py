"""Arguments that several of the scripts take."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_shards(parser: argparse.ArgumentParser, *, count: int, shard: int, seed: int) -> None:
    """How many pictures are written where.

    :param count: the default
    :param shard: pictures a file
    :param seed: the default
    """
    parser.add_argument("out", type=Path, help="folder for the shards")
    parser.add_argument("--count", type=int, default=count, help=f"pictures, in shards of {shard} (default {count})")
    parser.add_argument("--first", type=int, default=0, help="number of the first shard (default 0)")
    parser.add_argument("--seed", type=int, default=seed, help=f"of the heads (default {seed})")


def add_training(parser: argparse.ArgumentParser, *, steps: int, batch: str) -> None:
    """Of what length a training is, and where its network goes.

    :param steps: the default
    :param batch: what a step sees
    """
    parser.add_argument("-o", "--out", type=Path, required=True, help="the ONNX file")
    parser.add_argument("--steps", type=int, default=steps, help=f"batches of {batch} (default {steps})")
    parser.add_argument("--seed", type=int, default=0, help="of weights and batches (default 0)")
