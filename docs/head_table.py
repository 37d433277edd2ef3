"""Writes the table of head.md from the package data: `python docs/head_table.py`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from facepipe.heads.asset import asset
from facepipe.rig.conventions import ARKIT_SHAPES

PAGE = Path(__file__).resolve().parent / "head.md"
TABLE = re.compile(r"(?<=<!-- docs/head_table.py -->\n).*?(?=<!-- end -->)", re.DOTALL)
MM = 10.0  # of a centimetre


def main() -> None:
    """Measure where each shape moves the skin, and write it down."""
    rows = [
        f"{len(ARKIT_SHAPES & set(asset().shapes))} of {len(ARKIT_SHAPES)} names of ARKit:",
        "",
        "| shape | farthest, mm | where, share of the motion | inbetweens |",
        "|---|---|---|---|",
        *lines(),
    ]
    PAGE.write_text(TABLE.sub(lambda _: "\n".join(rows) + "\n", PAGE.read_text("utf-8")), "utf-8")


def lines() -> Iterator[str]:
    """A line a shape: the regions that have most of its motion, as squared distances."""
    head = asset()
    skin = slice(0, 11248)  # without the sockets
    regions = {name: mask[skin] for name, mask in head.regions.items()}
    for name in sorted(ARKIT_SHAPES):
        *between, (_, full) = head.shapes[name].items()
        squares = (full**2).sum(axis=1)
        amounts = {region: float(mask @ squares[skin]) for region, mask in regions.items()}
        if name == "tongueOut":
            amounts["tongue"] = float(squares[head.parts["GumsAndTongue"].points].sum())
        total = sum(amounts.values())
        most = sorted(amounts, key=amounts.__getitem__, reverse=True)[:2]
        where = ", ".join(f"{region} {100 * amounts[region] / total:.0f} %" for region in most)
        weights = ", ".join(f"{weight:g}" for weight, _ in between)
        yield f"| {name} | {MM * np.sqrt(squares.max()):.1f} | {where} | {weights} |"


if __name__ == "__main__":
    main()
