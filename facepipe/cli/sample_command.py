"""Make the built-in sample head: one topology, a different person for every seed.

example: facepipe sample head.usda --seed 3
"""

from __future__ import annotations

import argparse
from pathlib import Path

from facepipe.cli.parser import add_output, output_of


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    add_output(parser, "face stage to write: .usda .usdc .usd .usdz", positional=True)
    parser.add_argument("--seed", type=seed, default=0, help="which person, 0 or more (default 0)")


def run(arguments: argparse.Namespace) -> int:
    """Make and save it."""
    out = output_of(arguments)
    make_sample(out, arguments.seed)
    print(out)
    return 0


def seed(text: str) -> int:
    """A seed: a whole number, 0 or more."""
    if not text.isdecimal() or len(text) > 18:
        raise argparse.ArgumentTypeError(f"'{text[:40]}', expected a whole number from 0")
    return int(text)


def make_sample(out: Path, seed: int) -> None:
    """Save the sample head of `seed` as `out`."""
    from facepipe.heads import make
    from facepipe.stage import save_parts

    save_parts(make(seed), out)
