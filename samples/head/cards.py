"""Cards of brows, lashes and hair: thin strips whose every point is held by a triangle of the skin.

usage: python samples/head/cards.py ict_facekit.npz facepipe/heads/data
"""

from __future__ import annotations

import sys
from pathlib import Path

import beards
import numpy as np
from brows_lashes import brow_grids, lash_grids, lash_motion
from grids import Binder, Skin
from hair import hair_grids
from hairstyles import STYLES
from packing import write_arrays
from skin_maps import FACE, SOCKETS, Template, masks


def main(source: Path, folder: Path) -> None:
    """Make and save all sets."""
    template, data = Template(source), np.load(source)
    painted = masks(template)
    scalp, ears = painted["scalp"], painted["ears"] > 0.3
    skin, beside_ears = Skin(template), Skin(template, ears)
    face = np.zeros(len(template.points), bool)
    face[np.setdiff1d(template.used(FACE), template.used(SOCKETS))] = True
    arrays = Binder(template, face).arrays("brows", [brow_grids(template, skin)])
    arrays |= Binder(template, face).arrays("lashes", [lash_grids(data)])
    write_arrays(folder / "cards.npz", arrays | lash_motion(data, arrays))
    hair, holds = {}, Binder(template, (scalp > 0.3) | ears)  # hair that falls over ears goes where they go
    for name, style in STYLES.items():
        grids = hair_grids(template, skin if style.falls else beside_ears, style, scalp > 0.3)
        hair |= holds.arrays(name, grids)
    zone = painted["beard"]
    for name, parts in beards.styles(template, zone).items():
        layers = [one for style in parts for one in hair_grids(template, skin, style, zone > 0.1)]
        hair |= Binder(template, zone > 0.1).arrays(name, layers)
    write_arrays(folder / "hair.npz", hair)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
