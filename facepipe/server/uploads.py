"""Files that wait for a job, below ``uploads/ID/`` on the machine that took them; nothing else reads them.

Photos never reach a store, whose older versions could outlive them. All go with the job that uses them, or after an
hour; a photo that is not used after all when its owner says so.
"""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from facepipe.core.errors import InputError
from facepipe.server.jobs import QUEUED, RUNNING
from facepipe.server.library import new_id
from facepipe.server.refusals import ConflictError, MissingError
from facepipe.server.tables import CONSENTS, JOB_UPLOADS, JOBS, UPLOADS, Database

PHOTO, FILE, FACE = "photo", "file", "face"
KEPT = 3600.0  # seconds
_NAME = re.compile(r"(?!\.)[^\x00-\x1f/\\:*?\"<>|]{1,100}(?<![. ])")
_DEEPEST = 6  # folders


def checked_name(name: str) -> str:
    """The name of a file of an upload, with the folders that it lies in there.

    :raises InputError: one that could lead elsewhere, or that not every system can hold
    """
    parts = name.replace("\\", "/").split("/")
    if len(parts) > _DEEPEST or not all(map(_NAME.fullmatch, parts)):
        raise InputError(ascii(name[:60]), "is no name for a file here, expected one like head.glb")
    return "/".join(parts)


class Uploads:
    """The uploads in a folder, and their rows."""

    def __init__(self, database: Database, folder: Path, server: str, *, retain: bool) -> None:
        """:param retain: photos stay where they are after their jobs"""
        self._database, self._folder, self._server, self._retain = database, folder, server, retain
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)

    def place(self) -> Path:
        """A folder for the files of a new upload."""
        place = self._folder / new_id()
        place.mkdir(mode=0o700)
        return place

    def add(self, tenant: str, place: Path, kind: str, main: str, consent: str = "") -> str:
        """Keep what lies in a place; its id.

        :param consent: version of the text that was agreed to
        """
        size = sum(path.stat().st_size for path in place.rglob("*") if path.is_file())
        named = {"id": place.name, "tenant": tenant, "kind": kind, "main": main, "bytes": size}
        with self._database.write() as rows:
            rows.execute(UPLOADS.insert().values(**named, created=time.time(), server=self._server))
            if consent:
                agreed = {"tenant": tenant, "text_version": consent, "created": time.time()}
                rows.execute(CONSENTS.insert().values(id=new_id(), **agreed))
        return place.name

    def lay(self, tenant: str, upload: str, folder: Path) -> Path:
        """Copy an upload's files below a folder; the path of the one that is meant.

        :raises MissingError: no such upload
        """
        with self._database.read() as rows:
            own = UPLOADS.c.id == upload, UPLOADS.c.tenant == tenant
            main = rows.scalar(sa.select(UPLOADS.c.main).where(*own))
        place = self._folder / upload
        if main is None or not place.is_dir():
            raise MissingError(upload, "no such upload")
        try:
            shutil.copytree(place, folder / upload)
        except OSError as error:
            if place.is_dir():
                raise
            raise MissingError(upload, "no such upload") from error  # discarded meanwhile
        return folder / upload / str(main)

    def discard(self, tenant: str, photo: str) -> None:
        """Remove a photo, even where photos stay: it was never used, or its owner wants it gone.

        :raises MissingError: no such photo
        :raises ConflictError: a job waits for it
        """
        with self._database.write() as rows:
            own = UPLOADS.c.id == photo, UPLOADS.c.tenant == tenant, UPLOADS.c.kind == PHOTO
            if rows.scalar(sa.select(UPLOADS.c.server).where(*own)) != self._server:
                raise MissingError(photo, "no such photo")
            if rows.scalar(_needed().where(JOB_UPLOADS.c.upload == photo)) is not None:
                raise ConflictError(photo, "a job uses it, which deletes it; expected that to be cancelled before")
            rows.execute(UPLOADS.delete().where(*own))  # in the same transaction: no job can ask for it in between
        self._remove([photo])

    def end(self, job: str) -> None:
        """Remove what a job that has ended used, unless another waits for it."""
        with self._database.read() as rows:
            used = sa.select(UPLOADS.c.id, UPLOADS.c.kind).join(JOB_UPLOADS, JOB_UPLOADS.c.upload == UPLOADS.c.id)
            found = rows.execute(used.where(JOB_UPLOADS.c.job == job)).all()
            needed = set(rows.scalars(_needed()))
        kept = PHOTO if self._retain else None
        self._remove([one.id for one in found if one.id not in needed and one.kind != kept])

    def sweep(self) -> None:
        """Remove what is too old, unless a job waits for it, and what has no row: its upload was broken off."""
        late = time.time() - KEPT
        with self._database.read() as rows:
            old = sa.select(UPLOADS.c.id).where(UPLOADS.c.created < late, UPLOADS.c.id.not_in(_needed()))
            kinds = (UPLOADS.c.kind != PHOTO,) if self._retain else ()
            ids = list(rows.scalars(old.where(UPLOADS.c.server == self._server, *kinds)))
            known = set(rows.scalars(sa.select(UPLOADS.c.id)))
        stray = [one.name for one in self._folder.iterdir() if one.name not in known and one.stat().st_mtime < late]
        self._remove([*ids, *stray])

    def remove_of(self, tenant: str) -> None:
        """Remove all of a tenant."""
        with self._database.read() as rows:
            ids = list(rows.scalars(sa.select(UPLOADS.c.id).where(UPLOADS.c.tenant == tenant)))
        self._remove(ids)

    def _remove(self, ids: Iterable[Any]) -> None:
        ids = list(ids)
        for one in ids:
            shutil.rmtree(self._folder / one, ignore_errors=True)
        if ids:
            with self._database.write() as rows:
                rows.execute(UPLOADS.delete().where(UPLOADS.c.id.in_(ids)))
            self._database.forget()


def _needed() -> sa.Select[tuple[str]]:
    """The uploads that jobs wait for."""
    waits = sa.select(JOB_UPLOADS.c.upload).join(JOBS, JOBS.c.id == JOB_UPLOADS.c.job)
    return waits.where(JOBS.c.state.in_((QUEUED, RUNNING)))
