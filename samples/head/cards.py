"""Cards of brows, lashes and hair: thin strips whose every point is held by a triangle of the skin.

usage: python samples/head/cards.py ict_facekit.npz facepipe/heads/data
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from brows_lashes import brow_grids, lash_grids, lash_motion
from grids import Binder, Skin
from hair import STYLES, coil_grids, hair_grids
from packing import write_arrays
from skin_maps import FACE, SOCKETS, Template, masks


def main(source: Path, folder: Path) -> None:
    """Make and save all sets."""
    template, data = Template(source), np.load(source)
    skin, painted = Skin(template), masks(template)
    scalp = painted["scalp"]
    holds = np.maximum(scalp, painted["ears"]) > 0.3  # hair that falls over ears goes where they go
    face = np.zeros(len(template.points), bool)
    face[np.setdiff1d(template.used(FACE), template.used(SOCKETS))] = True
    arrays = Binder(template, face).arrays("brows", brow_grids(template, skin))
    arrays |= Binder(template, face).arrays("lashes", lash_grids(data))
    arrays |= lash_motion(data, arrays)
    for name, style in STYLES.items():
        grids = hair_grids(template, skin, style, scalp)
        print(name, grids.points.shape)
        arrays |= Binder(template, holds).arrays(name, grids)
    grids = coil_grids(template, skin, scalp)
    print("coils", grids.points.shape)
    arrays |= Binder(template, holds).arrays("coils", grids)
    write_arrays(folder / "cards.npz", arrays)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
