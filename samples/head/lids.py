"""Where the lids are: rings of points around the openings of the eyes; and how their joints open them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from anatomy import eye_centre
from model import KEPT, Floats, Ints, Model
from scipy.sparse import coo_array
from scipy.spatial import cKDTree
from skeleton import Skeleton

from facepipe.heads.assembly import MEET
from facepipe.importers.ict import MATERIALS

RINGS = 13  # 0 behind the margin, 1 to 4 the margin, then out over the lid
_LASHES = 3  # the ring where margins meet
_CORNERS = 2  # the ring whose leftmost and rightmost points are the corners of the eye
_FAINTEST = 0.1  # of the height of lids: what opens eyes less is left to shapes


@dataclass(frozen=True)
class Stretch:
    """What lids' joints do at twice their scale along y, with where lids meet kept in place."""

    up: Floats  # (n,) cm that points go up
    margins: tuple[Ints, Ints]  # (k,) upper and lower points that meet
    apart: Floats  # (k,) cm that open margins go from one another, less what closed ones do

    def opening(self, moved: Floats) -> Floats:
        """(d,) the share of it that opens eyes as far as offsets (d, n, 3) do; 0 where that is hardly any."""
        upper, lower = (moved[:, rows, 1] for rows in self.margins)
        found = np.round((upper - lower) @ self.apart / (self.apart @ self.apart), 3)
        return np.where(np.abs(found) < _FAINTEST, 0.0, found)


def stretch(model: Model, made: Skeleton, found: dict[str, Any]) -> Stretch:
    """Of the lids that `lids` found."""
    joints = [number for number, path in enumerate(made.joints) if "/lid" in path]
    share = (np.isin(made.indices, joints) * made.weights).sum(axis=1)
    closed = model.points + model.shapes["eyeBlinkLeft"] + model.shapes["eyeBlinkRight"]
    uppers, lowers = (
        [row[(found["lid_rings"] == _LASHES) & own] for row in found["lids"]]
        for own in (found["lid_upper"], ~found["lid_upper"])
    )
    upper = np.concatenate(uppers)
    lower = np.concatenate(
        [low[cKDTree(closed[low]).query(closed[up])[1]] for up, low in zip(uppers, lowers, strict=True)]
    )
    opened = share * (model.points - closed)[:, 1]
    height = model.points[:, 1] - eye_centre(model, "Left")[1] + MEET
    return Stretch(share * height, (upper, lower), opened[upper] - opened[lower])


def lids(model: Model, mirror: Ints) -> dict[str, Ints]:
    """Points of the left eye's lids and of the right's, their rings, and the rows of the inner and the outer corner."""
    points, rings = _rings(model)
    places = model.points[points]
    corner = np.flatnonzero(rings == _CORNERS)
    inner, outer = (corner[pick(places[corner, 0])] for pick in (np.argmin, np.argmax))
    line = places[outer] - places[inner]
    along = (places - places[inner]) @ line / (line @ line)
    upper = places[:, 1] > places[inner, 1] + along * line[1]
    return {
        "lids": np.stack([points, mirror[points]]),
        "lid_rings": rings,
        "lid_upper": upper,
        "eye_corners": np.array([inner, outer], np.int32),
        "eye_shells": np.stack([_shell(model, side) for side in ("Left", "Right")]),
    }


def _shell(model: Model, side: str) -> Ints:
    """The points of an eyeball that are its outside, cornea and white."""
    faces = slice(*next(part.faces for part in KEPT if part.mesh == f"Eyeball{side}"))
    outside = np.isin(model.materials[faces], [list(MATERIALS).index(name) for name in (f"M_Sclera{side}", "Cornea")])
    ends = np.cumsum(model.counts)[np.array([faces.start, faces.stop]) - 1]
    corners = model.indices[slice(*ends)]
    return np.unique(corners[np.repeat(outside, model.counts[faces])]).astype(np.int32)


def _rings(model: Model) -> tuple[Ints, Ints]:
    """Points (k,) and rings (k,): ring 0 is where the left eye's socket meets the face, each next one is beside it."""
    face, socket = (next(part for part in KEPT if part.title == title) for title in ("Face", "Eye socket left"))
    ends = np.cumsum(model.counts)
    starts = ends - model.counts
    following = np.arange(1, ends[-1] + 1)
    following[ends - 1] = starts
    count = len(model.points)
    links = coo_array((np.ones(ends[-1]), (model.indices, model.indices[following])), shape=(count, count)).tocsr()
    links = links + links.T
    corners = slice(starts[socket.faces[0]], ends[socket.faces[1] - 1])
    inside = np.zeros(count, bool)
    inside[model.indices[corners]] = True
    ring = np.flatnonzero(inside[: face.points[1]])
    found = [ring]
    while len(found) < RINGS:
        beside: Floats = links[:, found[-1]].sum(axis=1)
        ring = np.flatnonzero((beside > 0) & ~inside)
        inside[ring] = True
        found.append(ring)
    sizes = [len(one) for one in found]
    return np.concatenate(found).astype(np.int32), np.repeat(np.arange(RINGS), sizes).astype(np.int32)
