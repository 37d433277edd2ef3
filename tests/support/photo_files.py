"""Pictures as files, in every way that photos come."""

from __future__ import annotations

import io
import struct
import zlib
from typing import Any

import numpy as np
from PIL import Image

Array = np.ndarray[Any, Any]

# how EXIF sees the first row and the first column of the file (EXIF 2.32, tag 274)
SIDES = {
    1: ("top", "left"),
    2: ("top", "right"),
    3: ("bottom", "right"),
    4: ("bottom", "left"),
    5: ("left", "top"),
    6: ("right", "top"),
    7: ("right", "bottom"),
    8: ("left", "bottom"),
}
# sRGB's primaries adapted to D50, as in its ICC profiles
_COLORANTS = ((0.4360747, 0.2225045, 0.0139322), (0.3850649, 0.7168786, 0.0971045), (0.1430804, 0.0606169, 0.7141733))


def picture(width: int = 96, height: int = 80) -> Array:
    """(h, w, 3) uint8, soft, with another colour in each corner."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    u, v = x / (width - 1), y / (height - 1)
    channels = (40 + 180 * u, 30 + 190 * v, 60 + 150 * (1 - u) * (1 - v))
    return np.round(np.stack(channels, axis=-1)).astype(np.uint8)


def encoded(image: Image.Image, kind: str, **options: Any) -> bytes:
    """The file's bytes."""
    buffer = io.BytesIO()
    image.save(buffer, format=kind, **options)
    return buffer.getvalue()


def png_of(pixels: Array) -> bytes:
    """The pixels as a PNG."""
    return encoded(Image.fromarray(pixels), "PNG")


def stored(upright: Array, orientation: int) -> Array:
    """The pixels of the file that show `upright` when seen as `orientation` says."""
    sides = SIDES[orientation]
    turned = upright[:: -1 if "bottom" in sides else 1, :: -1 if "right" in sides else 1]
    return np.ascontiguousarray(turned if sides[0] in ("top", "bottom") else turned.transpose(1, 0, 2))


def oriented(upright: Array, orientation: int, kind: str, **options: Any) -> bytes:
    """A file that shows `upright` by its EXIF orientation."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    return encoded(Image.fromarray(stored(upright, orientation)), kind, exif=exif, **options)


def png(width: int, height: int, bits: int, color: int, rows: bytes) -> bytes:
    """A PNG from its header and filtered rows, however true they are."""
    return packed_png(width, height, bits, color, zlib.compress(rows))


def packed_png(width: int, height: int, bits: int, color: int, rows: bytes) -> bytes:
    """A PNG from its header and compressed rows."""
    header = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def chunk(name: bytes, data: bytes) -> bytes:
    """A chunk of a PNG."""
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png16(values: Array) -> bytes:
    """(h, w, 3) uint16 as a PNG of 16 bits a channel, which Pillow doesn't write."""
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    return png(values.shape[1], values.shape[0], 16, 2, rows)


def linear_profile(order: tuple[int, int, int] = (0, 1, 2)) -> bytes:
    """An ICC profile of linear values, whose channels are sRGB's primaries in `order`."""

    def xyz(values: tuple[float, ...]) -> bytes:
        return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(value * 65536) for value in values))

    text = b"linear\0"
    tags = {
        b"desc": b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + bytes(78),
        b"cprt": b"text\0\0\0\0none\0",
        b"wtpt": xyz((0.9642, 1.0, 0.8249)),
        **{name: xyz(_COLORANTS[order[i]]) for i, name in enumerate((b"rXYZ", b"gXYZ", b"bXYZ"))},
        **dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), b"curv\x00\x00\x00\x00\x00\x00\x00\x00"),
    }
    table, body = struct.pack(">I", len(tags)), b""
    for name, data in tags.items():
        table += name + struct.pack(">II", 128 + 4 + 12 * len(tags) + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    size = 128 + len(table) + len(body)
    head = struct.pack(">I4sI4s4s4s", size, b"none", 0x02100000, b"mntr", b"RGB ", b"XYZ ") + bytes(12) + b"acsp"
    return head.ljust(68, b"\0") + struct.pack(">3i", 63190, 65536, 54061) + bytes(48) + table + body
