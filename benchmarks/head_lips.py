"""Teeth between the lips of people at rest from the front, how far lips go into one another, and teeth where jaws open.

example: python benchmarks/head_lips.py --people 20
"""

from __future__ import annotations

import argparse

import numpy as np
import support_modules  # noqa: F401  (finds the modules of tests/support)
from arguments import positive
from contacts import Subject, person
from lip_rays import OVERLAP, Lips

from facepipe.heads.assembly import make_head
from facepipe.heads.people import draw

_OPEN = {"jawOpen": 0.5}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=positive, default=100, help="seeds, from 1 (default 100)")
    count = parser.parse_args().people
    lips = Lips(person(0))
    print("| lips | people with teeth at rest | overlap, mm: the most; people above | teeth at jawOpen 0.5, cells |")
    print("|---|---|---|---|")
    for name, closed in (("as modes leave them", False), ("that meet", True)):
        teeth, overlaps, opened = [], [], []
        for seed in range(1, count + 1):
            head = Subject(make_head(draw(seed).identity, closed=closed))
            teeth.append(lips.teeth(head.neutral))
            overlaps.append(lips.overlap(head.neutral))
            opened.append(lips.teeth(head.points(_OPEN)))
        above = int(np.sum(np.array(overlaps) > OVERLAP))
        print(
            f"| {name} | {np.count_nonzero(teeth)} of {count} | {max(overlaps):.2f}; {above} | "
            f"{np.mean(opened):.0f}, {np.count_nonzero(opened)} people |"
        )


if __name__ == "__main__":
    main()
