"""The files of faces: in a folder, or in a store by its URL. Their keys are ``TENANT/FACE/DIGEST``."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from pathlib import Path
from typing import BinaryIO, Protocol

from facepipe.core.atomic import replacing
from facepipe.core.errors import InputError, system_errors
from facepipe.core.policy.paths import check_written, checked, is_url
from facepipe.tasks.remote import Store


class Artefacts(Protocol):
    """Where they are kept. A face's own go with it: two faces share no file, so that none has to be counted."""

    def put(self, key: str, file: Path) -> None:
        """Keep a copy, whole or not at all."""

    def fetch(self, key: str, file: Path) -> None:
        """Copy one to a path whose folder is there.

        :raises FacepipeError: there is none, or the store does not answer
        """

    def open(self, key: str) -> BinaryIO:
        """One to be read.

        :raises FacepipeError: there is none, or the store does not answer
        """

    def remove(self, folder: str) -> None:
        """Remove all below ``TENANT/FACE`` or ``TENANT``."""


class InFolder:
    """Artefacts in a folder of this machine."""

    def __init__(self, folder: Path) -> None:
        check_written(folder)
        with system_errors(folder, "can't be made"):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._folder = folder

    def put(self, key: str, file: Path) -> None:
        """Keep a copy."""
        place = self._folder / key
        place.parent.mkdir(parents=True, exist_ok=True)
        if not place.exists():
            with replacing(place) as temporary:
                shutil.copyfile(file, temporary)

    def fetch(self, key: str, file: Path) -> None:
        """Copy one."""
        with system_errors("artefact", "can't be read"):
            shutil.copyfile(self._folder / key, file)

    def open(self, key: str) -> BinaryIO:
        """One to be read."""
        with system_errors("artefact", "can't be read"):
            return (self._folder / key).open("rb")

    def remove(self, folder: str) -> None:
        """Remove all of a face or tenant."""
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(self._folder / folder)


class AtUrl:
    """Artefacts in a store."""

    def __init__(self, url: str) -> None:
        """:raises InputError: no URL that can be used, or its library is not installed"""
        self._url = checked(url, [url])
        self._store = Store(self._url)

    def put(self, key: str, file: Path) -> None:
        """Keep a copy."""
        self._store.put(file, f"{self._url}/{key}")

    def fetch(self, key: str, file: Path) -> None:
        """Copy one."""
        self._store.get(f"{self._url}/{key}", file)

    def open(self, key: str) -> BinaryIO:
        """One to be read."""
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            file = Path(folder) / "file"
            self.fetch(key, file)
            return file.open("rb")

    def remove(self, folder: str) -> None:
        """Remove all of a face or tenant, in S3 with their versions."""
        self._store.remove_below(f"{self._url}/{folder}")


def artefacts_at(place: str | None, folder: Path) -> Artefacts:
    """Those at a URL or in a folder; without either in ``artefacts`` of the server's own.

    :raises InputError: a place that can't be used
    """
    if place is None:
        return InFolder(folder / "artefacts")
    if is_url(place):
        return AtUrl(place)
    if not Path(place).is_absolute():
        raise InputError("--artefacts", f"is {place[:80]}, expected an absolute folder or a URL")
    return InFolder(Path(place))
