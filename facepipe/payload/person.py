"""Persons as payloads: which sections they have, checked number by number."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.payload.basis import DIGEST, MOST_PARTS
from facepipe.payload.person_rig import HALF_TURN, LARGEST_GROWTH, LARGEST_STEPS, PersonRig, read_rig, rig_bytes
from facepipe.payload.sections import Section, pack, unpack
from facepipe.payload.small_numbers import decode_numbers, encode_numbers

BASIS, MODES, PLACEMENT, MOVED_PARTS, TURNED_PARTS, POINTS, JOINTS = 1, 2, 3, 4, 5, 6, 7  # kinds
LOOK, PICTURES, COEFFICIENTS = 9, 10, 11  # which readers may leave out
RIG = 12
_KNOWN = (BASIS, MODES, PLACEMENT, MOVED_PARTS, TURNED_PARTS, POINTS, JOINTS, LOOK, PICTURES, COEFFICIENTS, RIG)
_TURN = slice(3, 6)  # of a placement
MOST_MODES = 4096
MOST_PICTURES = 16
_LARGEST = np.array([1e4, 1e4, 1e4, 1, 1, 1, LARGEST_GROWTH])  # millimetres, quaternion, logarithm of the scale
LARGEST_WEIGHT = 100.0  # standard deviations
LARGEST_STEP = 10.0  # millimetres
_JOINTS_HEAD = struct.Struct("<eB")  # step in millimetres, joints
_CHANNELS = 9  # of an identity joint


@dataclass(frozen=True, kw_only=True)
class PersonContent:
    """What a payload says of a person.

    A placement is a turn by the unit quaternion ``(x, y, z, sqrt(1 - x^2 - y^2 - z^2))``, a scale, then a move: seven
    numbers ``tx ty tz`` in millimetres, ``x y z``, and the scale's natural logarithm.
    """

    basis: bytes  # DIGEST of them
    modes: FloatArray  # (k,) float16 weights of the basis's first modes, in standard deviations
    placement: FloatArray | None = None  # (7,) float32 of the whole face
    parts: FloatArray = field(default_factory=lambda: np.zeros((0, 7), np.float16))  # (p, 7) of parts that keep shape
    points: bytes = b""  # of `PointLevels`
    joints: IntArray = field(default_factory=lambda: np.zeros((0, 9), np.int64))  # (j, 9) steps of identity joints
    step: float = 0.0  # float16, millimetres: of `joints`
    rig: PersonRig | None = None  # None: joints and shapes are as points and basis have them
    look: bytes = b""  # of the head's, as `facepipe.heads.look_code` has it
    pictures: tuple[tuple[str, bytes], ...] = ()  # material, and WebP of its colours
    coefficients: bytes = b""  # a payload of bone coefficients, on top of the person
    skipped: tuple[int, ...] = ()  # kinds of sections that a reader may leave out, and this one has


def encode_person(content: PersonContent) -> bytes:
    """The payload of a person.

    :raises InputError: numbers beyond limits
    """
    where = "person"
    sections = [Section(BASIS, content.basis)]
    if len(content.modes):
        sections.append(Section(MODES, _checked_modes(content.modes, where).astype("<f2").tobytes()))
    if content.placement is not None:
        sections.append(Section(PLACEMENT, _checked_moves(content.placement[None], where).astype("<f4").tobytes()))
    if len(content.parts):
        parts = _checked_moves(content.parts, where).astype("<f2")
        if parts[:, _TURN].any():
            sections.append(Section(TURNED_PARTS, parts.tobytes()))
        else:
            sections.append(Section(MOVED_PARTS, np.delete(parts, _TURN, axis=1).tobytes()))
    if content.points:
        sections.append(Section(POINTS, content.points))
    if len(content.joints):
        step, joints = _checked_joints(content.step, content.joints, where)
        sections.append(Section(JOINTS, _JOINTS_HEAD.pack(step, len(joints)) + encode_numbers(joints)))
    if content.look:
        sections.append(Section(LOOK, content.look, required=False))
    if content.pictures:
        rows = (_text(name) + struct.pack("<I", len(data)) + data for name, data in content.pictures)
        sections.append(Section(PICTURES, b"".join(rows), required=False))
    if content.coefficients:
        sections.append(Section(COEFFICIENTS, content.coefficients, required=False))
    if content.rig is not None:
        sections.append(Section(RIG, rig_bytes(content.rig, f"{where} -> rig")))
    return pack(sections)


def decode_person(data: bytes, where: object) -> PersonContent:
    """What a payload says of a person.

    :raises InputError: as `unpack`, no person, a section that is unknown and must not be left out, one of a size that
        does not fit, or numbers beyond limits
    """
    found = {section.kind: section for section in unpack(data, where)}
    skipped = tuple(kind for kind in found if kind not in _KNOWN)
    for kind in skipped:
        if found[kind].required:
            raise InputError(where, f"section of kind {kind}, which this version of facepipe does not know")
    if BASIS not in found:
        raise InputError(where, "no person: it names no basis")
    if MOVED_PARTS in found and TURNED_PARTS in found:
        raise InputError(where, "parts with turns and without, expected one of them")
    digest = found[BASIS].data
    if len(digest) != DIGEST:
        raise InputError(f"{where} -> basis", f"{len(digest)} bytes, expected {DIGEST}")
    placement = _numbers(found.get(PLACEMENT), "<f4", 7, 1, f"{where} -> placement").reshape(-1, 7)
    trail = f"{where} -> parts"
    parts = _numbers(found.get(TURNED_PARTS), "<f2", 7, MOST_PARTS, trail).reshape(-1, 7)
    if MOVED_PARTS in found:
        still = _numbers(found[MOVED_PARTS], "<f2", 4, MOST_PARTS, trail).reshape(-1, 4)
        parts = np.insert(still, [3, 3, 3], 0, axis=1)
    step, joints = _joints(found.get(JOINTS), f"{where} -> joints")
    modes = _numbers(found.get(MODES), "<f2", 1, MOST_MODES, f"{where} -> modes")
    return PersonContent(
        basis=digest,
        modes=_checked_modes(modes, where),
        placement=_checked_moves(placement, where)[0] if len(placement) else None,
        parts=_checked_moves(parts, where),
        points=_data(found, POINTS),
        joints=joints,
        step=step,
        rig=read_rig(found[RIG].data, f"{where} -> rig") if RIG in found else None,
        look=_data(found, LOOK),
        pictures=_pictures(_data(found, PICTURES), f"{where} -> pictures"),
        coefficients=_data(found, COEFFICIENTS),
        skipped=skipped,
    )


def _data(found: Mapping[int, Section], kind: int) -> bytes:
    return found[kind].data if kind in found else b""


def _text(name: str) -> bytes:
    return bytes([len(name.encode())]) + name.encode()


def _pictures(data: bytes, where: str) -> tuple[tuple[str, bytes], ...]:
    """:raises InputError: rows that don't fit, names that are no text or come twice, or too many"""
    rows: dict[str, bytes] = {}
    while data:
        end = 1 + data[0]
        try:
            name = data[1:end].decode()
            (size,) = struct.unpack_from("<I", data, end)
        except (UnicodeDecodeError, struct.error):
            raise InputError(where, "a name or length that is cut or no text, expected one of each picture") from None
        if size > len(data) - end - 4 or name in rows or len(rows) == MOST_PICTURES:
            most = f"expected at most {MOST_PICTURES}, each material once"
            raise InputError(where, f"picture {len(rows) + 1} of {size} bytes, where {len(data)} are left, {most}")
        rows[name], data = data[end + 4 : end + 4 + size], data[end + 4 + size :]
    return tuple(rows.items())


