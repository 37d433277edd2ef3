"""Damage done to good files: by bytes, by tokens of text, and by what JSON, TOML, zip, npz and pictures are made of."""

from __future__ import annotations

import copy
import io
import json
import math
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from photo_files import encoded
from PIL import Image

NAMES = [
    "", " ", ".", "..", "/", "../../x", "..\\x", "/etc/passwd", "C:\\x", "C:x", "NUL", "a" * 300, "a/" * 400 + "b",
    "\0", "a\0b", "a\nb", "a\r\tb", "\x1b[31mred", "\u202eabc", "\ud800", "\udfff\ud800", "é", "\U00020000", "{}",
    "%s%n", "*", "[", "a,b", "a=b", "a:b", "</Face>", "~", "-o", "file:///x",
    "http://127.0.0.1:9/x", "x.pt2", "out.usda",
]  # fmt: skip
NUMBERS: list[Any] = [
    0, 1, -1, 2, 3, 0.5, -0.5, -0.0, 255, 256, 65536, 2**31 - 1, 2**31, -(2**31), 2**53, 2**63, -(2**64), 10**400, 1e30,
    -1e30, 1e38, 1e300, -1e308, 1.7e308, 5e-324, 1e-30, math.nan, math.inf, -math.inf,
]  # fmt: skip
DEEP: list[Any] = []
for _ in range(60):
    DEEP = [DEEP]
VALUES: list[Any] = [
    *NUMBERS, *NAMES, None, True, False, [], [[]], [0], [None], [1, 2, 3], [1, 2, 3, 4], [0.0] * 16, ["x"], ["a", "a"],
    ["", 1, None], DEEP, {}, {"": 0}, {"a": 1}, {"a": {"a": {}}}, {"x": [{}]},
]  # fmt: skip
TOKENS = [
    b"nan", b"inf", b"-inf", b"1e400", b"-1", b"0", b"1", b"99999999999999999999", b"9" * 5000, b"0x10", b"1_0", b"1,5",
    b"", b'"', b"'", b"\0", b"\xff", b"\xed\xa0\x80", b"\xe2\x80\xae", b"#", b"{", b"]", b"=", b"..", b"/etc/passwd",
    b"1/2/3",    b"-1//-1", b"a" * 5000, b"true", b"\xd9\xa1", b"1e-320", b"3.5", b"\x1b[31m",
]  # fmt: skip


def some(rng: random.Random) -> int:
    """How many changes: mostly one."""
    return rng.choice([1, 1, 1, 1, 1, 2, 3, 8])


def damaged_bytes(rng: random.Random, data: bytes) -> bytes:
    """Cut short, or with bytes changed, put in, taken out, or repeated."""
    found = bytearray(data)
    if rng.random() < 0.15:
        return bytes(found[: rng.randrange(len(found) + 1)])
    for _ in range(some(rng)):
        at, size = rng.randrange(len(found) + 1), rng.choice([1, 1, 2, 4, 8, 64])
        way = rng.randrange(6)
        if way < 3:
            found[at : at + size] = bytes(rng.choice([0, 1, 127, 128, 255, rng.randrange(256)]) for _ in range(size))
        elif way == 3:
            del found[at : at + size]
        elif way == 4:
            found[at:at] = rng.choice([b"\0" * size, b"\xff" * size, bytes(found[at : at + size])])
        else:
            other = rng.randrange(len(found) + 1)
            found[at : at + size] = found[other : other + size]
    return bytes(found)


def damaged_text(rng: random.Random, data: bytes) -> bytes:
    """A text with tokens, lines or bytes changed."""
    if rng.random() < 0.25:
        return damaged_bytes(rng, data)
    for _ in range(some(rng)):
        if rng.random() < 0.7:
            places = [one.span() for one in re.finditer(rb"[^\s,;=:/\[\](){}\"']+", data)]
            if places:
                start, end = rng.choice(places)
                data = data[:start] + rng.choice([*TOKENS, data[slice(*rng.choice(places))]]) + data[end:]
        else:
            lines = data.split(b"\n")
            at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
            kept = {0: [], 1: [lines[at]] * 2, 2: [lines[other]], 3: [lines[at] + lines[other]], 4: [b"", lines[at]]}
            lines[at : at + 1] = kept[rng.randrange(5)]
            data = b"\n".join(lines)
    return data


# JSON and TOML


