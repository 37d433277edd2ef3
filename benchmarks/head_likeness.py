"""Whether people drawn from the head in the box look like people, and like different ones, to a face recogniser.

Front renders of seeds go to dlib, which stays in an environment of its own:

    python3.11 -m venv dlib-env && dlib-env/bin/pip install dlib-bin numpy face_recognition_models "setuptools<81"
    python benchmarks/head_likeness.py --dlib dlib-env/bin/python [--people 50] [--bald] [--pictures FOLDER]
        [--json out.json]

Found: pictures in which its detector finds a face. Distance: of two seeds' face descriptors, the mean over all pairs,
and the pair that is most alike; below 0.6 dlib takes two pictures for one person's. Distinct: the largest set of people
of whom no two are so near. With --bald all have one tone, no hair and eyes of one colour: what is left are shapes.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from itertools import combinations
from pathlib import Path

import numpy as np
from arguments import positive
from children import ChildError, Json, run_child
from head_ages import drawn
from scipy.optimize import Bounds, LinearConstraint, milp

import facepipe
from facepipe.heads.people import draw

_CHILD = Path(__file__).with_name("dlib_faces.py")
SIZE = 512  # pixels a side
ONE_PERSON = 0.6  # distance of descriptors below which dlib takes two pictures for one person's


def main() -> int:
    """Draw, look, print; 1 where a face is not found or people are too alike."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dlib", required=True, metavar="PYTHON", help="an interpreter with dlib")
    parser.add_argument("--people", type=positive, default=50, help="seeds from 1 (default 50)")
    parser.add_argument("--bald", action="store_true", help="without hair, of one tone and colour of eyes")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="keep the pictures here")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as passing:
        folder = arguments.pictures or Path(passing)
        folder.mkdir(parents=True, exist_ok=True)
        pictures = [_drawn(seed, folder, bald=arguments.bald) for seed in range(1, arguments.people + 1)]
        try:
            seen = run_child(
                arguments.dlib, Path(__file__).with_name("dlib_faces.py"), *pictures, f"{passing}/seen.json"
            )
        except ChildError as error:
            print(f"dlib: {error}", file=sys.stderr)
            return 2
    figures = measured(seen)
    lines = [f"found     {figures['found']} of {figures['people']}"]
    lines.append("distance  mean {mean:.3f}, least {least:.3f} (seeds {pair[0]} and {pair[1]})".format(**figures))
    lines.append("alike     {alike:.1%} of pairs; {distinct} people distinct".format(**figures))
    print("\n".join(lines))
    if arguments.json:
        arguments.json.write_text(json.dumps({**figures, **seen}, indent=2), encoding="utf-8")
    return 0 if figures["found"] == figures["people"] and figures["mean"] >= ONE_PERSON else 1


def measured(seen: Json) -> Json:
    """Figures of what dlib saw."""
    people = {seed: np.array(one) for seed, one in enumerate(seen["descriptors"], 1) if one is not None}
    far = {pair: float(np.linalg.norm(people[pair[0]] - people[pair[1]])) for pair in combinations(people, 2)}
    nearest = min(far, key=far.__getitem__, default=(0, 0))
    return {
        "people": len(seen["descriptors"]),
        "found": len(people),
        "mean": float(np.mean([*far.values()])) if far else 0.0,
        "least": far.get(nearest, 0.0),
        "pair": nearest,
        "alike": float(np.mean([one < ONE_PERSON for one in far.values()])) if far else 0.0,
        "distinct": _distinct([*people], [pair for pair, one in far.items() if one < ONE_PERSON]),
    }


def _distinct(people: list[int], alike: list[tuple[int, int]]) -> int:
    """The size of the largest set of people that holds no two who are alike, exactly."""
    if not alike:
        return len(people)
    both = np.array([[one in pair for one in people] for pair in alike], float)
    found = milp(-np.ones(len(people)), integrality=1, bounds=Bounds(0, 1), constraints=LinearConstraint(both, ub=1))
    return round(-found.fun)


def _drawn(seed: int, folder: Path, *, bald: bool) -> Path:
    if bald:
        return drawn(draw(seed), bald=True, path=folder / f"{seed}.png")
    stage, picture = folder / f"{seed}.usdc", folder / f"{seed}.png"
    facepipe.sample(stage, seed=seed, overwrite=True)
    facepipe.render(stage, out=picture, size=SIZE, overwrite=True)
    return picture


if __name__ == "__main__":
    sys.exit(main())
