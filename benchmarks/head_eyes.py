"""What of eyeballs comes through lids where people look about: alone, with a squint or half a blink, and with each
slider of eyes at both its ends.

example: python benchmarks/head_eyes.py --people 5 --fitted 3
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import support_modules  # noqa: F401  (finds the modules of tests/support)
from arguments import positive
from contacts import person as subject_of
from contacts import worst
from gazes import BOUND, Poser, gaze_sheets, poses, through_lids
from geometry_people import person as fitted_person

from facepipe.geometry.contacts import Contact
from facepipe.heads.assembly import make_head
from facepipe.heads.people import draw
from facepipe.parts import FaceParts

_SEED = 45  # of people that are fitted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=positive, default=100, help="seeds, from 1 (default 100)")
    parser.add_argument(
        "--fitted", type=int, default=30, help="people whom no modes hold, with lids made of their points (default 30)"
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    given = parser.parse_args()
    sheets = gaze_sheets(subject_of(0))
    found: dict[str, dict[str, Contact]] = {}
    for name, parts in faces(given.people, given.fitted):
        poser = Poser(parts)
        found[name] = {pose.name: through_lids(poser.points(pose), sheets) for pose in poses(parts)}
        print(f"{name}: {len(over(found[name]))} of {len(found[name])} poses over", file=sys.stderr)
    for kind in ("seed", "fitted"):
        own = {name: poses for name, poses in found.items() if name.startswith(kind)}
        if own:
            print(line(kind, own))
    if given.json:
        content = {name: {pose: vars(one) for pose, one in own.items()} for name, own in found.items()}
        given.json.write_text(json.dumps(content, indent=1), encoding="utf-8")


def faces(people: int, fitted: int) -> Iterator[tuple[str, FaceParts]]:
    """Bare heads by name."""
    for seed in range(1, people + 1):
        yield f"seed {seed}", make_head(draw(seed).identity)
    for number in range(fitted):
        yield f"fitted {number}", fitted_person(number, _SEED).parts


def over(found: dict[str, Contact]) -> list[str]:
    """The poses above the bound."""
    return [name for name, one in found.items() if one.cells > BOUND[0] or one.depth > BOUND[1]]


def line(kind: str, found: dict[str, dict[str, Contact]]) -> str:
    """The figures of a kind of people."""
    bad = [name for name, own in found.items() if over(own)]
    most = worst(one for own in found.values() for one in own.values())
    poses_over, every = sum(len(over(own)) for own in found.values()), sum(map(len, found.values()))
    return (
        f"{kind}: {len(bad)} of {len(found)} people and {poses_over} of {every} poses above {BOUND[0]} cells or "
        f"{BOUND[1]} mm; the most {most.cells} cells, {most.depth:.2f} mm"
    )


if __name__ == "__main__":
    main()
