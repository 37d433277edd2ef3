"""Damage to scans: other counts, types and names in the headers of PLY, STL and OFF files, as well as their bytes."""

from __future__ import annotations

import random
import struct

from fuzz_damage import damaged_bytes, damaged_text, some

COUNTS = [0, 1, 2, 3, 7, 8, 9, 13, 127, 255, 256, 65535, 10**6, 2**31 - 1, 2**31, 2**32 - 1, 10**10, 10**30, -1]
TYPES = [*b"char uchar short ushort int uint float double int8 uint8 int32 float64 list half".split(), b""]
NAMES = b"x y z nx ny nz red green blue alpha r diffuse_red vertex_indices vertex_index s texcoord flags".split()
ELEMENTS = b"vertex face tristrips edge material camera".split()
FORMATS = b"ascii binary_little_endian binary_big_endian binary".split()


def damaged_ply(rng: random.Random, data: bytes) -> bytes:
    """Mostly lines of the header, where they stand."""
    way, mark = rng.random(), data.find(b"end_header\n")
    if way < 0.2:
        return damaged_text(rng, data)
    if way < 0.4:  # what is behind the header
        return data[: mark + 11] + damaged_bytes(rng, data[mark + 11 :])
    lines = data[:mark].split(b"\n")[:-1]
    for _ in range(some(rng)):
        at = rng.randrange(1, len(lines))
        words = lines[at].split()
        place = rng.randrange(len(words)) if words else 0
        way = rng.randrange(8)
        if way < 5 and words:
            words[place] = _word(rng, words[0], place, len(words))
            lines[at] = b" ".join(words)
        elif way == 5:
            lines.insert(at, rng.choice([*lines, b"property list uchar uint vertex_indices", b"element edge 3", b""]))
        elif way == 6 and len(lines) > 2:
            del lines[at]
        else:
            other = rng.randrange(1, len(lines))
            lines[at], lines[other] = lines[other], lines[at]
    end = rng.choice([b"\n"] * 8 + [b"\r\n", b"\r"])
    return end.join([*lines, b"end_header", b""]) + data[mark + 11 :]


def _word(rng: random.Random, key: bytes, place: int, count: int) -> bytes:
    """Another word for the place in a line of a PLY header."""
    if place == 0:
        return rng.choice([b"element", b"property", b"format", b"comment", b"obj_info", b"end_header", b"x"])
    if key == b"format":
        return rng.choice([*FORMATS, b"2.0"])
    if key == b"element":
        return rng.choice(ELEMENTS) if place == 1 else b"%d" % rng.choice(COUNTS)
    return rng.choice(NAMES) if place == count - 1 else rng.choice(TYPES)


def damaged_stl(rng: random.Random, data: bytes) -> bytes:
    """Text, or the count, the triangles and the length of a binary file."""
    if data[:5] == b"solid" and b"\0" not in data:
        return damaged_text(rng, data)
    found, way = bytearray(data), rng.randrange(6)
    if way == 0:
        return damaged_bytes(rng, data)
    if way == 1:
        struct.pack_into("<I", found, 80, rng.choice([one for one in COUNTS if 0 <= one < 2**32]))
    elif way == 2:  # with a count that fits
        kept = rng.randrange((len(data) - 84) // 50 + 1)
        del found[84 + 50 * kept :]
        struct.pack_into("<I", found, 80, kept)
    elif way == 3:
        found[:5] = b"solid"
    else:
        for _ in range(some(rng)):
            at = 84 + 50 * rng.randrange((len(data) - 84) // 50) + 4 * rng.randrange(12)
            found[at : at + 4] = rng.choice([b"\xff" * 4, b"\0\0\xc0\x7f", b"\0\0\x80\xff", b"\0" * 4, b"\1\0\0\0"])
    return bytes(found)


def damaged_off(rng: random.Random, data: bytes) -> bytes:
    """Text, or its counts and the sizes of its faces."""
    if rng.random() < 0.5:
        return damaged_text(rng, data)
    lines = data.split(b"\n")
    for _ in range(some(rng)):
        if rng.random() < 0.3:
            lines[0] = rng.choice([b"OFF", b"COFF", b"NOFF", b"STOFF", b"4OFF", b"OFF BINARY", b"off", b""])
            continue
        at = 1 if rng.random() < 0.3 else rng.randrange(len(lines))
        words = lines[at].split()
        if words:
            words[rng.randrange(len(words))] = b"%d" % rng.choice(COUNTS)
            lines[at] = b" ".join(words)
    return b"\n".join(lines)
