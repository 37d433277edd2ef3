"""PNG files without the chunks that glTF ignores and the Khronos validator warns of."""

from __future__ import annotations

import struct

_SIGNATURE = 8


def without_ignored_chunks(data: bytes) -> bytes:
    """The same picture without colour profile, chromaticities and pixel aspect ratio.

    glTF defines the colour space of every texture itself. Pixel bytes stay untouched; a file that has none of these
    chunks is returned as it is.
    """
    kept, position = [data[:_SIGNATURE]], _SIGNATURE
    while position + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 12 + length
        if not _is_ignored(kind, data[position + 8 : end]):
            kept.append(data[position:end])
        position = end
    return b"".join(kept)


def _is_ignored(kind: bytes, body: bytes) -> bool:
    return kind in (b"cHRM", b"iCCP") or (kind == b"pHYs" and body[:4] != body[4:8])