def _joints(section: Section | None, where: str) -> tuple[float, IntArray]:
    """Step and (j, 9) numbers of the identity joints; none where there is no section."""
    if section is None:
        return 0.0, np.zeros((0, 9), np.int64)
    if len(section.data) < _JOINTS_HEAD.size:
        raise InputError(where, f"{len(section.data)} bytes, expected at least {_JOINTS_HEAD.size}")
    step, count = _JOINTS_HEAD.unpack_from(section.data)
    if not count:
        raise InputError(where, "no joints, expected at least one")
    numbers = decode_numbers(section.data[_JOINTS_HEAD.size :], count, _CHANNELS, where)
    return _checked_joints(step, numbers, where)


def _checked_joints(step: float, numbers: IntArray, where: object) -> tuple[float, IntArray]:
    if not 0 < step <= LARGEST_STEP:
        raise InputError(where, f"steps of {step:g} mm, expected more than 0 and at most {LARGEST_STEP:g}")
    beyond = np.abs(numbers).max(axis=1)
    if not beyond.max() <= LARGEST_STEPS:
        joint = int(np.argmax(beyond))
        raise InputError(f"{where} -> joint {joint}", f"{beyond[joint]} steps, expected at most {LARGEST_STEPS}")
    return step, numbers


def _numbers(section: Section | None, kind: str, each: int, most: int, where: str) -> FloatArray:
    if section is None:
        return np.zeros(0, kind)
    size = each * np.dtype(kind).itemsize
    count, rest = divmod(len(section.data), size)
    if rest or not 1 <= count <= most:
        raise InputError(where, f"{len(section.data)} bytes, expected 1 to {most} times {size}")
    return np.frombuffer(section.data, kind)


def _checked_modes(modes: FloatArray, where: object) -> FloatArray:
    with np.errstate(invalid="ignore"):  # casts of NaN
        off = np.flatnonzero(~(np.abs(np.asarray(modes, np.float64)) <= LARGEST_WEIGHT))
    if len(off):
        expected = f"expected at most {LARGEST_WEIGHT:g} standard deviations"
        raise InputError(f"{where} -> mode {off[0]}", f"{modes[off[0]]:g}, {expected}")
    return modes


def _checked_moves(moves: FloatArray, where: object) -> FloatArray:
    with np.errstate(invalid="ignore"):  # casts of NaN
        values = np.asarray(moves, np.float64)
    sound = (np.abs(values) <= _LARGEST).all(axis=1) & ((values[:, _TURN] ** 2).sum(axis=1) <= HALF_TURN)
    if not sound.all():
        (row, *_) = np.flatnonzero(~sound)
        numbers = " ".join(f"{value:g}" for value in values[row])
        raise InputError(f"{where} -> placement {row}", f"{numbers}, expected a move, part of a quaternion, a scale")
    return moves
