"""A glTF 2.0 document: its container, JSON and buffers, checked before anything is believed.

JSON is read as values that know their place, so that every error names its trail.

The reader goes from JSON and bytes straight to numpy views instead of through `pygltflib`: that library fills
dataclasses without checking types or ranges, so that hostile files fail far from their cause, or not at all, and
it copies buffers. It stays what we write with.

Source: Khronos glTF 2.0 specification, sections 3 (concepts) and 4 (GLB).
"""

from __future__ import annotations

import base64
import binascii
import json
import re
import struct
import unicodedata
from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, NoReturn
from urllib.parse import unquote

from facepipe.core import names
from facepipe.core.errors import InputError
from facepipe.core.policy.bounds import Budget, same_file
from facepipe.core.policy.paths import check_copied
from facepipe.core.reading import check_values, read_bytes
from facepipe_gltf.buffers import DRACO, MESHOPT
from facepipe_gltf.materials import BASIS
from facepipe_gltf.read.meshopt import decode

LARGEST = 1e18  # number that is believed: products of two still fit in float32, which files and engines hold
_LONGEST = 80  # characters of a name that is made of another
_TYPE_NAMES = {dict: "an object", list: "an array", str: "text", bool: "true or false", type(None): "null"}
_MAGIC = b"glTF"
_JSON_CHUNK = 0x4E4F534A
_BINARY_CHUNK = 0x004E4942
_SUPPORTED_EXTENSIONS = frozenset(
    {
        BASIS,  # its textures are named and left out: they alone are lost
        DRACO,
        MESHOPT,
        "VRM",
        "VRMC_node_constraint",
        "VRMC_springBone",
        "VRMC_springBone_extended_collider",
        "VRMC_vrm",
        "KHR_mesh_quantization",
        "KHR_texture_transform",
        "KHR_materials_clearcoat",
        "KHR_materials_ior",
        "KHR_materials_sheen",
        "KHR_materials_unlit",
        "KHR_animation_pointer",
        "KHR_materials_emissive_strength",
        "KHR_materials_pbrSpecularGlossiness",
        "KHR_materials_variants",
        "EXT_texture_webp",
        "EXT_texture_avif",
    }
)
_MAX_FILE_BYTES = 2**32  # a GLB can't be longer, as its header counts in 32 bits
_FREE_BYTES, _PER_BYTE = 1 << 26, 32  # that a document may unfold to: these, and as many for each byte of its buffers
_DENSER, _PAGE = 4, 4096  # times as much for a byte of meshopt's (morph targets are mostly zeros), each page once
_SCHEME = re.compile(r"^[A-Za-z][A-Za-z0-9+.-]*:")
_DATA = re.compile(r"^data:[^,]{0,200};base64,", re.IGNORECASE)


