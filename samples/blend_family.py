"""Children of two faces: each region of the face takes after one parent or the other, more or less.

usage: python samples/blend_family.py MOTHER FATHER FOLDER [COUNT]

FOLDER gets child_1.usdc ... and a GLB of each, 3 by default. The parents have one topology and named regions. Whom a
child takes after stays in its recipe: `facepipe blend --edit child_1.usdc --set nose=1,0 --force` changes the nose.
"""

from __future__ import annotations

import random
import sys
from pathlib import Path

import facepipe
from facepipe.parts import all_regions


def weights(regions: list[str], seed: int) -> dict[str, list[float]]:
    """By region, the mother's and the father's share."""
    draw = random.Random(seed)
    shares = {region: round(draw.betavariate(0.5, 0.5), 2) for region in regions}  # rather one parent than the mean
    return {region: [share, 1.0 - share] for region, share in shares.items()}


def born(mother: Path, father: Path, child: Path, seed: int) -> None:
    """Blend a child and export it."""
    regions = sorted(all_regions(facepipe.read(mother).meshes))
    taken = weights(regions, seed)
    facepipe.blend([mother, father], out=child, weights={**taken, "default": [0.5, 0.5]}, overwrite=True)
    facepipe.export(child, child.with_suffix(".glb"), overwrite=True)
    after = {"mother": 0, "father": 1}
    for parent, number in after.items():
        print(f"{child.name}: from the {parent}: {', '.join(name for name in regions if taken[name][number] > 0.5)}")


def main(words: list[str]) -> int:
    """The exit code."""
    if len(words) not in (3, 4):
        print(__doc__, file=sys.stderr)
        return 2
    mother, father, folder = map(Path, words[:3])
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(1, 1 + (int(words[3]) if len(words) == 4 else 3)):
        born(mother, father, folder / f"child_{number}.usda", number)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
