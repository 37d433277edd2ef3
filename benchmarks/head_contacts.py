"""Whether teeth come through lips and eyeballs through lids, and how much of the eyeballs a blink hides.

example: python benchmarks/head_contacts.py --people 5 --combinations 40
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import support_modules  # noqa: F401  (finds the modules of tests/support)
from arguments import positive
from contacts import (
    COMBINED,
    PARTLY,
    SINGLE,
    Eyes,
    Subject,
    blink,
    draw_combinations,
    expressions,
    eye_sheets,
    mouth_sheet,
    person,
    worst,
)

from facepipe.geometry.contacts import Contact

People = Callable[[int], Subject]


@dataclass(frozen=True)
class Result:
    """What was measured."""

    single: dict[str, Contact]  # of the shapes with any contact, the worst of everyone and of the average head
    combined: list[Contact]
    eyes: dict[int, Eyes]  # by seed

    @property
    def over(self) -> float:
        """The share of combinations above the bound."""
        return float(np.mean([_above(one, COMBINED) for one in self.combined]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--ict", type=Path, metavar="NPZ", help="the raw ict_facekit.npz in place of the head in the box"
    )
    parser.add_argument("--people", type=positive, default=30, help="seeds, from 1 (default 30)")
    parser.add_argument("--combinations", type=positive, default=200, help="the same on each person (default 200)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    given = parser.parse_args()
    people = partial(raw_person, given.ict) if given.ict else person
    result = measure(people, given.people, given.combinations)
    print(table(result))
    if given.json:
        given.json.write_text(json.dumps(asdict(result), indent=1), encoding="utf-8")


def measure(people: People, count: int, combinations: int) -> Result:
    """The average head's shapes, then everyone's shapes, combinations and blinks."""
    average = people(0)
    mouth = mouth_sheet(average)
    shapes = expressions(average)
    single = {name: [mouth.before_skin(average.points({name: 1.0}))] for name in shapes}
    drawn = list(draw_combinations(shapes, combinations))
    combined, eyes = [], {}
    for seed in range(1, count + 1):
        subject = people(seed)
        for name, found in single.items():
            found.append(mouth.before_skin(subject.points({name: 1.0})))
        combined += [mouth.before_skin(subject.points(weights)) for weights in drawn]
        eyes[seed] = blink(subject, eye_sheets(average))
        print(f"{seed} of {count}", end="\r", file=sys.stderr)
    most = {name: worst(found) for name, found in single.items()}
    return Result({name: one for name, one in most.items() if one.cells}, combined, eyes)


def raw_person(source: Path, seed: int) -> Subject:
    """A person of ICT-FaceKit as it is, all modes drawn from N(0, 1); 0 is the average head."""
    from facepipe.importers import ict, load

    return Subject(load("ict", source, ict.Options(identity_seed=seed or None)).parts)


def table(result: Result) -> str:
    """The figures for people."""
    bad = [one for one in result.single.values() if _above(one, SINGLE)]
    hidden = sum(eye.shown <= 0.01 for eye in result.eyes.values())
    clean = sum(eye.through.cells == 0 for eye in result.eyes.values())
    count = len(result.eyes)
    lines = [f"shapes above {SINGLE[0]} cells or {SINGLE[1]} mm: {len(bad)}"]
    lines += [f"  {name}: {one.cells} cells, {one.depth:.2f} mm" for name, one in result.single.items()]
    lines += [
        f"combinations above {COMBINED[0]} cells or {COMBINED[1]} mm: {result.over:.1%} of {len(result.combined)}, "
        f"with any: {np.mean([one.cells > 0 for one in result.combined]):.1%}",
        f"blinks that hide 99 % of the eyeballs: {hidden} of {count}",
        f"nothing through lids at {', '.join(map(str, PARTLY))}: {clean} of {count}",
    ]
    return "\n".join(lines)


def _above(contact: Contact, bound: tuple[int, float]) -> bool:
    return contact.cells > bound[0] or contact.depth > bound[1]


if __name__ == "__main__":
    main()
