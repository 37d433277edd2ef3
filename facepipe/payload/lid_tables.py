"""What blinks, looks and squints of persons are fitted by, as a section of a basis.

How it looks is in docs/files.md, "Lids". The right eye is there as the mirror image of itself, so that what both eyes
have in common is there once; what sliders do differs by up to 0.09 mm between the sides.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.payload.section_bytes import SectionBytes, planes

RINGS, MARGIN = 13, 4  # of lids, and the last ring of the margin: up to it each has points above and below
GRID, REACH_GRID = 100, 10_000  # places in a millimetre, of offsets and of how far an eyeball reaches
FULL = 65535  # of a skin weight
WAYS = ("eyeBlink", "eyeLookUp", "eyeLookDown at half", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeSquint")
_MIRROR = (np.array([1, 1, 1]), np.array([-1, 1, 1]))
_FARTHEST = 1e5  # millimetres
_LEAST_CELLS, _MOST_CELLS = 2, 1024
_NEAREST = 3  # points that say how far an eyeball reaches in a direction


class EyeTables(NamedTuple):
    """An eye with k points of lids, which e sliders move, in millimetres; the right one is not mirrored here."""

    lids: IntArray  # (k,) points of the basis
    shell: IntArray  # (m,) points of the eyeball's outside, cornea and white
    ball: tuple[int, int]  # the eyeball's first point, and the one after its last
    centre: FloatArray  # (3,) of the eyeball
    joints: tuple[int, int]  # of the basis, which carry the upper lid and the lower
    shares: FloatArray  # (2, k) their skin weights
    balls: FloatArray  # (e, 4) that the eyeball's middle goes, and what is added to its scale
    stretches: FloatArray  # (e, 2) that both lids' joints go up, and what is added to their scale along y
    ends: FloatArray  # (e, k, 3) that lids go, without what joints do
    ways: FloatArray  # (len(WAYS), k, 3) that lids go with shapes of the average head


@dataclass(frozen=True, kw_only=True)
class LidTables:
    """Both eyes."""

    rings: IntArray  # (k,) 0 behind the margin, then out over the lid
    upper: npt.NDArray[np.bool_]  # (k,)
    corners: tuple[int, int]  # rows of lids: the inner and the outer
    links: IntArray  # (k,) how many points an edge joins to each, of lids or not
    beside: tuple[IntArray, ...]  # those of lids, of each
    reach: FloatArray  # (c, c) millimetres from the left eyeball's middle to its outside
    eyes: tuple[EyeTables, EyeTables]


def lid_bytes(tables: LidTables) -> bytes:
    """The section."""
    inside = [len(rows) for rows in tables.beside]
    head = struct.pack("<HBHHH", len(tables.rings), len(tables.eyes[0].ends), len(tables.reach), *tables.corners)
    return b"".join(
        [
            head,
            *(np.asarray(one, np.uint8).tobytes() for one in (tables.rings, tables.upper, tables.links, inside)),
            np.concatenate(tables.beside).astype("<u2").tobytes(),
            _changes(tables.reach.ravel(), REACH_GRID),
            *(_eye_bytes(eye, mirror) for eye, mirror in zip(tables.eyes, _MIRROR, strict=True)),
        ]
    )


def _eye_bytes(eye: EyeTables, mirror: IntArray) -> bytes:
    balls = eye.balls * np.append(mirror, 1)
    return b"".join(
        [
            struct.pack("<IIHHH", *eye.ball, *eye.joints, len(eye.shell)),
            *(one.astype("<u4").tobytes() for one in (eye.lids, eye.shell)),
            np.rint(FULL * eye.shares).astype("<u2").tobytes(),
            *(one.astype("<f4").tobytes() for one in (eye.centre * mirror, balls, eye.stretches)),
            *(_changes((one * mirror).transpose(0, 2, 1), GRID) for one in (eye.ends, eye.ways)),
        ]
    )


def _changes(values: FloatArray, grid: int) -> bytes:
    return planes(np.diff(np.rint(grid * values).astype(np.int64), axis=-1, prepend=0), 4)


def read_lids(reader: SectionBytes, points: int, joints: int) -> LidTables:
    """The tables of a section.

    :param points: of the basis
    :param joints: of the basis
    :raises InputError: bytes too few or too many, or numbers that don't fit each other
    """
    count, sliders, cells, inner, outer = struct.unpack("<HBHHH", reader.take(9))
    rings, upper, links, inside = (reader.numbers("u1", count).astype(np.int64) for _ in range(4))
    sides = [(rings == ring) & (upper == half) for ring in range(MARGIN + 1) for half in (0, 1)]
    if upper.max(initial=0) > 1 or rings.max(initial=0) >= RINGS or not all(one.any() for one in sides):
        raise reader.wrong(f"rings of lids up to {RINGS - 1}, of which 0 to {MARGIN} have points above and below")
    if max(inner, outer) >= count or inner == outer or (inside > links).any() or not links.all():
        raise reader.wrong("corners that are not there, or points of lids that nothing is beside")
    rows = reader.numbers("<u2", int(inside.sum())).astype(np.int64)
    if rows.max(initial=0) >= count:
        raise reader.wrong(f"points beside others that are not there, expected rows below {count}")
    if not sliders or not _LEAST_CELLS <= cells <= _MOST_CELLS:
        raise reader.wrong(f"{sliders} sliders, {cells} cells, expected {_LEAST_CELLS} to {_MOST_CELLS} cells")
    reach = _sums(reader, (cells * cells,), REACH_GRID).reshape(cells, cells)
    left, right = (_eye(reader, mirror, (count, sliders, points, joints)) for mirror in _MIRROR)
    reader.end()
    return LidTables(
        rings=rings,
        upper=upper == 1,
        corners=(inner, outer),
        links=links,
        beside=tuple(np.split(rows, np.cumsum(inside)[:-1])),
        reach=reach,
        eyes=(left, right),
    )


def _eye(reader: SectionBytes, mirror: IntArray, counts: tuple[int, int, int, int]) -> EyeTables:
    count, sliders, points, joints = counts
    first, after, upper, lower, outside = struct.unpack("<IIHHH", reader.take(14))
    lids, shell = (reader.numbers("<u4", size).astype(np.int64) for size in (count, outside))
    if outside < _NEAREST:
        raise reader.wrong(f"{outside} points of an eyeball's outside, expected {_NEAREST} at least")
    if not first < after <= points or max(lids.max(), shell.max()) >= points or max(upper, lower) >= joints:
        raise reader.wrong("points or joints of an eye that are not there")
    shares = reader.numbers("<u2", 2 * count).reshape(2, count) / FULL
    centre, balls, stretches = (
        reader.numbers("<f4", rows * each).reshape(rows, each) for rows, each in ((1, 3), (sliders, 4), (sliders, 2))
    )
    if not all((np.abs(one) <= _FARTHEST).all() for one in (centre, balls, stretches)):
        raise reader.wrong(f"an eye farther than {_FARTHEST:g} mm, expected a nearer one")
    return EyeTables(
        lids=lids,
        shell=shell,
        ball=(first, after),
        centre=centre[0].astype(np.float64) * mirror,
        joints=(upper, lower),
        shares=shares,
        balls=balls.astype(np.float64) * np.append(mirror, 1),
        stretches=stretches.astype(np.float64),
        ends=_sums(reader, (sliders, 3, count), GRID).transpose(0, 2, 1) * mirror,
        ways=_sums(reader, (len(WAYS), 3, count), GRID).transpose(0, 2, 1) * mirror,
    )


def _sums(reader: SectionBytes, shape: tuple[int, ...], grid: int) -> FloatArray:
    places = np.cumsum(reader.planes(int(np.prod(shape)), 4).reshape(shape), axis=-1)
    if (np.abs(places) > grid * _FARTHEST).any():
        raise reader.wrong(f"lids or eyeballs farther than {_FARTHEST:g} mm, expected nearer ones")
    return np.asarray(places / grid)