def paths_of(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all values of a document, branches included."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found = [path] if path else []
    return found + [one for key, child in items for one in paths_of(child, (*path, key))]


def _at(value: Any, path: tuple[Any, ...]) -> Any:
    for step in path:
        value = value[step]
    return value


def damaged_value(rng: random.Random, root: Any) -> Any:
    """A document with values swapped, taken out, doubled, or under other keys; what is odd in any place comes often."""
    root = copy.deepcopy(root)
    if rng.random() < 0.02:
        return copy.deepcopy(rng.choice(VALUES))
    for _ in range(some(rng)):
        paths = paths_of(root)
        if not paths:
            return root
        path = rng.choice(paths)
        holder, key = _at(root, path[:-1]), path[-1]
        way = rng.randrange(10)
        if way < 5:
            holder[key] = copy.deepcopy(rng.choice(VALUES))
        elif way == 5:
            holder[key] = copy.deepcopy(_at(root, rng.choice(paths)))
        elif way == 6:
            del holder[key]
        elif way == 7:
            holder[key] = [holder[key]]
        elif isinstance(holder, dict):
            value = holder[key] if way == 8 else holder.pop(key)
            holder[rng.choice(NAMES)] = value
        else:
            holder.insert(key, copy.deepcopy(holder[key]))
    return root


def json_text(rng: random.Random, root: Any) -> bytes:
    """A document as JSON: mostly as it should be written."""
    text = json.dumps(root, ensure_ascii=rng.random() < 0.7)
    if rng.random() < 0.05:
        keys = re.findall(r'"\w+": ', text)
        if keys:
            text = text.replace(key := rng.choice(keys), f"{key}0, {key}", 1)
    if rng.random() < 0.01:
        text = "[" * 100_000 + text
    encoding = rng.choice(["utf-8"] * 30 + ["utf-8-sig", "utf-16", "latin-1"])
    return text.encode(encoding, "surrogatepass" if encoding.startswith("utf") else "replace")


def damaged_json(rng: random.Random, data: bytes) -> bytes:
    """Values changed, seldom the text."""
    try:
        content = json.loads(data)
    except RecursionError:  # damaged before
        return damaged_text(rng, data)
    return damaged_text(rng, data) if rng.random() < 0.1 else json_text(rng, damaged_value(rng, content))


def damaged_toml(rng: random.Random, data: bytes) -> bytes:
    """Values changed, or the text."""
    import tomllib

    if rng.random() < 0.3:
        return damaged_text(rng, data)
    root = damaged_value(rng, tomllib.loads(data.decode()))
    items = root.items() if isinstance(root, dict) else [("x", root)]
    return "\n".join(f"{_toml_key(key)} = {_toml(rng, value)}" for key, value in items).encode("utf-8", "surrogatepass")


def _toml_key(key: str) -> str:
    return json.dumps(key, ensure_ascii=False)


def _toml(rng: random.Random, value: Any) -> str:
    if value is None:
        return rng.choice(["1979-05-27T07:32:00Z", "07:32:00", "1979-05-27"])
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_toml_key(str(key))} = {_toml(rng, one)}" for key, one in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(rng, one) for one in value) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return json.dumps(value, ensure_ascii=False)


# archives


