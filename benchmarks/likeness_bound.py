"""How like their photos portraits are that have nothing wrong: what no fit can be expected to pass.

People are those of `photo_geometry.py`, drawn from the head in the box with a residual, skin and hair, each with three
photos with expressions, lenses and lights. The front is of the very person: the true neutral with the true skin and
hair in studio light, as `likeness.py` draws it of those that are fitted. It and photos are judged by dlib as there:

    python benchmarks/likeness_bound.py --dlib dlib-env/bin/python [--people 16] [--seed 0] [--size 640]
        [--json out.json]

Figures are distances of face descriptors: mean, tenth and ninetieth percentile, worst. Rows:

  front            the front to a photo, from whatever side
  front, nearly    the same of the photos within 10 degrees of the front
  photos           two photos of one person
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
from children import ChildError, run_child
from geometry_people import person, portraits
from likeness_pictures import SIZE
from PIL import Image
from tables import aligned

from facepipe.pictures import PictureOptions, picture

_NEARLY = 10.0  # degrees
ROWS = ("front", "front, nearly", "photos")


def main() -> int:
    """Draw, judge, print; 2 where dlib is not to be had."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dlib", required=True, metavar="PYTHON", help="an interpreter with dlib")
    parser.add_argument("--people", type=positive, default=16, help="default 16")
    parser.add_argument("--seed", type=int, default=0, help="of the people (default 0)")
    parser.add_argument("--size", type=positive, default=640, help="pixels a side of photos (default 640)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as passing:
        folder = Path(passing)
        drawn = [_drawn(number, arguments, folder) for number in range(arguments.people)]
        files = [file for front, photos in drawn for file in (front, *photos)]
        try:
            seen = run_child(arguments.dlib, Path(__file__).with_name("dlib_faces.py"), *files, folder / "seen.json")
        except (ChildError, OSError) as error:
            print(error, file=sys.stderr)
            return 2
    found = {file: np.array(row) for file, row in zip(files, seen["descriptors"], strict=True) if row is not None}
    values = distances(drawn, found)
    print(
        "\n".join(aligned([("row", "pairs", "mean", "p10", "p90", "worst"), *(_cells(*row) for row in values.items())]))
    )
    print(f"no face found: {len(files) - len(found)} of {len(files)} pictures")
    if arguments.json:
        arguments.json.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    return 0


def _drawn(number: int, arguments: argparse.Namespace, folder: Path) -> tuple[Path, dict[Path, float]]:
    """A person's front, and the yaw of each photo, degrees."""
    who, photos = person(number, arguments.seed), {}
    front = folder / f"{number}.front.png"
    Image.fromarray(np.asarray(picture(who.parts, None, PictureOptions(size=SIZE, samples=2)))).save(front)
    for each, photo in enumerate(portraits(who, number, arguments.seed, arguments.size)):
        file = folder / f"{number}.{each}.png"
        Image.fromarray(photo.image).save(file)
        photos[file] = photo.yaw
    return front, photos


def distances(drawn: list[tuple[Path, dict[Path, float]]], found: dict[Path, np.ndarray]) -> dict[str, list[float]]:
    """Of the pairs of each row of which both pictures show a face."""
    values: dict[str, list[float]] = {row: [] for row in ROWS}
    for front, photos in drawn:
        known = [photo for photo in photos if photo in found]
        for photo in known if front in found else []:
            apart = float(np.linalg.norm(found[front] - found[photo]))
            values["front"].append(apart)
            if abs(photos[photo]) <= _NEARLY:
                values["front, nearly"].append(apart)
        values["photos"] += [float(np.linalg.norm(found[one] - found[other])) for one, other in combinations(known, 2)]
    return values


def _cells(row: str, values: list[float]) -> tuple[str, ...]:
    if not values:
        return (row, "0", "", "", "", "")
    figures = (np.mean(values), *np.quantile(values, [0.1, 0.9]), np.max(values))
    return (row, str(len(values)), *(f"{figure:.3f}" for figure in figures))


if __name__ == "__main__":
    sys.exit(main())
