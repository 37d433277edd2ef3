"""Writes the table of people.md from the package data: `python docs/measure_table.py`."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "samples" / "head"))

import measures  # noqa: E402
from directions import REACH  # noqa: E402

from facepipe.heads import make  # noqa: E402
from facepipe.heads.assembly import directions  # noqa: E402
from facepipe.heads.asset import arrays, asset  # noqa: E402
from facepipe.stage import Face  # noqa: E402

PAGE = HERE / "people.md"
TABLE = re.compile(r"(?<=<!-- docs/measure_table.py -->\n).*?(?=<!-- end -->)", re.DOTALL)


def main() -> None:
    """Measure what each direction does, and write it down."""
    head, found = asset(), arrays("measures")
    deviations = found["deviations"]
    own = directions()[: len(deviations)]
    functionals = measures.functionals(measures.spots(head.points, head.landmarks))
    face = Face.from_parts(make(0))
    moved = np.stack([face.evaluate(sliders={one.name: 1.0})[: measures.SKIN] for one in own])
    moved -= face.evaluate()[: measures.SKIN]
    effects = np.einsum("dnc,enc->de", functionals, moved, optimize=True)
    effects /= REACH * deviations[:, None]
    means = np.einsum("dnc,nc->d", functionals, head.points[: measures.SKIN])
    peaks = measures.MM * np.linalg.norm(moved, axis=2).max(axis=1) / REACH / deviations
    costs = found["costs"]
    apart = ~np.eye(len(own), dtype=bool)
    others = np.abs(effects) * apart
    rows = [
        f"{len(own)} measures: others move by {100 * np.median(others[apart]):.1f} % of their own standard deviations "
        f"(median), at most {100 * others.max():.1f} %; points move by {peaks.max():.1f} mm per mm at most "
        f"(median {np.median(peaks):.1f}); a direction costs {np.median(costs):.1f} standard deviations (median).",
        "",
        "| slider | sides | mean, mm | deviation, mm | others move most | peak, mm per mm | cost |",
        "|---|---|---|---|---|---|---|",
    ]
    for number, one in enumerate(own):
        worst = int(others[:, number].argmax())
        leak = f"{own[worst].name} {100 * others[worst, number]:.1f} %"
        rows.append(
            f"| {one.name} | {'both' if one.sided else ''} | {means[number]:.1f} | {deviations[number]:.1f} | {leak} | "
            f"{peaks[number]:.1f} | {costs[number]:.1f} |"
        )
    PAGE.write_text(TABLE.sub(lambda _: "\n".join(rows) + "\n", PAGE.read_text("utf-8")), "utf-8")


if __name__ == "__main__":
    main()
