"""Zip files without times: the same files give the same bytes."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

from facepipe.core.atomic import replacing


def write_zip(path: Path, files: Mapping[str, bytes]) -> None:
    """Write files by name, whole or not at all.

    :raises InputError: the folder can't be written
    """
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, data in files.items():
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.external_attr = 0o644 << 16
            packed = name.endswith(".whl")  # compressed already
            archive.writestr(entry, data, zipfile.ZIP_STORED if packed else zipfile.ZIP_DEFLATED)
