"""A glTF 2.0 document: its container, JSON and buffers, checked before anything is believed.

The reader goes from JSON and bytes straight to numpy views instead of through `pygltflib`: that library fills
dataclasses without checking types or ranges, so that hostile files fail far from their cause, or not at all, and
it copies buffers. It stays what we write with.

Source: Khronos glTF 2.0 specification, sections 3 (concepts) and 4 (GLB).
"""

from __future__ import annotations

import base64
import binascii
import re
import struct
from collections.abc import Hashable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from facepipe.core.errors import InputError
from facepipe.core.policy.bounds import Budget, same_file
from facepipe.core.policy.paths import check_copied
from facepipe.core.reading import read_bytes
from facepipe_gltf.encoding import MESHOPT
from facepipe_gltf.read.meshopt import decode
from facepipe_gltf.read.values import Value, parse, quote

_MAGIC = b"glTF"
_JSON_CHUNK = 0x4E4F534A
_BINARY_CHUNK = 0x004E4942

_SUPPORTED_EXTENSIONS = frozenset(
    {
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
        "KHR_materials_unlit",
        "KHR_animation_pointer",
        "KHR_materials_emissive_strength",
        "KHR_materials_pbrSpecularGlossiness",
        "KHR_materials_variants",  # named where materials are read; the file's own choice is one of them
        "KHR_texture_basisu",  # a texture without another image is named and left out
        "EXT_texture_webp",
        "EXT_texture_avif",
    }
)
_MAX_FILE_BYTES = 2**32
"""Largest file read; a GLB can't be longer, as its header counts in 32 bits."""
_FREE_BYTES, _PER_BYTE = 1 << 26, 32  # that a document may unfold to: these, and as many for each byte of its buffers
_SCHEME = re.compile(r"^[A-Za-z][A-Za-z0-9+.-]*:")
_DATA = re.compile(r"^data:[^,]{0,200};base64,", re.IGNORECASE)


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
    loaded: dict[int, memoryview] = field(default_factory=dict)  # buffers
    _contents: dict[Hashable, bytes] = field(default_factory=dict)  # of files beside it, by `same_file`
    _decoded: dict[int, bytes] = field(default_factory=dict)  # of compressed bufferViews
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
        if packed is not None:
            if number not in self._decoded:
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
            return memoryview(self._decoded[number]), 0, len(self._decoded[number])
        data = self.buffer(value.require("buffer"))
        start = value.get_or("byteOffset", 0).integer()
        length = value.require("byteLength").integer(1)
        if start + length > len(data):
            raise value.error(f"bytes {start} to {start + length} of a buffer of {len(data)}")
        return data, start, length

    def is_missing(self, uri: Value) -> bool:
        """Whether a URI names a file that is not there.

        :raises InputError: as `content`
        """
        text = uri.text()
        return text[:5].lower() != "data:" and not _beside(uri, text, self.path).exists()

    def content(self, uri: Value) -> bytes:
        """The bytes behind a URI: base64 data, or a file beside the document or in its roots, each file read once.

        :raises InputError: other schemes, absolute paths, paths out of the roots (by ``..`` or link), bad base64
        """
        text = uri.text()
        if text[:5].lower() == "data:":
            head = _DATA.match(text)
            if head is None:
                raise uri.error("data URI without base64, expected data:<type>;base64,...")
            try:
                return base64.b64decode(text[head.end() :], validate=True)
            except (binascii.Error, ValueError) as error:
                raise uri.error(f"data URI with bad base64: {error}") from None
        # each once, by the identity of the file and not by its name: hundreds of links may lead to one
        path = _beside(uri, text, self.path)
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
    document = Document(root=parse(text, trail), path=source, binary=binary, files=[source])
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


def _beside(uri: Value, text: str, document: Path) -> Path:
    if _SCHEME.match(text):
        raise uri.error(f"{quote(text)}, expected a data URI or a file beside the document")
    decoded = unquote(text)
    absolute = PurePosixPath(decoded).is_absolute() or _SCHEME.match(decoded)
    if not decoded or "\0" in decoded or "\\" in decoded or absolute:
        raise uri.error(f"{quote(text)}, expected a path as seen from the document's folder")
    path = document.parent / decoded
    check_copied(f"{uri.trail} -> {quote(text)}", path, document)
    return path.resolve()