def damaged_zip(rng: random.Random, data: bytes, member: Callable[[random.Random, str, bytes], bytes]) -> bytes:
    """An archive with a damaged member (`member` does it), or other names, order, copies, compression, or headers.

    USD asks for members stored on multiples of 64 bytes: so they are, where the damage is in a member.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    way = rng.choice(["member"] * 4 + ["names", "order", "copy", "drop", "nested", "headers", "headers", "bytes"])
    stored, aligned = zipfile.ZIP_STORED, 64
    if way == "bytes":
        return damaged_bytes(rng, data)
    at = rng.randrange(len(members))
    name, content = members[at]
    if way == "member":
        members[at] = (name, member(rng, name, content))
    elif way == "names":
        members[at] = (rng.choice([one for one in NAMES if one]), content)
    elif way == "order":
        rng.shuffle(members)
        aligned = rng.choice([1, 64])
    elif way == "copy":
        members.insert(rng.randrange(len(members) + 1), (name, rng.choice([content, b"", members[0][1]])))
    elif way == "drop":
        del members[at]
    elif way == "nested":
        members[at] = (name, data)
    packed = zipped(members, aligned, rng.choice([stored] * 6 + [zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA]))
    return _with_headers(rng, packed) if way == "headers" else packed


def zipped(members: list[tuple[str, bytes]], aligned: int = 64, kind: int = zipfile.ZIP_STORED) -> bytes:
    """An archive without times; `aligned`: contents begin at multiples of it."""
    import warnings

    stream = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(stream, "w", kind) as archive:
        warnings.simplefilter("ignore")  # a name twice
        for name, content in members:
            info = zipfile.ZipInfo(name.encode("utf-8", "replace").decode())
            info.compress_type = kind
            gap = -(stream.tell() + 30 + len(info.filename.encode())) % aligned
            gap += aligned if 0 < gap < 4 else 0
            info.extra = struct.pack("<HH", 0x1986, gap - 4) + b"\0" * (gap - 4) if gap else b""
            archive.writestr(info, content)
    return stream.getvalue()


def _with_headers(rng: random.Random, data: bytes) -> bytes:
    """One field of a local header, of the directory or of its end is another number."""
    found = bytearray(data)
    kinds = {
        b"PK\3\4": (30, (4, 6, 8, 26, 28), (14, 18, 22)),
        b"PK\1\2": (46, (6, 8, 10, 28, 30, 32), (16, 20, 24, 42)),
    }
    kinds[b"PK\5\6"] = (22, (4, 6, 8, 10, 20), (12, 16))
    for _ in range(some(rng)):
        mark = rng.choice(list(kinds))
        places = [one.start() for one in re.finditer(re.escape(mark), data)]
        _, shorts, longs = kinds[mark]
        at = rng.choice(places)
        if rng.random() < 0.4:
            struct.pack_into("<H", found, at + rng.choice(shorts), rng.choice([0, 1, 8, 9, 12, 99, 0xFFFF]))
        else:
            number = rng.choice([0, 1, len(data), len(data) - 1, 2**31, 2**32 - 1, rng.randrange(len(data))])
            struct.pack_into("<I", found, at + rng.choice(longs), number)
    return bytes(found)


def damaged_npz(rng: random.Random, data: bytes) -> bytes:
    """Arrays of other types, sizes and values, or damage to the archive or the heads of its members."""
    if rng.random() < 0.4:
        return damaged_zip(rng, data, lambda inner, _, content: damaged_npy(inner, content))
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files}
    for _ in range(rng.choice([1, 1, 2])):
        name = rng.choice(sorted(arrays))
        arrays[name] = damaged_array(rng, arrays[name])
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def damaged_npy(rng: random.Random, data: bytes) -> bytes:
    """A .npy with another head."""
    heads = {
        b"'fortran_order': False": b"'fortran_order': True ", b"'<f": b"'>f", b"'<U": b"'>U", b"(": b"(9", b"<": b"|",
        b"'shape': (": b"'shape': (99999999999,", b"descr": b"dscr ", b"f4": b"O8", b"f8": b"V8", b"(2": b"(-2",
    }  # fmt: skip
    old = rng.choice(list(heads))
    return data.replace(old, heads[old], 1) if old in data and rng.random() < 0.7 else damaged_bytes(rng, data)


def damaged_array(rng: random.Random, array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Another type, size or content."""
    way = rng.randrange(8)
    if way == 0:
        return array.astype("U8") if array.dtype.kind != "U" else np.zeros(array.shape)
    if way == 1:
        return array[: max(0, len(array) - 1)] if array.ndim else array[None]
    if way == 2:
        return array[None]
    if way == 3:
        return array.reshape(-1)[:0]
    if way == 4:
        return array.astype(array.dtype.newbyteorder(">"))
    if way == 5 and array.dtype.kind in "fiub":
        return array.astype(rng.choice(["f2", "f4", "f8", "i1", "u1", "i8", "u8", "c8", "?"]))
    changed = array.copy()
    if not changed.size:
        return changed
    at = rng.randrange(changed.size)
    if array.dtype.kind == "f":
        changed.flat[at] = rng.choice([math.nan, math.inf, 1e30, -1e30, 3e38, 0.0, 1e-45, -1.0])
    elif array.dtype.kind in "iu":
        changed.flat[at] = rng.choice([np.iinfo(array.dtype).min, np.iinfo(array.dtype).max, 0, 1])
    elif array.dtype.kind == "U":
        codes = np.array(changed.reshape(-1)).view(np.uint32)
        codes[rng.randrange(len(codes))] = rng.choice(
            [0, 10, 0x1B, 0xD800, 0xDFFF, 0x10FFFF, 0x110000, 2**31, 2**32 - 1]
        )
        changed = codes.view(array.dtype).reshape(array.shape)
    return changed


# pictures


def damaged_picture(rng: random.Random, data: bytes) -> bytes:
    """Headers and EXIF changed, another mode, size or format, or bytes."""
    way = rng.choice(["bytes", "head", "head", "chunk", "mode", "exif", "text"])
    if way == "bytes":
        return damaged_bytes(rng, data)
    if way == "head":
        return _with_head(rng, data)
    with Image.open(io.BytesIO(data)) as opened:
        image = opened.convert("RGB")
    if way == "chunk":
        return _with_chunk(rng, encoded(image, "PNG"))
    if way == "text":
        return rng.choice(
            [
                b"",
                b"\x89PNG\r\n\x1a\n",
                b"\xff\xd8\xff",
                b"II*\0",
                b"GIF89a",
                b"%!PS",
                b"<svg/>",
                b"BM",
                b"P6 9 9 255\n",
            ]
        )
    if way == "exif":
        return _with_exif(rng, image)
    return _in_mode(rng, image)


