"""What is typical of men and of the old, as weights of the identity modes.

The sources are MakeHuman's macro targets (CC0): sculpts by artists, not statistics of measured people, in the mean over
its three ethnic groups, and over both sexes where sex is not what differs. Each is carried to ICT-FaceKit by a warp of
landmarks and then fitted by the modes, within what they show of real people: `share` says how much of it they show.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from measures import STEP

from facepipe.geometry.closest_points import closest_places, place_shares
from facepipe.geometry.similarity import fit_similarity
from facepipe.geometry.warp import fit_warp
from facepipe.importers.makehuman import landmark_points
from facepipe.importers.makehuman_rig import MakeHumanData, read_data

FACE = 9409  # points of the face of ICT-FaceKit
RIDGE = 10.0  # cm^2 of squared motion, summed over the face's points, that a squared standard deviation is worth

Floats = npt.NDArray[np.float64]

_GROUPS = ("african", "asian", "caucasian")
_SEXES = ("female", "male")
TRAITS = {  # name -> targets that are added and taken away
    "sex": (["macro/{group}-male-young"], ["macro/{group}-female-young"]),
    "age": ([f"macro/{{group}}-{sex}-old" for sex in _SEXES], [f"macro/{{group}}-{sex}-young" for sex in _SEXES]),
}


def build(
    points: Floats, modes: npt.NDArray[np.float32], landmarks: npt.NDArray[np.int32], parity: Floats, source: Path
) -> dict[str, npt.NDArray[Any]]:
    """The weights (traits, 100), in steps, of half of each difference, and the share (traits,) of it that they show."""
    data = read_data(source)
    fields = carried(points[:FACE], points[landmarks], data)
    flat = modes[parity > 0, :FACE].reshape(int((parity > 0).sum()), -1).astype(np.float64)
    moves = np.tile(np.eye(3)[1:], FACE)  # up and forward: where a head stands is not its shape
    weights, shares = np.zeros((len(fields), len(modes))), np.zeros(len(fields))
    basis = np.vstack([flat, moves])
    cost = np.diag(np.append(np.full(len(flat), RIDGE), np.zeros(len(moves))))
    for row, field in enumerate(fields.reshape(len(fields), -1)):
        found = np.linalg.solve(basis @ basis.T + cost, basis @ field)
        still = field - moves.T @ np.linalg.lstsq(moves.T, field, rcond=None)[0]
        shares[row] = 1.0 - ((field - found @ basis) ** 2).sum() / (still**2).sum()
        weights[row, parity > 0] = found[: len(flat)]
    steps = np.rint(weights / STEP).astype(np.int16)
    return {"traits": np.array(list(TRAITS)), "trait_weights": steps, "trait_shares": np.round(shares, 4)}


def carried(points: Floats, landmarks: Floats, data: MakeHumanData) -> Floats:
    """(traits, FACE, 3) half of each difference in cm at points of the face, made symmetric by the fit."""
    skin = data.points_of("skin")
    place = np.full(len(data["vertices"]), -1)
    place[skin] = np.arange(len(skin))
    quads = place[data["faces"]]
    quads = quads[(quads >= 0).all(axis=1)]
    triangles = np.vstack([quads[:, :3], quads[:, [0, 2, 3]]])
    base, marks = data["vertices"][skin].astype(np.float64), landmark_points(data)
    warp = fit_warp(base[marks], landmarks, smoothing=0.1)
    warped = warp.apply(base)
    found = closest_places(points, warped, triangles)
    shares = place_shares(found, warped, triangles)
    turn = warp.similarity.scale * warp.similarity.rotation
    corners = triangles[found.triangles]
    fields = [
        (_typical(data, base, skin, more) - _typical(data, base, skin, less)) @ turn.T for more, less in TRAITS.values()
    ]
    return np.stack([np.einsum("nc,ncx->nx", shares, field[corners]) / 2 for field in fields])


def _difference(
    data: MakeHumanData, base: Floats, skin: npt.NDArray[np.int32], more: list[str], less: list[str]
) -> Floats:
    """(n, 3) what the targets of `more` do beyond those of `less`, heads being laid over one another."""
    return _typical(data, base, skin, more) - _typical(data, base, skin, less)


def _typical(data: MakeHumanData, base: Floats, skin: npt.NDArray[np.int32], names: list[str]) -> Floats:
    """(n, 3) the mean head of some targets, moved and turned onto the base."""
    numbers = {name: number for number, name in enumerate(data.names("target_names"))}
    wanted = sorted({name.format(group=group) for name in names for group in _GROUPS})
    head = base + np.mean([data.target(numbers[name])[skin] for name in wanted], axis=0)
    return np.asarray(fit_similarity(head, base, scale=False).apply(head))
