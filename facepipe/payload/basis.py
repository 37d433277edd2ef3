"""The file of a basis: what persons' payloads are relative to, in whole numbers, for Python and devices alike.

How it looks is in docs/files.md, "A basis (.fpbasis)". Numbers are whole so that every reader has the same ones; each
point's are differences from a mean of its neighbours in coarser levels, which takes a quarter less than differences
from the point before.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.payload.lid_tables import LidTables, lid_bytes, read_lids
from facepipe.payload.section_bytes import SectionBytes, planes
from facepipe.payload.sections import Section, read_sections, written_sections

MAGIC, VERSION = b"FPBA", 1
DIGEST = 8  # bytes
NAME, MESHES, MEAN, LEVELS, MODES, PARTS, JOINTS, IDENTITY_JOINTS, LIDS = range(1, 10)  # kinds of sections
_KNOWN = range(NAME, LIDS + 1)
MOST_PARTS = 16
WHOLE = 64  # shares of a point's neighbours are so many-th, in sum 1
_FINEST = 1_000_000  # places in a millimetre
_HEADER = struct.Struct("<4sHH8sI")  # magic, version, flags, digest, bytes of the body
FULL = 255  # of a point's weights, in sum
_FARTHEST = 1e5  # millimetres
MOST_BYTES = 1 << 28  # of a body
_MOST_POINTS = 1 << 20
_BLOCK = 1 << 20  # numbers that are predicted at a time, which stay in the cache


class Level(NamedTuple):
    """m points of a level, and of which of coarser levels they are predicted."""

    rows: IntArray  # (m,) ascending
    neighbours: IntArray  # (m, k) the nearest first
    shares: npt.NDArray[np.int8]  # (m, k) WHOLE-ths


class MeshRun(NamedTuple):
    """A mesh whose points follow those of the mesh before."""

    name: str
    points: int


class RigidRows(NamedTuple):
    """Points that keep their shape, or that of their modes."""

    rows: IntArray
    with_modes: bool  # moved after the modes; else it is the mean's


class JointPlace(NamedTuple):
    """A joint, which is where a weighted mean of points is."""

    path: str
    points: IntArray  # (k,)
    shares: FloatArray  # (k,) float32


class JointWeights(NamedTuple):
    """Joints that carry what modes leave of people, and the weights of n points one after another."""

    first: int  # point
    places: FloatArray  # (j, 3) float32 millimetres
    indices: npt.NDArray[np.uint8]  # (n, k) joints of each point
    weights: npt.NDArray[np.uint8]  # (n, k) in sum FULL


@dataclass(frozen=True, kw_only=True)
class BasisContent:
    """What a basis is, of n points."""

    name: str
    meshes: tuple[MeshRun, ...]
    topology: bytes  # 32 of SHA-256 over the meshes' faces
    grid: int  # places in a millimetre
    places: IntArray  # (n, 3) of the mean
    coarsest: IntArray  # rows of the coarsest level, ascending
    levels: tuple[Level, ...]  # the finer ones, the coarsest of them first; points in none have no offsets
    step: float  # float32 millimetres
    modes: npt.NDArray[np.int16]  # (k, 3, n) steps of a standard deviation
    parts: tuple[RigidRows, ...] = ()
    joints: tuple[JointPlace, ...] = ()
    identity_joints: JointWeights | None = None
    lids: LidTables | None = None

    @property
    def mean(self) -> FloatArray:
        """(n, 3) millimetres."""
        return self.places / self.grid

    @property
    def order(self) -> IntArray:
        """(n,) points level by level, then those of no level."""
        known = np.concatenate([self.coarsest, *(level.rows for level in self.levels)])
        return np.concatenate([known, np.setdiff1d(np.arange(len(self.places)), known)])


def basis_body(content: BasisContent) -> bytes:
    """The sections of a basis, not yet deflated."""
    return written_sections(
        [
            Section(NAME, content.name.encode()),
            Section(MESHES, _text_rows([(mesh.name, struct.pack("<I", mesh.points)) for mesh in content.meshes])),
            Section(MEAN, content.topology + _mean_bytes(content)),
            Section(LEVELS, _levels_bytes(content)),
            *([Section(MODES, _modes_bytes(content))] if len(content.modes) else []),
            *([Section(PARTS, b"".join(map(_part_bytes, content.parts)))] if content.parts else []),
            *([Section(JOINTS, _text_rows(map(_joint_bytes, content.joints)))] if content.joints else []),
            *([Section(IDENTITY_JOINTS, _weights_bytes(own))] if (own := content.identity_joints) else []),
            *([Section(LIDS, lid_bytes(content.lids), required=False)] if content.lids else []),
        ]
    )


def digest_of(body: bytes) -> bytes:
    """DIGEST bytes that differ between bases."""
    return hashlib.sha256(body).digest()[:DIGEST]


def encode_basis(content: BasisContent) -> bytes:
    """The file of a basis."""
    body = basis_body(content)
    return _HEADER.pack(MAGIC, VERSION, 0, digest_of(body), len(body)) + zlib.compress(body, 9)


def decode_basis(data: bytes, where: object, *, trusted: bool = False) -> tuple[BasisContent, bytes]:
    """What a file of a basis says, and its digest.

    :param trusted: the digest is not computed again
    :raises InputError: no basis, a damaged one, or numbers that don't fit each other
    """
    if len(data) < _HEADER.size or data[:4] != MAGIC:
        raise InputError(where, f"no basis, expected a file that begins with {MAGIC.decode()}")
    _, version, flags, digest, size = _HEADER.unpack_from(data)
    if version != VERSION or flags:
        raise InputError(where, f"version {version}, flags {flags:#06x}, expected {VERSION} without flags")
    if size > MOST_BYTES:
        raise InputError(where, f"{size:,} bytes, expected at most {MOST_BYTES:,}")
    body = _inflated(data[_HEADER.size :], size, where)
    if not trusted and digest_of(body) != digest:
        raise InputError(where, "is damaged: its digest differs")
    found = read_sections(body, 0, len(body), where)
    for section in found:
        if section.required and section.kind not in _KNOWN:
            raise InputError(where, f"section of kind {section.kind}, which this version of facepipe does not know")
    sections = {section.kind: section.data for section in found}
    for kind in (NAME, MESHES, MEAN, LEVELS):
        if kind not in sections:
            raise InputError(where, f"no section of kind {kind}, expected one")
    reader = _Reader(sections, where)
    return reader.content(), digest


def _inflated(data: bytes, size: int, where: object) -> bytes:
    stream = zlib.decompressobj()
    try:
        body = stream.decompress(data, size + 1)
    except zlib.error as error:
        raise InputError(where, f"is damaged: {error}") from None
    if len(body) != size or not stream.eof or stream.unused_data:
        raise InputError(where, f"is damaged, expected {size:,} bytes of sections")
    return body


def _text_rows(rows: Sequence[tuple[str, bytes]] | Iterator[tuple[str, bytes]]) -> bytes:
    return b"".join(bytes([len(name.encode())]) + name.encode() + data for name, data in rows)


def _mean_bytes(content: BasisContent) -> bytes:
    return struct.pack("<I", content.grid) + planes(np.diff(content.places, axis=0, prepend=0).T, 4)


def _levels_bytes(content: BasisContent) -> bytes:
    counts = [len(content.coarsest), *(len(level.rows) for level in content.levels)]
    rows = [np.diff(one, prepend=0) for one in (content.coarsest, *(level.rows for level in content.levels))]
    widths = bytes(level.neighbours.shape[1] for level in content.levels)
    near = [(level.neighbours - level.rows[:, None]).T.ravel() for level in content.levels]
    shares = b"".join(np.ascontiguousarray(level.shares.T).tobytes() for level in content.levels)
    head = bytes([len(content.levels)]) + np.array(counts, "<u4").tobytes() + widths
    return head + planes(np.concatenate(rows), 4) + planes(np.concatenate([*near, np.zeros(0, int)]), 4) + shares


def _modes_bytes(content: BasisContent) -> bytes:
    columns = np.ascontiguousarray(content.modes.reshape(-1, content.modes.shape[2]).T)  # (n, 3 k)
    rest = np.empty_like(columns)
    known = len(content.coarsest)
    rest[:known] = columns[content.coarsest]
    for level in content.levels:
        rest[known : known + len(level.rows)] = columns[level.rows] - _predicted(columns, level)
        known += len(level.rows)
    rest[known:] = np.diff(columns[content.order[known:]], axis=0, prepend=np.int16(0))
    head = struct.pack("<Hf", len(content.modes), content.step)
    return head + planes(rest.T, 2)


def _predicted(columns: npt.NDArray[np.int16], level: Level) -> npt.NDArray[np.int16]:
    """(m, c) of the points of a level, from those of coarser ones among columns (n, c): rounded, halves up."""
    found = np.empty((len(level.rows), columns.shape[1]), np.int16)
    size = max(_BLOCK // max(columns.shape[1], 1) // 8, 1)
    for start in range(0, len(found), size):
        part = slice(start, start + size)
        total = np.full(found[part].shape, WHOLE // 2, np.int32)
        for near, shares in zip(level.neighbours[part].T, level.shares[part].T, strict=True):
            total += columns[near] * shares.astype(np.int32)[:, None]
        found[part] = total >> 6
    return found


def _part_bytes(part: RigidRows) -> bytes:
    cuts = np.flatnonzero(np.diff(part.rows) != 1) + 1
    runs = [(int(run[0]), int(run[-1]) + 1) for run in np.split(part.rows, cuts)]
    return struct.pack("<BH", part.with_modes, len(runs)) + np.array(runs, "<u4").tobytes()


def _joint_bytes(joint: JointPlace) -> tuple[str, bytes]:
    points, shares = joint.points.astype("<u4").tobytes(), joint.shares.astype("<f4").tobytes()
    return joint.path, bytes([len(joint.points)]) + points + shares


def _weights_bytes(own: JointWeights) -> bytes:
    count, each = own.indices.shape
    head = struct.pack("<BBII", len(own.places), each, own.first, count) + own.places.astype("<f4").tobytes()
    return head + np.ascontiguousarray(own.indices.T).tobytes() + np.ascontiguousarray(own.weights.T).tobytes()


class _Reader:
    """Sections as a basis, every count checked before memory is taken."""

    def __init__(self, sections: dict[int, bytes], where: object) -> None:
        self._sections, self._where = sections, where

    def content(self) -> BasisContent:
        """:raises InputError: bytes too few or too many, or numbers that don't fit each other"""
        section = self._open(NAME)
        name = section.text(section.data)
        section = self._open(MESHES)
        meshes = []
        while section.left:
            meshes.append(MeshRun(section.text(section.take(section.take(1)[0])), int(section.numbers("<u4", 1)[0])))
        count = sum(mesh.points for mesh in meshes)
        if not 0 < count <= _MOST_POINTS:
            raise section.wrong(f"{count:,} points, expected 1 to {_MOST_POINTS:,}")
        section = self._open(MEAN)
        topology, grid = section.take(32), int(section.numbers("<u4", 1)[0])
        if not 1 <= grid <= _FINEST:
            raise section.wrong(f"{grid} places in a millimetre, expected 1 to {_FINEST:,}")
        places = np.cumsum(section.planes(3 * count, 4).reshape(3, count), axis=1).T
        section.end()
        coarsest, levels = self._levels(count)
        found = BasisContent(
            name=name,
            meshes=tuple(meshes),
            topology=topology,
            grid=grid,
            places=places,
            coarsest=coarsest,
            levels=levels,
            step=0.0,
            modes=np.zeros((0, 3, count), np.int16),
            parts=self._parts(count) if PARTS in self._sections else (),
            joints=self._joints(count) if JOINTS in self._sections else (),
            identity_joints=self._identity_joints(count) if IDENTITY_JOINTS in self._sections else None,
        )
        if LIDS in self._sections:
            found = replace(found, lids=read_lids(self._open(LIDS), count, len(found.joints)))
        if MODES not in self._sections:
            return found
        step, modes = self._modes(found)
        return replace(found, step=step, modes=modes)

    def _levels(self, points: int) -> tuple[IntArray, tuple[Level, ...]]:
        section = self._open(LEVELS)
        count = section.take(1)[0]
        sizes = section.numbers("<u4", count + 1).astype(np.int64)
        widths = np.frombuffer(section.take(count), np.uint8).astype(np.int64)
        if sizes.sum() > points:
            raise section.wrong(f"{sizes.sum():,} points of levels, expected at most {points:,}")
        ends = np.cumsum(sizes)
        rows = np.split(section.planes(int(ends[-1]), 4), ends[:-1])
        near = np.split(section.planes(int(sizes[1:] @ widths), 4), np.cumsum(sizes[1:] * widths)[:-1] if count else [])
        coarsest, *others = (np.cumsum(one) for one in rows)
        known = np.zeros(points, bool)
        _check_rows(section, coarsest, known)
        levels = []
        for own, offsets, width in zip(others, near, widths.tolist(), strict=False):
            neighbours = offsets.reshape(width, len(own)).T + own[:, None]
            shares = np.frombuffer(section.take(width * len(own)), np.int8).reshape(width, len(own)).T
            inside = ((neighbours >= 0) & (neighbours < points)).all()
            if not width or not inside or not known[neighbours].all():
                raise section.wrong("neighbours that are in no coarser level, expected points that are")
            if (shares.sum(axis=1, dtype=np.int64) != WHOLE).any():
                raise section.wrong(f"shares of neighbours whose sum is not {WHOLE}")
            _check_rows(section, own, known)
            levels.append(Level(own, neighbours, shares))
        section.end()
        return coarsest, tuple(levels)

    def _modes(self, found: BasisContent) -> tuple[float, npt.NDArray[np.int16]]:
        section = self._open(MODES)
        count, step = struct.unpack("<Hf", section.take(6))
        points = len(found.places)
        if not 0 < step <= 1e3 or not count:
            raise section.wrong(f"{count} modes in steps of {step:g} mm, expected some in steps above 0, at most 1,000")
        low, high = np.frombuffer(section.take(6 * count * points), np.uint8).reshape(2, 3 * count, points)
        section.end()
        folded = np.ascontiguousarray(low.T).astype(np.uint16)
        folded |= np.ascontiguousarray(high.T).astype(np.uint16) << 8
        rest = (folded >> 1).view(np.int16) ^ -(folded & 1).view(np.int16)  # (n, 3 k)
        columns, known = np.empty_like(rest), len(found.coarsest)
        columns[found.coarsest] = rest[:known]
        for level in found.levels:
            part = rest[known : known + len(level.rows)]
            columns[level.rows] = _predicted(columns, level) + part
            known += len(level.rows)
        columns[found.order[known:]] = np.cumsum(rest[known:], axis=0, dtype=np.int16)
        return step, np.ascontiguousarray(columns.T).reshape(count, 3, points)

    def _parts(self, points: int) -> tuple[RigidRows, ...]:
        section = self._open(PARTS)
        parts: list[RigidRows] = []
        while section.left:
            if len(parts) == MOST_PARTS:
                raise section.wrong(f"more than {MOST_PARTS} parts")
            with_modes, count = struct.unpack("<BH", section.take(3))
            runs = section.numbers("<u4", 2 * count).reshape(count, 2).astype(np.int64)
            if with_modes > 1 or not count or (runs[:, 0] >= runs[:, 1]).any() or (np.diff(runs.ravel()) < 0).any():
                raise section.wrong("runs of a part that don't ascend, expected each point once")
            if runs[-1, 1] > points:
                raise section.wrong(f"points to {runs[-1, 1]}, expected at most {points}")
            parts.append(RigidRows(np.concatenate([np.arange(*run) for run in runs]), bool(with_modes)))
        return tuple(parts)

    def _joints(self, points: int) -> tuple[JointPlace, ...]:
        section = self._open(JOINTS)
        joints = []
        while section.left:
            path = section.text(section.take(section.take(1)[0]))
            count = section.take(1)[0]
            rows, shares = section.numbers("<u4", count).astype(np.int64), section.numbers("<f4", count)
            if not count or rows.max() >= points or not np.isfinite(shares).all():
                raise section.wrong(f"joint '{path}' of points that are not there, expected at most {points}")
            joints.append(JointPlace(path, rows, shares.astype(np.float64)))
        return tuple(joints)

    def _identity_joints(self, points: int) -> JointWeights:
        section = self._open(IDENTITY_JOINTS)
        joints, each, first, count = struct.unpack("<BBII", section.take(10))
        if not joints or not each or not count or first + count > points:
            raise section.wrong(f"{joints} joints, {each} a point, points {first} to {first + count}, of {points}")
        places = section.numbers("<f4", 3 * joints).reshape(joints, 3)
        indices, weights = (section.numbers("u1", each * count).reshape(each, count).T for _ in range(2))
        section.end()
        if not (np.abs(places) <= _FARTHEST).all() or indices.max() >= joints:
            raise section.wrong(f"places or joints of points that are not there, expected joints below {joints}")
        if (weights.sum(axis=1, dtype=np.int64) != FULL).any():
            raise section.wrong(f"weights of a point whose sum is not {FULL}")
        return JointWeights(first, places, indices, weights)

    def _open(self, kind: int) -> SectionBytes:
        return SectionBytes(kind, self._sections[kind], self._where)


def _check_rows(section: SectionBytes, rows: IntArray, known: npt.NDArray[np.bool_]) -> None:
    if not len(rows) or rows[0] < 0 or rows[-1] >= len(known) or (np.diff(rows) <= 0).any() or known[rows].any():
        raise section.wrong("points of a level that don't ascend, or are in two, expected each once")
    known[rows] = True