@dataclass(frozen=True)
class Value:
    """One JSON value and the trail to it, like ``head.glb -> accessors[3].count``.

    The readers below raise `InputError` when the value is not of the kind asked for; booleans are no numbers.
    """

    data: object
    trail: str
    root: bool = False

    @property
    def place(self) -> str:
        """The trail inside the document, for naming one place in an error about another."""
        return self.trail.partition(" -> ")[2]

    def error(self, what: str) -> InputError:
        """An error at this place."""
        return InputError(self.trail, what)

    def get(self, key: str) -> Value | None:
        """The member `key` of an object, None where there is none."""
        members = self.members()
        if key not in members:
            return None
        return Value(members[key], f"{self.trail}{' -> ' if self.root else '.'}{key}")

    def get_or(self, key: str, default: object) -> Value:
        """The member `key` of an object, `default` in its place where there is none."""
        return self.get(key) or Value(default, self.trail)

    def extension(self, name: str) -> Value | None:
        """What an extension says of an object, None where it says nothing."""
        return self.get_or("extensions", {}).get(name)

    def extras(self) -> Value:
        """The extras of an object; empty where there are none, or where they are no object."""
        extras = self.get_or("extras", {})
        return extras if isinstance(extras.data, dict) else Value({}, extras.trail)

    def require(self, key: str) -> Value:
        """The member `key` of an object that must have it."""
        value = self.get(key)
        if value is None:
            raise self.error(f"no {key}, expected one")
        return value

    def member_names(self) -> list[str]:
        """The names of an object's members, in file order."""
        return list(self.members())

    def items(self) -> list[Value]:
        """The elements of an array."""
        if not isinstance(self.data, list):
            raise self._expected("an array")
        return [Value(item, f"{self.trail}[{i}]") for i, item in enumerate(self.data)]

    def integer(self, low: int = 0) -> int:
        """A whole number of at least `low`; 3.0 counts as 3, as JSON makes no difference."""
        data = self.data
        if isinstance(data, float) and data.is_integer():
            data = int(data)
        if isinstance(data, bool) or not isinstance(data, int):
            raise self._expected("a whole number")
        if not low <= data < 2**53:
            raise self.error(f"{_short(data)}, expected a whole number from {low} to 2^53")
        return data

    def number(self) -> float:
        """A number of at most `LARGEST`, either sign."""
        if isinstance(self.data, bool) or not isinstance(self.data, int | float):
            raise self._expected("a number")
        if not abs(self.data) <= LARGEST:
            raise self.error(f"{_short(self.data)}, expected a number from {-LARGEST:g} to {LARGEST:g}")
        return float(self.data)

    def numbers(self, count: int | None = None) -> tuple[float, ...]:
        """An array of `count` numbers."""
        items = self.items()
        if count is not None and len(items) != count:
            raise self.error(f"{len(items)} numbers, expected {count}")
        return tuple(item.number() for item in items)

    def text(self) -> str:
        """Text that UTF-8 can hold."""
        if not isinstance(self.data, str):
            raise self._expected("text")
        if any("\ud800" <= character <= "\udfff" for character in self.data):
            raise self.error("text with half a surrogate pair, expected Unicode")
        return self.data

    def name(self) -> str:
        """Text that can be a name: USD ends names at a NUL."""
        if "\0" in self.text():
            raise self.error("a name with a NUL character, expected none")
        return self.text()

    def flag(self) -> bool:
        """True or false."""
        if not isinstance(self.data, bool):
            raise self._expected("true or false")
        return self.data

    def members(self) -> dict[str, Any]:
        """The members of an object, as JSON has them."""
        if not isinstance(self.data, dict):
            raise self._expected("an object")
        return self.data

    def _expected(self, kind: str) -> InputError:
        shown = _TYPE_NAMES.get(type(self.data)) or _short(self.data)
        if isinstance(self.data, str):
            shown = f"the text {quote(self.data)}"
        return self.error(f"is {shown}, expected {kind}")


def quote(text: str) -> str:
    """`text` in quotes, escaped and short enough for a one-line message."""
    return ascii(text if len(text) <= 60 else f"{text[:57]}...")


def parse(text: bytes, trail: str) -> Value:
    """The JSON object in `text`.

    :raises InputError: not UTF-8, not JSON (NaN and Infinity are no JSON), nested too deeply, or not an object
    """
    check_values(trail, text)
    try:
        data = json.loads(text.decode("utf-8-sig"), parse_constant=_refuse)
    except RecursionError:
        raise InputError(trail, "JSON nested too deeply") from None
    except UnicodeDecodeError as error:
        raise InputError(trail, f"JSON isn't UTF-8: {error.reason} at byte {error.start}") from None
    except ValueError as error:
        raise InputError(trail, f"not JSON: {ascii(str(error))[1:-1][:100]}") from None
    value = Value(data, trail, root=True)
    if not isinstance(data, dict):
        raise value.error("its JSON is not an object, expected a glTF object")
    return value


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no JSON number")


def _short(data: object) -> str:
    if isinstance(data, int) and abs(data) >= 10**20:
        return "a number beyond 10^20"  # not printed: Python limits how many digits it converts
    return str(data)[:40]


def given_name(value: Value) -> str | None:
    """The name that an object of the document has, exactly; None where it has none."""
    name = value.get("name")
    return None if name is None else name.name()


