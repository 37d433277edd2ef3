"""URLs of files: which there are, and which of them lie below the roots that the caller gave."""

from __future__ import annotations

import os
import posixpath
import re
from collections.abc import Collection
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.core.policy.paths import PREFIX

SCHEMES = {"s3": "s3fs", "gs": "gcsfs", "memory": "fsspec"}  # -> package that it needs
_URL = re.compile(rf"({'|'.join(SCHEMES)})://[A-Za-z0-9][A-Za-z0-9._-]*(/[^/\\:*?\"<>|#@\x00-\x1f]+)*")


def is_url(name: str) -> bool:
    """Whether a name is no path, of whatever kind it is."""
    return "://" in name


def placed(folder: str | Path, path: str) -> str:
    """A path, from a folder where it is relative, in its shortest form; either can be a URL."""
    whole = path if is_url(path) or Path(path).is_absolute() else f"{folder}/{path}"
    scheme, mark, rest = whole.rpartition("://")
    return f"{scheme}{mark}{posixpath.normpath(rest)}" if mark else os.path.normpath(whole)


def checked(url: str, roots: Collection[str]) -> str:
    """A URL of a file or folder below one of the roots.

    :raises InputError: it is not, or is none: of another scheme, with a key or an option in it, with ``..`` in its path
    """
    plain = url.rstrip("/")
    parts = plain.split("/")
    if not _URL.fullmatch(plain) or {".", ".."} & {*parts} or any(part.startswith(PREFIX) for part in parts):
        shown = re.sub(r"//[^/]*@", "//...@", url)[:200]
        raise InputError(shown, f"can't be used, expected one like {'://, '.join(SCHEMES)}://BUCKET/FOLDER/FILE")
    if not any(f"{plain}/".startswith(f"{root.rstrip('/')}/") for root in roots):
        shown = ", ".join(roots) or "none has a URL"
        raise InputError(url, f"is outside the roots ({shown}), expected --root {'/'.join(parts[:3])}")
    return plain
