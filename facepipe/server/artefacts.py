"""The files of faces: in a folder, or in a store by its URL. Their keys are ``TENANT/FACE/DIGEST``.

A face's own go with it: two faces share no file, so that none has to be counted.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from pathlib import Path
from typing import BinaryIO

from facepipe.core.atomic import replacing
from facepipe.core.errors import InputError, system_errors
from facepipe.core.policy.paths import check_written, checked, is_url
from facepipe.tasks.remote import Store


class Artefacts:
    """Where they are kept."""

    def __init__(self, place: str) -> None:
        """
        :param place: an absolute folder, or a URL
        :raises InputError: one that can't be used
        """
        self._store: Store | None = None
        if is_url(place):
            self._place = checked(place, [place])
            self._store = Store(self._place)
            return
        if not Path(place).is_absolute():
            raise InputError("--artefacts", f"is {place[:80]}, expected an absolute folder or a URL")
        self._place = place
        check_written(Path(place))
        with system_errors(place, "can't be made"):
            Path(place).mkdir(parents=True, exist_ok=True, mode=0o700)

    def put(self, key: str, file: Path) -> None:
        """Keep a copy, whole or not at all."""
        if self._store is not None:
            self._store.put(file, f"{self._place}/{key}")
            return
        place = Path(self._place, key)
        place.parent.mkdir(parents=True, exist_ok=True)
        if not place.exists():
            with replacing(place) as temporary:
                shutil.copyfile(file, temporary)

    def fetch(self, key: str, file: Path) -> None:
        """Copy one to a path whose folder is there.

        :raises FacepipeError: there is none, or the store does not answer
        """
        if self._store is not None:
            self._store.get(f"{self._place}/{key}", file)
            return
        with system_errors("artefact", "can't be read"):
            shutil.copyfile(Path(self._place, key), file)

    def open(self, key: str) -> BinaryIO:
        """One to be read; raises as `fetch`."""
        if self._store is None:
            with system_errors("artefact", "can't be read"):
                return Path(self._place, key).open("rb")
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            self.fetch(key, Path(folder) / "file")
            return (Path(folder) / "file").open("rb")

    def remove(self, folder: str) -> None:
        """Remove all below ``TENANT/FACE`` or ``TENANT``, in S3 with their versions."""
        if self._store is not None:
            self._store.remove_below(f"{self._place}/{folder}")
            return
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(Path(self._place, folder))
