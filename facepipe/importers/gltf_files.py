"""The bytes that a glTF document refers to: data URIs and files of its own folder, nothing else."""

from __future__ import annotations

import base64
import binascii
import re
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from facepipe.errors import InputError
from facepipe.importers.gltf_json import Value, quote

MAX_FILE_BYTES = 2**32
"""Largest file read; a GLB can't be longer, as its header counts in 32 bits."""

_SCHEME = re.compile(r"^[A-Za-z][A-Za-z0-9+.-]*:")
_DATA = re.compile(r"^data:[^,]{0,200};base64,", re.IGNORECASE)


def read_whole(path: Path, where: str) -> bytes:
    """All bytes of a regular file of at most `MAX_FILE_BYTES`.

    :raises InputError: absent, no regular file, too large, or not readable
    """
    try:
        if not path.is_file():
            raise InputError(where, "no such file" if not path.exists() else "is not a regular file")
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise InputError(where, f"{size} bytes, expected at most {MAX_FILE_BYTES}")
        return path.read_bytes()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        raise InputError(where, f"can't be read: {reason or error}") from None


def read_uri(uri: Value, folder: Path, files: list[Path]) -> bytes:
    """The bytes behind a URI of the document: base64 data, or a file in `folder` or below, which joins `files`.

    :raises InputError: other schemes, paths that leave the folder (by ``..``, root, drive or link), bad base64
    """
    text = uri.text()
    if text[:5].lower() == "data:":
        return _data(uri, text)
    path = _inside(uri, text, folder)
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


def _inside(uri: Value, text: str, folder: Path) -> Path:
    if _SCHEME.match(text):
        raise uri.error(f"{quote(text)}, expected a data URI or a file beside the document")
    decoded = unquote(text)
    relative = PurePosixPath(decoded)
    outside = relative.is_absolute() or ".." in relative.parts or _SCHEME.match(decoded)
    if not decoded or "\0" in decoded or "\\" in decoded or outside:
        raise uri.error(f"{quote(text)}, expected a path inside the document's folder")
    try:
        home = folder.resolve()
        path = (home / relative).resolve()
    except (OSError, RuntimeError, ValueError):
        raise uri.error(f"{quote(text)} is no usable path") from None
    if not path.is_relative_to(home):
        raise uri.error(f"{quote(text)} leads out of the document's folder")
    return path
