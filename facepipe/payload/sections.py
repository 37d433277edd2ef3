"""Version 2 of payloads: sections of bytes, of which readers skip those that they don't know and may leave out.

How it looks is in docs/files.md, "A person (.fpb)".
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import NamedTuple

from facepipe.core.errors import InputError
from facepipe.payload.coefficients import CRC, MAGIC

VERSION = 2
MOST_SECTIONS = 64
_HEADER = struct.Struct("<4sHH")  # magic, version, flags
_REQUIRED = 0x80  # of the byte that is a section's kind
_LONGEST = 5  # bytes of a length


class Section(NamedTuple):
    """A section."""

    kind: int  # 1 to 127
    data: bytes
    required: bool = True  # a reader that does not know it refuses the file


def has_sections(data: bytes) -> bool:
    """Whether it is a payload of this version, and none of coefficients."""
    return len(data) >= _HEADER.size and _HEADER.unpack_from(data)[:2] == (MAGIC, VERSION)


def pack(sections: Sequence[Section]) -> bytes:
    """The payload of sections, whose kinds ascend."""
    body = _HEADER.pack(MAGIC, VERSION, 0) + written_sections(sections)
    return body + CRC.pack(zlib.crc32(body))


def written_sections(sections: Sequence[Section]) -> bytes:
    """Sections, whose kinds ascend, one after another."""
    parts: list[bytes] = []
    for kind, data, required in sections:
        parts += [bytes([kind | _REQUIRED * required]), _packed(len(data)), data]
    return b"".join(parts)


def unpack(data: bytes, where: object) -> tuple[Section, ...]:
    """The sections of a payload.

    :raises InputError: no payload of this version, a damaged one, or as `read_sections`
    """
    if not has_sections(data):
        raise InputError(where, f"no person, expected a file that begins with FPBC and the version {VERSION}")
    end = len(data) - CRC.size
    if end < _HEADER.size or zlib.crc32(data[:end]) != CRC.unpack_from(data, end)[0]:
        raise InputError(where, "is damaged: its CRC differs")
    flags = _HEADER.unpack_from(data)[2]
    if flags:
        raise InputError(where, f"flags {flags:#06x}, expected none")
    return read_sections(data, _HEADER.size, end, where)


def read_sections(data: bytes, place: int, end: int, where: object) -> tuple[Section, ...]:
    """The sections that are between two places.

    :raises InputError: too many, longer than what is there, or kinds that don't ascend
    """
    sections: list[Section] = []
    while place < end:
        trail, kind = f"{where} -> section {len(sections) + 1}", data[place] & ~_REQUIRED
        if len(sections) == MOST_SECTIONS:
            raise InputError(where, f"more than {MOST_SECTIONS} sections")
        if kind <= (sections[-1].kind if sections else 0):
            raise InputError(trail, f"kind {kind}, expected each once, ascending from 1")
        length, start = _unpacked(data, place + 1, end, trail)
        if length > end - start:
            raise InputError(trail, f"{length} bytes, expected at most the {end - start} that follow")
        sections.append(Section(kind, data[start : start + length], bool(data[place] & _REQUIRED)))
        place = start + length
    return tuple(sections)


def _packed(length: int) -> bytes:
    """A length in groups of 7 bits, the lowest first; all but the last have bit 7."""
    parts = []
    while length >= 0x80:
        parts.append(length & 0x7F | 0x80)
        length >>= 7
    return bytes([*parts, length])


def _unpacked(data: bytes, place: int, end: int, trail: str) -> tuple[int, int]:
    """The length at a place, and the place after it.

    :raises InputError: it does not end in time, or could be shorter
    """
    length = 0
    for number, byte in enumerate(data[place : min(place + _LONGEST, end)]):
        length |= (byte & 0x7F) << 7 * number
        if byte < 0x80:
            if number and not byte:
                break
            return length, place + number + 1
    raise InputError(trail, f"a length without end or with needless bytes, expected at most {_LONGEST} bytes")
