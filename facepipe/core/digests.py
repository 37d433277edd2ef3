"""Digests of files: what recipes hold to tell whether a source has changed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.core.reading import check_regular


def digest(files: Iterable[Path]) -> str:
    """``sha256:...`` of one file's bytes, or, for several, of their sorted lines ``<sha256>  <file name>``.

    :raises InputError: a file can't be read
    """
    sums = sorted((path.name, _sha256(path)) for path in files)
    if len(sums) == 1:
        return f"sha256:{sums[0][1]}"
    listing = "".join(f"{value}  {name}\n" for name, value in sums)
    return f"sha256:{hashlib.sha256(listing.encode()).hexdigest()}"


def _sha256(path: Path) -> str:
    check_regular(path)
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(path, f"can't be read: {error.strerror or error}") from error
