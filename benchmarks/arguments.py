"""Arguments that every benchmark takes."""

from __future__ import annotations

import argparse
from pathlib import Path

_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def add_common(parser: argparse.ArgumentParser, runs: int, of_them: str) -> None:
    """`--runs`, `--json` and `--data`; `of_them` says what becomes of the runs."""
    text = f"child processes a side, {of_them} of them (default {runs})"
    parser.add_argument("--runs", type=positive, default=runs, help=text)
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    parser.add_argument(
        "--data",
        type=Path,
        default=_DATA,
        help="folder of the source faces (default ../shared/data beside the repository)",
    )


def positive(text: str) -> int:
    """A number from 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}', expected a number from 1")
    return int(text)
