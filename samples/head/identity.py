"""What identity sliders take of measures: each is a mode of the head less its measures.

A slider of a mode, or of a sum of modes, takes off by the sliders of measures what the mode adds to these, so that
it moves none. `gains` solve that for what sliders do on the head that ships, with joints of lids and eyes: of the mean
of both sides for symmetric modes, of half their difference for antisymmetric ones. Named sliders are those sums of
symmetric modes that move a region most beside the rest of the skin (largest eigenvalues of its share of the motion).

    python samples/head/identity.py facepipe/heads/data
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import measures
import numpy as np
import numpy.typing as npt
from directions import REACH
from packing import write_arrays

from facepipe.heads.assembly import (
    IDENTITY_STEP,
    MODE,
    blendshapes_of,
    directions,
    identity_sliders,
    make,
    sliders_of,
)
from facepipe.heads.asset import arrays, asset
from facepipe.stage import Face

REGIONS = {  # mask of the head: group of its sliders, and what their names begin with
    "nose": ("nose", "nose"),
    "eyes": ("eyes", "eye"),
    "eyebrows": ("brows", "brow"),
    "forehead": ("forehead", "forehead"),
    "cheek": ("cheeks", "cheek"),
    "mouth": ("mouth", "mouth"),
    "chin": ("jaw", "chin"),
    "ears": ("ears", "ear"),
    "neck": ("neck", "neck"),
}
EACH = 2  # sliders of a region
ROUNDS = 2  # in which what is left of measures goes
LEAST = 0.004  # standard deviations of a measure: less is left in a mode
AROUND = 0.02  # of the motion of all the skin counts beside that of the region, so that noise is no shape
STILL = 1e6  # cm^2: how much it counts that eyes stay as open as they are
SIZE = 2.2  # standard deviations that a named slider goes at 1; at 3 three of them open eyes by 0.024

Floats = npt.NDArray[np.float64]


def main() -> None:
    """Measure, solve, write."""
    head, data = asset(), arrays("measures")
    places = measures.spots(head.points, head.landmarks)
    deviations = data["deviations"].astype(np.float64)
    skin = slice(0, measures.SKIN)
    modes = head.modes[:, skin].astype(np.float64)
    even = measures._mirror_products(head.points, modes) > 0
    left = measures.functionals(places) / deviations[:, None, None]
    other = _mirror(head.points)
    right = left[:, other] * (-1.0, 1.0, 1.0)
    halves = [np.einsum("dnc,mnc->dm", one, modes, optimize=True) for one in (left, right)]
    # the average head with measures alone
    parts, own = make(0, controls="bones"), [one for each in directions() for one in each.shapes]
    moves = {one.name: {1.0: one.offsets} for one in own}
    meshes = (replace(mesh, blendshapes=blendshapes_of(head.parts[mesh.name], moves)) for mesh in parts.meshes)
    face = Face.from_parts(replace(parts, meshes=tuple(meshes), sliders=identity_sliders(), animations=()))
    still = face.evaluate()[skin]
    known = directions()[: len(deviations)]
    sided = np.array([one.sided for one in known])

    def effect(values: dict[str, float], sign: float) -> Floats:
        moved = face.evaluate(sliders=values)[skin] - still
        one, two = (np.einsum("dnc,nc->d", side, moved, optimize=True) for side in (left, right))
        return np.asarray((one + sign * two) / 2)

    both = np.stack([effect({one.name: 1.0}, 1.0) for one in known], axis=1)
    apart = np.stack(
        [effect({f"{one.name}Left": 1.0, f"{one.name}Right": -1.0}, -1.0) for one in known if one.sided], axis=1
    )[sided]
    gains = np.zeros((len(modes), len(known)))
    gains[even] = np.linalg.solve(both, (halves[0] + halves[1])[:, even] / 2).T
    odd = np.flatnonzero(~even)
    gains[np.ix_(odd, np.flatnonzero(sided))] = np.linalg.solve(apart, (halves[0] - halves[1])[sided][:, odd] / 2).T
    whole = make(0)
    for _ in range(ROUNDS):
        # joints and lids follow a mode, and what sliders do by these joints with them: 0.05 deviations of open eyes
        made = {one.name: one for one in sliders_of(table(modes, gains, even))}
        person = Face.from_parts(replace(whole, sliders=tuple(made.values())))
        rest = person.evaluate()[skin]
        for mode, is_even in enumerate(even):
            moved = person.evaluate(sliders={f"{MODE}{mode + 1:03}": 1.0})[skin] - rest
            one, two = (np.einsum("dnc,nc->d", side, moved, optimize=True) for side in (left, right))
            if is_even:
                gains[mode] += np.linalg.solve(both, (one + two) / 2)
            else:
                gains[mode, sided] += np.linalg.solve(apart, (one - two)[sided] / 2)
    data = table(modes, gains, even)
    write_arrays(Path(sys.argv[1]) / "identity.npz", data)
    names = data["names"].tolist()
    print(f"{(data['gains'] != 0).sum()} gains, largest {np.abs(gains).max():.3f}; {', '.join(names)}")


def table(modes: Floats, gains: Floats, even: npt.NDArray[np.bool_]) -> dict[str, npt.NDArray[Any]]:
    """The arrays of the file."""
    gains = np.where(np.abs(gains) * REACH < LEAST, 0.0, gains)
    names, groups, weights = shapes(modes, gains, even)
    return {
        "gains": np.rint(gains / IDENTITY_STEP).astype(np.int16),
        "even": even,
        "names": np.array(names),
        "groups": np.array(groups),
        "weights": np.rint(weights / IDENTITY_STEP).astype(np.int16),
    }


def _mirror(points: Floats) -> npt.NDArray[np.intp]:
    from scipy.spatial import cKDTree

    skin = points[: measures.SKIN]
    return np.asarray(cKDTree(skin).query(skin * (-1, 1, 1))[1])


def shapes(modes: Floats, gains: Floats, even: npt.NDArray[np.bool_]) -> tuple[list[str], list[str], Floats]:
    """Names, groups and weights (r, modes) of the named sliders."""
    moves = np.stack([one.offsets[: measures.SKIN] for one in directions()[: gains.shape[1]]]).astype(np.float64)
    left = (modes - np.tensordot(gains, moves, axes=1))[even]
    # joints open eyes, by scales of lids: those of sliders that change lids would be scaled with them
    opening = gains[even, list(arrays("measures")["names"]).index("eyeOpening")]
    names, groups, rows = [], [], []
    for region, (group, name) in REGIONS.items():
        mask = np.asarray(asset().regions[region])[: measures.SKIN, None]
        inside = (left * mask).reshape(len(left), -1)
        whole = left.reshape(len(left), -1)
        within, around = inside @ inside.T, whole @ whole.T
        around += AROUND * np.trace(around) / len(around) * np.eye(len(around))
        around += STILL * np.outer(opening, opening)
        root = np.linalg.cholesky(around)
        turned = np.linalg.solve(root, np.linalg.solve(root, within).T)
        found = np.linalg.solve(root.T, np.linalg.eigh((turned + turned.T) / 2)[1][:, ::-1][:, :EACH])
        for number in range(EACH):
            row = np.zeros(len(even))
            row[even] = SIZE * found[:, number] / np.linalg.norm(found[:, number])
            row *= np.sign(row[np.abs(row).argmax()])
            names.append(f"{name}Shape{number + 1}")
            groups.append(group)
            rows.append(row)
    return names, groups, np.array(rows)


if __name__ == "__main__":
    main()
