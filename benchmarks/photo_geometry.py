"""How near `facepipe fit-photo` comes to the shapes of people who are known, with landmarks that it finds itself.

usage: python benchmarks/photo_geometry.py [--people 24] [--three N] [--seed 0] [--size 640] [--folder FOLDER]
       [--processes 2] [--json out.json]

People are drawn from the modes of the head in the box, with a residual that these can't hold, and have a skin, eyes and
hair each (`geometry_people.py`). Each has three photos, from the left, the front and the right in any order, up to 30
degrees to a side, each with an expression, a lens, lamps with shadows, and a background. The built-in head is fitted to
the first photo, and to all three, with default options.

Figures are millimetres over the narrow face of the neutral after similarity, of points from the other's surface, means
of both ways. Columns, over people:

  mean, median, p95, worst
  vertices                  points from the same points: mean, and its p95
  share                     of the mean head's error for that person: mean, and worst
  seconds                   of processor time for a fit: mean, and slowest

Rows: the fits, the mean head, and the nearest person that the modes hold, which no fit can be expected to pass. Below
are people who could not be fitted: no face was found, or its landmarks are refused.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from arguments import positive
from children import Json
from geometry_people import RESIDUAL_MM, person, portraits
from narrow_face import NARROW, Apart, apart, narrow_triangles
from PIL import Image
from tables import aligned, verdict

import facepipe
from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FacepipeError

ONE, THREE, MEAN, NEAREST = "one photo", "three photos", "mean head", "nearest of the modes"
FITS = {ONE: 1, THREE: 3}  # -> photos
ROWS = (ONE, THREE, MEAN, NEAREST)
AIMS = {ONE: {"mean": 0.9, "p95": 1.3, "share_worst": 0.6}, THREE: {"mean": 0.65, "share_worst": 0.6}}
WORDS = {"mean": "mm mean", "p95": "mm p95", "share_worst": "worst share of the mean head's error"}
HEADS = ("people", "mean", "median", "p95", "worst", "vertices", "its p95", "share", "worst", "seconds", "slowest")


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A person, and how far what was fitted is from them."""

    number: int
    look: str
    photos: list[Json]
    errors: dict[str, Apart] = field(default_factory=dict)  # by row of the table
    seconds: dict[str, float] = field(default_factory=dict)  # of processor time; no fits that were there before
    failed: dict[str, str] = field(default_factory=dict)  # fit -> why there is none


