"""Modes of lids and lips for payloads of persons: what fits of eyes and mouth do to people, beside the identity modes.

Eyeballs, lids, lips and the mouth's inside of a person are fitted to the skin (`facepipe.heads`), which no sum of
identity modes is: of people drawn by seeds these leave 0.043 mm of the skin on average. Principal components of what
the fits change, over people that seeds draw, take that to 0.013, for two bytes each: the first ten halve it again
from the first three, ten more a tenth.

    python samples/head/person_modes.py facepipe/heads/data
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from packing import STEP

from facepipe.heads.assembly import with_parts_fitted
from facepipe.heads.asset import BASIS, IDENTITY_MODES, asset
from facepipe.heads.lip_fit import fit_lips
from facepipe.heads.people import draw
from facepipe.payload.basis import encode_basis
from facepipe.verbs.person_basis import MOUTH

COUNT = 10  # the mean change, and components
_SEEDS = range(5000, 5300)


def main() -> None:
    """Draw, fit, write."""
    head = asset()
    skin = head.parts["Head"].points
    seen = np.delete(np.arange(skin.stop), np.arange(MOUTH.start, MOUTH.stop))
    changes = []
    for seed in _SEEDS:
        points = head.points + np.tensordot(draw(seed).identity, head.modes, axes=1)
        changes.append((with_parts_fitted(fit_lips(points)) - points)[skin])
        print(f"\r{len(changes)} of {len(_SEEDS)}", end="", file=sys.stderr)
    print(file=sys.stderr)
    found = np.array(changes)
    mean = found.mean(axis=0)
    # components of what is seen; the mouth's inside goes as it did with them
    turns, sizes, _ = np.linalg.svd((found - mean)[:, seen].reshape(len(found), -1), full_matrices=False)
    scores = turns[:, : COUNT - 1] * np.sqrt(len(found))
    components = np.tensordot(scores.T, found - mean, axes=1) / len(found)
    modes = np.zeros((COUNT, *head.points.shape))
    modes[:, skin] = [mean, *components]
    print("deviations of the components, cm:", np.round(sizes[:COUNT] / np.sqrt(found[0].size), 5))
    steps = np.rint(modes.transpose(0, 2, 1) / STEP).astype(np.int16)
    with_them = replace(head.basis, modes=np.concatenate([head.basis.modes[:IDENTITY_MODES], steps]))
    (Path(sys.argv[1]) / BASIS).write_bytes(encode_basis(with_them))


if __name__ == "__main__":
    main()