def file_name(name: str, fallback: str) -> str:
    """`name` as letters of ASCII, digits and underscores, for files.

    Accents are dropped, other characters beyond ASCII become ``u`` and their hexadecimal code, so that names in
    other scripts stay apart; the rest becomes ``_``. An empty name is `fallback`.
    """
    plain = unicodedata.normalize("NFKD", name[: 4 * _LONGEST])
    safe = "".join(
        (character if character.isascii() else f"u{ord(character):x}_")
        for character in plain
        if not unicodedata.combining(character)
    )[:_LONGEST]
    return names.identifier(safe, fallback)


class Names:
    """Hands out names, each once: one that is taken gets ``_2``, ``_3`` ... behind it."""

    def __init__(self) -> None:
        self._taken: set[str] = set()
        self._next: Counter[str] = Counter()
        self._known: dict[tuple[str, int], str] = {}

    def new(self, base: str) -> str:
        """`base`, or the first numbered name after it that is free."""
        result = base
        while result in self._taken:
            self._next[base] += 1
            result = f"{base}_{self._next[base] + 1}"
        self._taken.add(result)
        return result

    def same(self, name: str, occurrence: int) -> str:
        """The name of the n-th thing called `name`: always the same one for the same two."""
        key = (name, occurrence)
        if key not in self._known:
            self._known[key] = self.new(name)
        return self._known[key]


