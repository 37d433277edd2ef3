"""The bytes that a glTF document refers to: data URIs and files of its folder or its roots, nothing else."""

from __future__ import annotations

import base64
import binascii
import re
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from facepipe.core.errors import InputError
from facepipe.core.reading import read_bytes
from facepipe.core.trust import check_copied
from facepipe_gltf.read.values import Value, quote

MAX_FILE_BYTES = 2**32
"""Largest file read; a GLB can't be longer, as its header counts in 32 bits."""

_SCHEME = re.compile(r"^[A-Za-z][A-Za-z0-9+.-]*:")
_DATA = re.compile(r"^data:[^,]{0,200};base64,", re.IGNORECASE)


def read_whole(path: Path, where: str) -> bytes:
    """All bytes of a regular file of at most `MAX_FILE_BYTES`.

    :raises InputError: absent, no regular file, too large, or not readable
    """
    try:
        return read_bytes(path, MAX_FILE_BYTES)
    except InputError as error:
        raise InputError(where, error.what) from None


def read_uri(uri: Value, document: Path, files: list[Path]) -> bytes:
    """The bytes behind a URI of the document: base64 data, or a file beside it or in its roots, which joins `files`.

    :raises InputError: other schemes, absolute paths, paths out of the roots (by ``..`` or link), bad base64
    """
    text = uri.text()
    if text[:5].lower() == "data:":
        return _data(uri, text)
    path = _beside(uri, text, document)
    data = read_whole(path, f"{uri.trail} -> {quote(text)}")
    if path not in files:
        files.append(path)
    return data


def uri_name(uri: str) -> str:
    """The file name that a URI ends in, empty for data."""
    return "" if uri[:5].lower() == "data:" else PurePosixPath(unquote(uri)).name


def _data(uri: Value, text: str) -> bytes:
    head = _DATA.match(text)
    if head is None:
        raise uri.error("data URI without base64, expected data:<type>;base64,...")
    try:
        return base64.b64decode(text[head.end() :], validate=True)
    except (binascii.Error, ValueError) as error:
        raise uri.error(f"data URI with bad base64: {error}") from None


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