def _in_mode(rng: random.Random, image: Image.Image) -> bytes:
    size = rng.choice([image.size, (1, 1), (1, 500), (500, 1), (2, 2), (3000, 3), (64, 64)])
    image = image.resize(size)
    mode = rng.choice(["1", "L", "LA", "P", "RGBA", "CMYK", "I", "I;16", "F", "YCbCr", "RGB"])
    image = image.convert("L").convert(mode) if mode in ("I", "I;16", "F", "LA") else image.convert(mode)
    kind = rng.choice(["PNG", "JPEG", "TIFF", "BMP", "GIF", "WEBP", "PPM", "TGA", "ICO"])
    try:
        return encoded(image, kind, **({"save_all": True, "append_images": [image]} if rng.random() < 0.1 else {}))
    except (OSError, ValueError, KeyError):  # no such mode in that format
        return encoded(image.convert("RGB"), "PNG")


def _with_exif(rng: random.Random, image: Image.Image) -> bytes:
    exif = Image.Exif()
    values: list[Any] = [0, 1, 6, 8, 9, 65535, "x", "6", b"\0\1", (6, 6), 2.5]
    for tag in rng.sample([0x0112, 0x010F, 0x9003, 0xA405, 0x920A, 0x8769, 0xA001, 0x8825], 3):
        exif[tag] = rng.choice(values) if tag != 0x8769 else {0xA405: rng.choice(values), 0x920A: rng.choice(values)}
    try:
        text = exif.tobytes()
    except Exception:  # a value that Pillow can't write
        text = b"Exif\0\0II*\0\x08\0\0\0"
    if rng.random() < 0.6:
        text = damaged_bytes(rng, text) or b"Exif\0\0"
    return encoded(image, rng.choice(["JPEG", "PNG", "WEBP"]), exif=text[:60_000])


def _chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    found, at = [], 8
    while at < len(data):
        (size,) = struct.unpack_from(">I", data, at)
        found.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    return found


def _png(chunks: list[tuple[bytes, bytes]]) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in chunks
    )


def _with_chunk(rng: random.Random, data: bytes) -> bytes:
    """A PNG with chunks added, doubled, dropped or damaged; their sums are right."""
    chunks = _chunks(data)
    for _ in range(some(rng)):
        at = rng.randrange(len(chunks) + 1)
        way = rng.randrange(4)
        if way == 0 and at < len(chunks):
            chunks[at] = (chunks[at][0], damaged_bytes(rng, chunks[at][1]))
        elif way == 1 and len(chunks) > 1:
            del chunks[min(at, len(chunks) - 1)]
        elif way == 2 and chunks:
            chunks.insert(at, rng.choice(chunks))
        else:
            kind = rng.choice(
                [
                    b"tEXt",
                    b"zTXt",
                    b"iTXt",
                    b"iCCP",
                    b"eXIf",
                    b"gAMA",
                    b"cHRM",
                    b"PLTE",
                    b"tRNS",
                    b"acTL",
                    b"fcTL",
                    b"pHYs",
                ]
            )
            bomb = zlib.compress(b"\0" * 3_000_000)
            content = [
                b"",
                b"\0" * 26,
                b"a\0\0" + bomb,
                b"a\0\0" + b"x" * 9,
                b"II*\0" + b"\xff" * 20,
                bytes(rng.randbytes(40)),
            ]
            chunks.insert(at, (kind, rng.choice(content)))
    return _png(chunks)


def _with_head(rng: random.Random, data: bytes) -> bytes:
    """Other sizes, depths and kinds in the header of a PNG or JPEG."""
    sizes = [0, 1, 2, 255, 4097, 30_000, 65_535, 2**31 - 1, 2**32 - 1]
    if data[:4] == b"\x89PNG":
        chunks = _chunks(data)
        head = bytearray(chunks[0][1])
        if rng.random() < 0.6:
            struct.pack_into(">I", head, rng.choice([0, 4]), rng.choice(sizes))
        else:
            head[rng.randrange(8, 13)] = rng.choice([0, 1, 2, 3, 4, 6, 8, 16, 255])
        return _png([(b"IHDR", bytes(head)), *chunks[1:]])
    at = max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2"))
    if at < 0:
        return damaged_bytes(rng, data)
    found = bytearray(data)
    if rng.random() < 0.6:
        struct.pack_into(">H", found, at + rng.choice([5, 7]), min(rng.choice(sizes), 65_535))
    else:
        found[at + rng.choice([1, 4, 9, 10, 11, 12])] = rng.choice([0, 1, 2, 3, 4, 8, 12, 0xC3, 0xC9, 255])
    return bytes(found)