@dataclass
class Document:
    """A parsed document. `warnings` grows while it is read."""

    root: Value
    path: Path
    binary: bytes | None = None
    strict: bool = False  # what can't be read of a texture is an error
    budget: Budget = field(default_factory=lambda: Budget(_FREE_BYTES, _PER_BYTE))  # of all that data unfolds to
    warnings: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)  # read so far
    length: int = 0  # bytes of the file itself
    loaded: dict[int, memoryview] = field(default_factory=dict)  # buffers
    _contents: dict[Hashable, bytes] = field(default_factory=dict)  # of files beside it, by `same_file`
    unpacked: dict[str, Value] = field(default_factory=dict)  # primitives that were compressed, by their trails
    _decoded: dict[int, bytes] = field(default_factory=dict)  # of compressed bufferViews, and of added ones
    _entries: dict[str, list[Value]] = field(default_factory=dict)
    _warned: set[str] = field(default_factory=set)

    def entries(self, kind: str) -> list[Value]:
        """All of one kind (``accessors``, ``nodes`` ...)."""
        if kind not in self._entries:
            self._entries[kind] = self.root.get_or(kind, []).items()
        return self._entries[kind]

    def index(self, kind: str, reference: Value) -> int:
        """The index that `reference` names, within the entries of `kind`."""
        number = reference.integer()
        count = len(self.entries(kind))
        if number >= count:
            raise reference.error(f"{number}, but there are {count} {kind}")
        return number

    def entry(self, kind: str, reference: Value) -> Value:
        """The entry of `kind` that `reference` names."""
        return self.entries(kind)[self.index(kind, reference)]

    @cached_property
    def unweighted(self) -> dict[int, tuple[int, ...]]:
        """Mesh -> the nodes that show it and have no morph weights of their own."""
        found: dict[int, list[int]] = {}
        for number, node in enumerate(self.entries("nodes")):
            if (mesh := node.get("mesh")) is not None and node.get("weights") is None:
                found.setdefault(mesh.integer(), []).append(number)
        return {mesh: tuple(own) for mesh, own in found.items()}

    @property
    def whole_length(self) -> int:
        """Bytes of the file and of those beside it that were read so far."""
        return self.length + sum(map(len, self._contents.values()))

    def warn(self, value: Value | str, what: str) -> None:
        """Note something that could not be brought over, once."""
        line = f"{value.trail if isinstance(value, Value) else value}: {what}"
        if line not in self._warned:
            self._warned.add(line)
            self.warnings.append(line)

    def buffer(self, reference: Value) -> memoryview:
        """The bytes of a buffer, its byteLength at least."""
        number = self.index("buffers", reference)
        if number not in self.loaded:
            value = self.entries("buffers")[number]
            length = value.require("byteLength").integer(1)
            uri = value.get("uri")
            if uri is not None:
                data = self.content(uri)
            elif number == 0 and self.binary is not None:
                data = self.binary
            else:
                raise value.error("no uri, expected one (only the first buffer of a GLB goes without)")
            if len(data) < length:
                raise value.error(f"holds {len(data)} bytes, expected byteLength {length}")
            # the bytes of files are granted as they are read
            if uri is None or uri.text()[:5].lower() == "data:":
                self.budget.grant(length, number)
            self.loaded[number] = memoryview(data)[:length]
        return self.loaded[number]

    def view(self, reference: Value) -> tuple[memoryview, int, int]:
        """The buffer, first byte and length of a bufferView."""
        number = self.index("bufferViews", reference)
        value = self.entries("bufferViews")[number]
        packed = value.extension(MESHOPT)
        if packed is not None and number not in self._decoded:
            data = self.buffer(packed.require("buffer"))
            start, length = packed.get_or("byteOffset", 0).integer(), packed.require("byteLength").integer(1)
            count, size = packed.require("count").integer(1), packed.require("byteStride").integer(1)
            mode, filtered = packed.require("mode").text(), packed.get_or("filter", "NONE").text()
            steps = 4 * length if mode == "ATTRIBUTES" else 4 * length + 16 * count  # of Python, as bytes
            self.budget.spend(count * size + steps, packed.error)
            try:
                self._decoded[number] = decode(bytes(data[start : start + length]), count, size, mode, filtered)
            except ValueError as error:
                raise packed.error(f"can't be decoded: {error}") from None
            for page in range(start // _PAGE, -(-(start + length) // _PAGE)):  # views may share bytes, in whole or part
                self.budget.grant(_DENSER * _PAGE, (MESHOPT, id(data.obj), page))
        if number in self._decoded:
            return memoryview(self._decoded[number]), 0, len(self._decoded[number])
        data = self.buffer(value.require("buffer"))
        start = value.get_or("byteOffset", 0).integer()
        length = value.require("byteLength").integer(1)
        if start + length > len(data):
            raise value.error(f"bytes {start} to {start + length} of a buffer of {len(data)}")
        return data, start, length

    def add_accessor(self, like: Value, count: int, data: bytes) -> int:
        """The number of a new accessor of `count` packed elements, of the type of another: `data` holds them."""
        views, accessors = self.entries("bufferViews"), self.entries("accessors")
        views.append(Value({}, like.trail))
        self._decoded[len(views) - 1] = data
        kept = {key: value for key, value in like.members().items() if key not in ("byteOffset", "sparse")}
        accessors.append(Value({**kept, "count": count, "bufferView": len(views) - 1}, like.trail))
        return len(accessors) - 1

    def file_of(self, uri: Value) -> Path | None:
        """The file that a URI names; None of base64 data.

        :raises InputError: other schemes, absolute paths, paths out of the roots (by ``..`` or link)
        """
        text = uri.text()
        if text[:5].lower() == "data:":
            return None
        if _SCHEME.match(text):
            raise uri.error(f"{quote(text)}, expected a data URI or a file beside the document")
        decoded = unquote(text)
        absolute = PurePosixPath(decoded).is_absolute() or _SCHEME.match(decoded)
        if not decoded or "\0" in decoded or "\\" in decoded or absolute:
            raise uri.error(f"{quote(text)}, expected a path as seen from the document's folder")
        path = self.path.parent / decoded
        check_copied(f"{uri.trail} -> {quote(text)}", path, self.path)
        return path.resolve()

    def content(self, uri: Value) -> bytes:
        """The bytes behind a URI: base64 data, or a file beside the document or in its roots, each file read once.

        :raises InputError: as `file_of`, or bad base64
        """
        text, path = uri.text(), self.file_of(uri)
        if path is None:
            head = _DATA.match(text)
            if head is None:
                raise uri.error("data URI without base64, expected data:<type>;base64,...")
            try:
                return base64.b64decode(text[head.end() :], validate=True)
            except (binascii.Error, ValueError) as error:
                raise uri.error(f"data URI with bad base64: {error}") from None
        # each once, by the identity of the file and not by its name: hundreds of links may lead to one
        if path not in self.files:
            self.files.append(path)
        key = same_file(path)
        if key not in self._contents:
            self._contents[key] = _read_whole(path, f"{uri.trail} -> {quote(text)}")
            self.budget.grant(len(self._contents[key]), key)
        return self._contents[key]


def open_document(source: Path, *, strict: bool = False) -> Document:
    """Read the container and JSON of a .glb or .gltf, and check that what it needs is here.

    :raises InputError: truncated, not glTF 2, or an extension is required that isn't supported
    """
    document = read_document(source)
    document.strict = strict
    asset = document.root.require("asset")
    version = asset.require("version")
    if version.text().split(".")[0] != "2":
        raise version.error(f"{quote(version.text())}, expected glTF 2.0")
    # who reads 2.0 reads any 2.x, unless minVersion says otherwise (section 3.2)
    minimum = asset.get("minVersion")
    if minimum is not None and minimum.text() != "2.0":
        raise minimum.error(f"{quote(minimum.text())}, expected 2.0")
    for name in document.root.get_or("extensionsRequired", []).items():
        if name.text() not in _SUPPORTED_EXTENSIONS:
            raise name.error(f"the file needs the extension {quote(name.text())}, which is not supported")
    for name in document.root.get_or("extensionsUsed", []).items():
        if name.text() not in _SUPPORTED_EXTENSIONS:
            document.warn(name, f"the extension {quote(name.text())} is ignored")
    return document


def read_document(source: Path) -> Document:
    """The container and JSON of a .glb or .gltf; its content says which it is.

    :raises InputError: truncated, or no JSON object
    """
    trail = source.name
    data = _read_whole(source, trail)
    if not data:
        raise InputError(trail, "empty file, expected glTF")
    binary: bytes | None = None
    text = data
    if data[:4] == _MAGIC:
        if len(data) < 20:
            raise InputError(trail, f"{len(data)} bytes, expected a GLB header and a JSON chunk")
        version, length = struct.unpack_from("<II", data, 4)
        if version != 2:
            raise InputError(trail, f"GLB version {version}, expected 2")
        if length > len(data):
            raise InputError(trail, f"truncated: {len(data)} bytes, the header says {length}")
        chunks: dict[int, bytes] = {}
        offset = 12
        while offset + 8 <= length:
            size, kind = struct.unpack_from("<II", data, offset)
            if offset + 8 + size > length:
                raise InputError(trail, f"chunk at byte {offset} of {size} bytes ends beyond the file's {length}")
            if not chunks and kind != _JSON_CHUNK:
                raise InputError(trail, "the first chunk is not JSON")
            # chunks of other kinds belong to extensions: the specification has readers ignore them
            if kind in (_JSON_CHUNK, _BINARY_CHUNK):
                if kind in chunks:
                    raise InputError(
                        trail, f"a second {'JSON' if kind == _JSON_CHUNK else 'BIN'} chunk at byte {offset}"
                    )
                chunks[kind] = data[offset + 8 : offset + 8 + size]
            offset += 8 + size
        if _JSON_CHUNK not in chunks:
            raise InputError(trail, "no JSON chunk")
        text, binary = chunks[_JSON_CHUNK], chunks.get(_BINARY_CHUNK)
    elif source.suffix.lower() in (".glb", ".vrm"):
        raise InputError(trail, f"begins with {data[:4]!r}, expected the magic 'glTF'")
    document = Document(root=parse(text, trail), path=source, binary=binary, files=[source], length=len(data))
    if data[:4] == _MAGIC and int.from_bytes(data[8:12], "little") < len(data):
        document.warn(document.root, "bytes beyond the length in its header are left out")
    return document


def _read_whole(path: Path, where: str) -> bytes:
    """All bytes of a regular file of at most `_MAX_FILE_BYTES`.

    :raises InputError: absent, no regular file, too large, or not readable
    """
    try:
        return read_bytes(path, _MAX_FILE_BYTES)
    except InputError as error:
        raise InputError(where, error.what) from None


def uri_name(uri: str) -> str:
    """The file name that a URI ends in, empty for data."""
    return "" if uri[:5].lower() == "data:" else PurePosixPath(unquote(uri)).name