def main() -> None:
    """Draw, fit, print the table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=positive, default=24, help="default 24")
    parser.add_argument("--three", type=int, metavar="N", help="the first N with three photos too (default all)")
    parser.add_argument("--seed", type=int, default=0, help="of the people (default 0)")
    parser.add_argument("--size", type=positive, default=640, help="pixels a side (default 640)")
    parser.add_argument("--folder", type=Path, help="keep photos and stages here; fits that are there stay")
    parser.add_argument("--processes", type=positive, default=2, help="people at a time (default 2)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as passing:
        people = fit_all(arguments, arguments.folder or Path(passing))
    summary = summarised(people)
    print("\n".join(report(people, summary)))
    if arguments.json:
        options = {name: getattr(arguments, name) for name in ("people", "three", "seed", "size")}
        each = [asdict(one) | {"errors": {row: far._asdict() for row, far in one.errors.items()}} for one in people]
        result = options | {"residual_mm": RESIDUAL_MM, "rows": summary, "each": each}
        arguments.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def fit_all(arguments: argparse.Namespace, folder: Path) -> list[Measured]:
    """All people, several at a time, in processes of one thread."""
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
    os.environ["FACEPIPE_THREADS"] = "1"
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "head.usdc").is_file():
        facepipe.sample(folder / "head.usdc")
    three = arguments.people if arguments.three is None else arguments.three
    people = []
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        tasks = [
            pool.submit(measured, number, arguments.seed, arguments.size, folder, FITS if number < three else (ONE,))
            for number in range(arguments.people)
        ]
        for task in tasks:
            people.append(task.result())
            print(f"\r{len(people)} of {len(tasks)} people", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return people


def measured(number: int, seed: int, size: int, folder: Path, fits: Iterable[str]) -> Measured:
    """A person, photographed and fitted."""
    who, triangles = person(number, seed), narrow_triangles()
    photos, known = [], []
    for side, portrait in enumerate(portraits(who, number, seed, size)):
        photos.append(folder / f"{number:03}.{side}.png")
        Image.fromarray(portrait.image).save(photos[-1])
        known.append({"yaw": portrait.yaw, "lens_mm": portrait.lens_mm})
    found = Measured(number=number, look=who.look, photos=known)
    found.errors[MEAN] = apart(_neutral(folder / "head.usdc"), who.narrow, triangles)
    found.errors[NEAREST] = apart(who.nearest, who.narrow, triangles)
    for fit in fits:
        out, start = folder / f"{number:03}.{FITS[fit]}.usda", time.process_time()
        try:
            if not out.is_file():
                facepipe.fit_photo(folder / "head.usdc", photos=photos[: FITS[fit]], out=out)
                found.seconds[fit] = time.process_time() - start
        except FacepipeError as error:
            found.failed[fit] = str(error)
            continue
        found.errors[fit] = apart(_neutral(out), who.narrow, triangles)
    return found


def _neutral(stage: Path) -> FloatArray:
    """(m, 3) millimetres of the person on a stage, the narrow face."""
    face = facepipe.open(stage)
    return 1000 * face.meters_per_unit * face.evaluate(pose="set")[:NARROW]


def summarised(people: Sequence[Measured]) -> dict[str, dict[str, float]]:
    """Figures of each row that anyone has, over the people who have them."""
    rows = {}
    for row in ROWS:
        known = [one for one in people if row in one.errors]
        if not known:
            continue
        surface, points = (np.array([getattr(one.errors[row], way) for one in known]) for way in Apart._fields)
        share = surface / [one.errors[MEAN].surface for one in known]
        rows[row] = {
            "people": len(known),
            "mean": float(surface.mean()),
            "median": float(np.median(surface)),
            "p95": float(np.percentile(surface, 95)),
            "worst": float(surface.max()),
            "points": float(points.mean()),
            "points_p95": float(np.percentile(points, 95)),
            "share": float(share.mean()),
            "share_worst": float(share.max()),
        }
        seconds = [one.seconds[row] for one in known if row in one.seconds]
        if seconds:
            rows[row] |= {"seconds": float(np.mean(seconds)), "seconds_worst": float(max(seconds))}
    return rows


def report(people: Sequence[Measured], summary: dict[str, dict[str, float]]) -> list[str]:
    """The figures for people, as lines."""
    lengths = ("mean", "median", "p95", "worst", "points", "points_p95")
    cells: list[tuple[str, ...]] = [("", "", *HEADS)]
    for row, one in summary.items():
        shares = [f"{one[name]:.2f}" for name in ("share", "share_worst")]
        seconds = [f"{one[name]:.1f}" if name in one else "" for name in ("seconds", "seconds_worst")]
        cells.append(("", row, f"{one['people']}", *(f"{one[name]:.2f}" for name in lengths), *shares, *seconds))
    lines = [*aligned(cells), "", f"residual that no modes hold: {RESIDUAL_MM} mm RMS over the narrow face"]
    for fit, aims in AIMS.items():
        if fit in summary:
            lines += [verdict(f"{fit}, {WORDS[name]}", summary[fit][name], aim) for name, aim in aims.items()]
    for fit in FITS:
        tried = sum(fit in one.errors or fit in one.failed for one in people)
        lines.append(f"{fit}, not fitted: {sum(fit in one.failed for one in people)} of {tried} people")
    lines += [f"- person {one.number}, {fit}: {why}" for one in people for fit, why in one.failed.items()]
    return lines


if __name__ == "__main__":
    main()
