"""Expressions of blends and of a scan that are rebuilt from 10,000 bytes, against the stage's own: 52 shapes, 50 poses.

Millimetres, mean over the head: at rest, then the mean and the worst of shapes and of poses, with the rig in the
payload and without. Blends are of two drawn people, eyes of one, nose of the other, mouth of both.

example: python benchmarks/person_expressions.py --people 3
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import support_modules  # noqa: F401  (finds the modules of tests/support)
from arguments import positive
from person_bytes import SCAN
from rebuilt_expressions import against_its_own
from tables import aligned

import facepipe
from facepipe.heads import make
from facepipe.stage import save_parts

_FIRST = 1500  # seed
_REGIONS = {"eyes": [1.0, 0.0], "nose": [0.0, 1.0], "mouth": [0.5, 0.5]}


def main() -> None:
    """Make, rebuild, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=positive, default=3, help="blends (default 3)")
    given = parser.parse_args()
    rows = [("person", "bytes", "rig", "rest", "shapes", "worst", "poses", "worst")]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_parts(make(0), folder / "head.usdc")
        for number, face in enumerate(faces(given.people, folder)):
            own = folder / f"{number}"
            own.mkdir()
            for rig, found in against_its_own(face, folder / "head.usdc", own).items():
                size = (own / f"{rig}.fpb").stat().st_size
                figures = (found.rest, *(of for one in (found.shapes, found.poses) for of in (one.mean(), one.max())))
                rows.append((face.stem, f"{size:,}", rig, *(f"{figure:.3f}" for figure in figures)))
            print("\n".join(aligned(rows)), flush=True)


def faces(count: int, folder: Path) -> Iterator[Path]:
    """Blends, then a scan where the data is there."""
    for number in range(count):
        pair = [folder / f"{number}_{side}.usdc" for side in range(2)]
        for side, path in enumerate(pair):
            save_parts(make(_FIRST + 2 * number + side), path)
        facepipe.blend(pair, out=folder / f"blend{number}.usdc", weights={"regions": _REGIONS})
        yield folder / f"blend{number}.usdc"
    if SCAN.exists():
        facepipe.fit_neutral(SCAN, out=folder / "scan.usdc")
        yield folder / "scan.usdc"


if __name__ == "__main__":
    main()
