"""How like their photos portraits are that have nothing wrong: what no fit can be expected to pass.

People are those of `photo_geometry.py`, drawn from the head in the box with a residual, skin and hair, each with three
photos with expressions, lenses and lights. They are drawn as `likeness.py` draws those that are fitted, but as they
are: the true neutral with the true skin and hair in studio light. Pictures are judged by dlib as there:

    python benchmarks/likeness_bound.py --dlib dlib-env/bin/python [--people 16] [--seed 0] [--size 640]
        [--fits FOLDER] [--json out.json]

Figures are distances of face descriptors: mean, tenth and ninetieth percentile, worst. Rows:

  front, front (nearly)   the front to a photo; to one within 10 degrees of the front
  yaw                     the neutral from 30 degrees to either side to a photo
  photos                  two photos of one person
  no skin: ...            with the head's own skin, in the camera and light of a fit, all else grey: the fit, the
                          true shape in its place, and the mean head; of fits that `photo_geometry.py --folder` keeps
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import numpy.typing as npt
import support_modules  # noqa: F401  (finds the modules of tests/support)
from arguments import positive
from children import ChildError, run_child
from geometry_people import person, portraits
from likeness_pictures import MASKED, PHOTO, SIZE, YAWS, PicturedPerson
from PIL import Image
from recovery_targets import posed
from tables import aligned

import facepipe
from facepipe.core.arrays import FloatArray
from facepipe.photo.fit import read_photo
from facepipe.pictures import PictureOptions
from facepipe.pictures.face_picture import pictures
from facepipe.rig import build

_NEARLY = 10.0  # degrees

Pair = tuple[str, Path, Path]  # row, and the two pictures


def main() -> int:
    """Draw, judge, print; 2 where dlib is not to be had."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dlib", required=True, metavar="PYTHON", help="an interpreter with dlib")
    parser.add_argument("--people", type=positive, default=16, help="default 16")
    parser.add_argument("--seed", type=int, default=0, help="of the people (default 0)")
    parser.add_argument("--size", type=positive, default=640, help="pixels a side of photos (default 640)")
    parser.add_argument("--fits", type=Path, help="of the same people, kept by photo_geometry.py")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as passing:
        folder = Path(passing)
        pairs = [
            pair
            for number in range(arguments.people)
            for pair in _pairs(number, arguments.seed, arguments.size, folder)
        ]
        if arguments.fits:
            shapes = [_shapes(number, arguments.seed, arguments.fits, folder) for number in range(arguments.people)]
            pairs += [pair for each in shapes for pair in each]
        files = list(dict.fromkeys(file for _, *both in pairs for file in both))
        try:
            seen = run_child(arguments.dlib, Path(__file__).with_name("dlib_faces.py"), *files, folder / "seen.json")
        except (ChildError, OSError) as error:
            print(error, file=sys.stderr)
            return 2
    found = {file: np.array(row) for file, row in zip(files, seen["descriptors"], strict=True) if row is not None}
    values = distances(pairs, found)
    rows = [(row, *_cells(figures)) for row, figures in values.items()]
    print("\n".join(aligned([("row", "pairs", "mean", "p10", "p90", "worst"), *rows])))
    print(f"no face found: {len(files) - len(found)} of {len(files)} pictures")
    if arguments.json:
        arguments.json.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    return 0


def _pairs(number: int, seed: int, size: int, folder: Path) -> Iterator[Pair]:
    """Pictures of a person, drawn."""
    who = person(number, seed)
    options = [PictureOptions(size=SIZE, samples=2, view=(np.radians(yaw), 0.0)) for yaw in YAWS.values()]
    drawn = {}
    for line, image in zip(YAWS, pictures(who.parts, None, options), strict=True):
        drawn[line] = folder / f"{number}.{line}.png"
        image.save(drawn[line])
    photos = []
    for each, photo in enumerate(portraits(who, number, seed, size)):
        photos.append(_saved(photo.image, folder / f"{number}.{each}.png"))
        for line, picture in drawn.items():
            yield "front" if line == "front" else "yaw", picture, photos[-1]
        if abs(photo.yaw) <= _NEARLY:
            yield "front (nearly)", drawn["front"], photos[-1]
    yield from (("photos", one, other) for one, other in combinations(photos, 2))


def _shapes(number: int, seed: int, fits: Path, folder: Path) -> Iterator[Pair]:
    """Shapes with the head's own skin, in the place of a fit."""
    who, face = person(number, seed), facepipe.open(fits / f"{number:03}.1.usda")
    photo, mean = read_photo(fits / f"{number:03}.0.png").pixels, facepipe.open(fits / "head.usdc").evaluate()
    heads = {"fit": None, "true shape": posed(who.parts, build(who.parts), {}, {}), "mean head": mean}
    for shape, points in heads.items():
        shown = dict(PicturedPerson(face, points).pictures(photo))
        files = {line: folder / f"{number}.{shape}.{line}.png" for line in (MASKED, PHOTO)}
        for line, file in files.items():
            shown[line].save(file)
        yield f"no skin: {shape}", files[MASKED], files[PHOTO]


def _saved(image: npt.NDArray[np.uint8], file: Path) -> Path:
    Image.fromarray(image).save(file)
    return file


def distances(pairs: Iterable[Pair], found: Mapping[Path, FloatArray]) -> dict[str, list[float]]:
    """By row, of the pairs of which both pictures show a face."""
    values: dict[str, list[float]] = {}
    for row, one, other in pairs:
        if one in found and other in found:
            values.setdefault(row, []).append(float(np.linalg.norm(found[one] - found[other])))
    return values


def _cells(values: Sequence[float]) -> tuple[str, ...]:
    figures = (np.mean(values), *np.quantile(values, [0.1, 0.9]), np.max(values))
    return str(len(values)), *(f"{figure:.3f}" for figure in figures)


if __name__ == "__main__":
    sys.exit(main())
