"""What lids of persons are fitted by, of the finished head: how far eyeballs reach, what sliders do to eyes.

python samples/head/lid_tables.py facepipe/heads/data
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from facepipe.core.arrays import FloatArray
from facepipe.geometry.balls import fit_ball
from facepipe.heads.assembly import eye_ends
from facepipe.heads.asset import BASIS, arrays, asset
from facepipe.heads.lid_fit import REACH_SIDE, SIDES
from facepipe.payload.basis import encode_basis
from facepipe.payload.lid_tables import WAYS, EyeTables, LidTables

_MM = 10.0  # of a centimetre
_CELLS = 128
_REARMOST = -0.5  # of the outside's directions along z: lids go to -0.2
_NEAREST = 3  # points of the eyeball that say how far it reaches in a direction


def main() -> None:
    """Tabulate, write."""
    encoded = encode_basis(replace(asset().basis, lids=tables()))
    (Path(sys.argv[1]) / BASIS).write_bytes(encoded)


def tables() -> LidTables:
    """Those of the head."""
    head, data = asset(), arrays("lids")
    left = data["lids"][0]
    links = head.links[left] > 0
    near = links[:, left]
    eyes = tuple(_eye(side) for side in SIDES)
    shell = head.points[data["eye_shells"][0]]
    return LidTables(
        rings=data["lid_rings"].astype(np.int64),
        upper=data["lid_upper"],
        corners=tuple(map(int, data["eye_corners"])),
        links=np.diff(links.indptr),
        beside=tuple(np.sort(rows).astype(np.int64) for rows in np.split(near.indices, near.indptr[1:-1])),
        reach=_MM * _reach(shell - eyes[0].centre / _MM),
        eyes=eyes,
    )


def _shape(way: str) -> tuple[str, float]:
    name, _, half = way.partition(" at ")
    return name, 0.5 if half else 1.0


def _eye(side: str) -> EyeTables:
    head, lids = asset(), arrays("lids")["lids"][SIDES.index(side)]
    ball = head.parts[f"Eyeball{side}"].points
    names = [path.rpartition("/")[2] for path in head.joints]
    joints = names.index(f"lidUpper{side}"), names.index(f"lidLower{side}")
    own = head.skin_joints[lids] == np.array(joints)[:, None, None]
    shell, centre = arrays("lids")["eye_shells"][SIDES.index(side)], fit_ball(head.points[ball]).centre
    offsets = head.points[shell] - centre
    ends = eye_ends(side, lids)
    ways = [head.shapes[f"{name}{side}"][weight][lids] for name, weight in map(_shape, WAYS)]
    last = slice(1, None, 2)  # of both ends of a slider, of which the other is the negative
    return EyeTables(
        lids=lids.astype(np.int64),
        shell=shell[offsets[:, 2] > _REARMOST * np.linalg.norm(offsets, axis=1)].astype(np.int64),
        ball=(ball.start, ball.stop),
        centre=_MM * centre,
        joints=joints,
        shares=(head.skin_weights[lids] * own).sum(axis=-1),
        balls=ends.ball[last] * [_MM, _MM, _MM, 1.0],
        stretches=ends.joints[last] * [_MM, 1.0],
        ends=_MM * ends.lids[last],
        ways=_MM * np.array(ways, np.float64),
    )


def _reach(offsets: FloatArray) -> FloatArray:
    """(_CELLS, _CELLS) how far the outside (n, 3) of an eyeball reaches: searches in a tree take 20 times as long.

    Places in it are stereographic: the sphere as its rearmost point sees it, without a pole before the eye.
    """
    radii = np.linalg.norm(offsets, axis=1)
    x, y = np.meshgrid(*2 * (np.linspace(-REACH_SIDE, REACH_SIDE, _CELLS),))
    scale = 2.0 / (1.0 + x**2 + y**2)
    directions = np.stack([x * scale, y * scale, scale - 1.0], axis=-1)
    away, near = cKDTree(offsets / radii[:, None]).query(directions, k=_NEAREST)
    weights = 1.0 / (away + 1e-3)
    return np.asarray((weights * radii[near]).sum(axis=-1) / weights.sum(axis=-1))


if __name__ == "__main__":
    main()
