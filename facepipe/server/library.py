"""The faces of tenants: their versions, what these were made of, and their files.

A version's files lie below ``FACE/VERSION/`` wherever it is laid out, its own stage as ``face.usdc``: a recipe's
relative paths to its sources hold in every such folder, and `facepipe cook` works there.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import sqlalchemy as sa

from facepipe.core.reading import digest
from facepipe.server.artefacts import Artefacts
from facepipe.server.refusals import ConflictError, MissingError, TooLargeError
from facepipe.server.tables import ARTEFACTS, FACES, JOBS, SOURCES, UPLOADS, VERSIONS, Database

STAGE = "face.usdc"
_PAGE = 50  # faces


@dataclass(frozen=True)
class Version:
    """A version of a face."""

    face: str
    number: int

    @property
    def folder(self) -> str:
        """Where it lies."""
        return f"{self.face}/{self.number}"


def new_id() -> str:
    """Of a row: 96 random bits."""
    return secrets.token_hex(12)


class Library:
    """The faces in a database, and their files in `artefacts`."""

    def __init__(self, database: Database, artefacts: Artefacts, quota: int) -> None:
        """:param quota: bytes that a tenant may keep"""
        self.database, self.artefacts, self.quota = database, artefacts, quota

    def faces(self, tenant: str, search: str = "", after: str = "") -> tuple[list[dict[str, Any]], str | None]:
        """A page of faces, the newest first, and the last one's id where there may be more.

        :param after: the last one of the page before
        """
        asked = sa.select(FACES).where(FACES.c.tenant == tenant)
        if search:
            asked = asked.where(FACES.c.name.icontains(search, autoescape=True))
        with self.database.read() as rows:
            if after:
                last = rows.scalar(sa.select(FACES.c.created).where(FACES.c.id == after, FACES.c.tenant == tenant))
                if last is None:
                    raise MissingError(after, "no such face")
                asked = asked.where(sa.tuple_(FACES.c.created, FACES.c.id) < sa.tuple_(last, after))
            found = rows.execute(asked.order_by(FACES.c.created.desc(), FACES.c.id.desc()).limit(_PAGE)).all()
            faces = _shown(rows, found)
        return faces, found[-1].id if len(found) == _PAGE else None

    def face(self, tenant: str, face: str) -> dict[str, Any]:
        """:raises MissingError: no such face"""
        with self.database.read() as rows:
            return _shown(rows, [_own(rows, tenant, face)])[0]

    def rename(self, tenant: str, face: str, name: str) -> None:
        """:raises MissingError: no such face"""
        with self.database.write() as rows:
            _own(rows, tenant, face)
            rows.execute(FACES.update().where(FACES.c.id == face).values(name=name))

    def delete(self, tenant: str, face: str, *, keep: bool = False) -> list[str]:
        """Delete a face with its versions, files and jobs; the jobs that had not ended, others that name it too.

        :param keep: faces that were made of it stay; they stand alone, but can't be cooked again
        :raises MissingError: no such face
        :raises ConflictError: without `keep`, the recipes of others name it
        """
        with self.database.write() as rows:
            _own(rows, tenant, face)
            others = sa.select(SOURCES.c.face).distinct().where(SOURCES.c.source == face, SOURCES.c.face != face)
            dependents = tuple(rows.scalars(others))
            if dependents and not keep:
                raise ConflictError(face, f"{len(dependents)} others are made of it", dependents)
            rows.execute(SOURCES.delete().where(SOURCES.c.source == face))
            rows.execute(FACES.delete().where(FACES.c.id == face))
            waits = JOBS.c.tenant == tenant, JOBS.c.state.in_(("queued", "running"))
            named = JOBS.c.fields.contains(face) | (JOBS.c.face == face)
            ended = list(rows.scalars(sa.select(JOBS.c.id).where(*waits, named)))
            rows.execute(JOBS.update().where(JOBS.c.id.in_(ended)).values(state="cancelled", progress=None))
            rows.execute(JOBS.delete().where(JOBS.c.face == face, JOBS.c.tenant == tenant))
        self.artefacts.remove(f"{tenant}/{face}")
        self.database.forget()
        return ended

    def stored(self, tenant: str, face: str, folder: Path) -> list[dict[str, Any]]:
        """Bring the files below a folder to the artefacts, before their rows: stores may be slow.

        :raises FacepipeError: a store that does not answer
        """
        files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        found = []
        for path in files:
            content = digest([path])
            self.artefacts.put(_key(tenant, face, content), path)
            name = path.relative_to(folder).as_posix()
            found.append({"path": name, "digest": content, "bytes": path.stat().st_size})
        return found

    def add(
        self,
        rows: sa.Connection,
        tenant: str,
        version: tuple[str, int | None],
        made_by: str,
        files: Iterable[Mapping[str, Any]],
        *,
        name: str = "",
        sources: Iterable[Version] = (),
    ) -> tuple[Version, int | None]:
        """Add what was made as a version of a face, and the face where it is new; what it is in conflict with.

        :param rows: a transaction, in which the result is told too: both are kept, or neither
        :param version: the face, and the version of it that the maker saw; None: the face is new
        :param files: as they were `stored`
        :raises MissingError: the face was deleted in the meantime
        :raises TooLargeError: the tenant's quota is full
        """
        face, base = version
        now = time.time()
        if base is None:
            rows.execute(FACES.insert().values(id=face, tenant=tenant, name=name or made_by, created=now))
        newest = _newest(rows, tenant, face)
        made = Version(face, newest + 1)
        conflict = None if base in (None, newest) else newest
        head = {"face": face, "number": made.number}
        rows.execute(VERSIONS.insert().values(**head, created=now, made_by=made_by, conflict_of=conflict))
        for one in dict.fromkeys(sources):
            head = {"face": face, "version": made.number}
            rows.execute(SOURCES.insert().values(**head, source=one.face, source_version=one.number))
        self._keep(rows, tenant, made, files, own=True)
        return made, conflict

    def keep(self, tenant: str, version: Version, folder: Path) -> None:
        """Keep the files below a folder, which were made of a version."""
        files = self.stored(tenant, version.face, folder)
        with self.database.write() as rows:
            if rows.scalar(sa.select(FACES.c.id).where(FACES.c.id == version.face)) is None:
                self.artefacts.remove(f"{tenant}/{version.face}")
            _own(rows, tenant, version.face)
            asked = sa.select(ARTEFACTS.c.path).where(*_of(version))
            there = set(rows.scalars(asked))  # two servers may make the same
            self._keep(rows, tenant, version, [one for one in files if one["path"] not in there], own=False)

    def clear(self, tenant: str, face: str) -> None:
        """Remove files that were brought for a face which is none: it was deleted meanwhile, or never came to be."""
        with self.database.read() as rows:
            there = rows.scalar(sa.select(FACES.c.id).where(FACES.c.id == face, FACES.c.tenant == tenant))
        if there is None:
            self.artefacts.remove(f"{tenant}/{face}")

    def _keep(
        self, rows: sa.Connection, tenant: str, version: Version, files: Iterable[Mapping[str, Any]], *, own: bool
    ) -> None:
        listed = [{**one, "face": version.face, "version": version.number, "own": own} for one in files]
        if _used(rows, tenant) + sum(one["bytes"] for one in listed) > self.quota:
            raise TooLargeError("quota", f"{self.quota / 1e9:g} GB are full, expected faces to be deleted before")
        if listed:
            rows.execute(ARTEFACTS.insert(), listed)

    def artefact(self, tenant: str, version: Version, path: str) -> str | None:
        """The digest of a file of a version; None where it isn't made.

        :raises MissingError: no such version
        """
        asked = sa.select(VERSIONS.c.number, ARTEFACTS.c.digest).select_from(
            VERSIONS.join(FACES, FACES.c.id == VERSIONS.c.face).outerjoin(
                ARTEFACTS,
                (ARTEFACTS.c.face == VERSIONS.c.face)
                & (ARTEFACTS.c.version == VERSIONS.c.number)
                & (ARTEFACTS.c.path == path),
            )
        )
        where = FACES.c.tenant == tenant, VERSIONS.c.face == version.face, VERSIONS.c.number == version.number
        with self.database.read() as rows:
            found = rows.execute(asked.where(*where)).first()
        if found is None:
            raise MissingError(version.folder, "no such version")
        return None if found.digest is None else str(found.digest)

    def fetch(self, tenant: str, face: str, content: str, file: Path) -> None:
        """Copy a file of a face to a path, by its digest."""
        self.artefacts.fetch(_key(tenant, face, content), file)

    def open(self, tenant: str, face: str, content: str) -> BinaryIO:
        """A file of a face to be read, by its digest."""
        return self.artefacts.open(_key(tenant, face, content))

    def lay(self, tenant: str, version: Version, folder: Path) -> Path:
        """Lay a version's own files out below a folder; the path of its stage.

        :raises MissingError: no such version
        :raises FacepipeError: a store that does not answer
        """
        asked = sa.select(ARTEFACTS).join(FACES, FACES.c.id == ARTEFACTS.c.face)
        with self.database.read() as rows:
            found = rows.execute(asked.where(FACES.c.tenant == tenant, *_of(version), ARTEFACTS.c.own)).all()
        if not found:
            raise MissingError(version.folder, "no such version")
        for one in found:
            place = folder / version.folder / one.path
            place.parent.mkdir(parents=True, exist_ok=True)
            self.fetch(tenant, version.face, one.digest, place)
        return folder / version.folder / STAGE

    def newest(self, tenant: str, face: str) -> int:
        """The number of the newest version.

        :raises MissingError: no such face
        """
        with self.database.read() as rows:
            return _newest(rows, tenant, face)

    def used(self, tenant: str) -> int:
        """Bytes that a tenant keeps."""
        with self.database.read() as rows:
            return _used(rows, tenant)


def _of(version: Version) -> tuple[Any, Any]:
    return ARTEFACTS.c.face == version.face, ARTEFACTS.c.version == version.number


def _key(tenant: str, face: str, content: str) -> str:
    return f"{tenant}/{face}/{content.removeprefix('sha256:')}"


def _own(rows: sa.Connection, tenant: str, face: str) -> Any:
    found = rows.execute(sa.select(FACES).where(FACES.c.id == face, FACES.c.tenant == tenant)).first()
    if found is None:
        raise MissingError(face, "no such face")
    return found


def _newest(rows: sa.Connection, tenant: str, face: str) -> int:
    _own(rows, tenant, face)
    rows.execute(
        sa.select(FACES.c.id).where(FACES.c.id == face).with_for_update()
    )  # of two who add a version one waits
    return int(rows.scalar(sa.select(sa.func.max(VERSIONS.c.number)).where(VERSIONS.c.face == face)) or 0)


def _used(rows: sa.Connection, tenant: str) -> int:
    faces = sa.select(FACES.c.id).where(FACES.c.tenant == tenant)
    kept = rows.scalar(sa.select(sa.func.sum(ARTEFACTS.c.bytes)).where(ARTEFACTS.c.face.in_(faces)))
    waiting = rows.scalar(sa.select(sa.func.sum(UPLOADS.c.bytes)).where(UPLOADS.c.tenant == tenant))
    return int(kept or 0) + int(waiting or 0)


def _shown(rows: sa.Connection, faces: Iterable[Any]) -> list[dict[str, Any]]:
    """Faces as the API has them, each with its versions."""
    shown = {one.id: {"id": one.id, "name": one.name, "created": one.created, "versions": []} for one in faces}
    size = sa.select(ARTEFACTS.c.face, ARTEFACTS.c.version, sa.func.sum(ARTEFACTS.c.bytes).label("bytes"))
    sizes = size.where(ARTEFACTS.c.own, ARTEFACTS.c.face.in_(shown)).group_by(ARTEFACTS.c.face, ARTEFACTS.c.version)
    known = {(one.face, one.version): int(one.bytes) for one in rows.execute(sizes)}
    sources: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for one in rows.execute(sa.select(SOURCES).where(SOURCES.c.face.in_(shown))):
        sources.setdefault((one.face, one.version), []).append({"face": one.source, "version": one.source_version})
    for one in rows.execute(sa.select(VERSIONS).where(VERSIONS.c.face.in_(shown)).order_by(VERSIONS.c.number)):
        at = one.face, one.number
        told = {"number": one.number, "created": one.created, "made_by": one.made_by, "conflict_of": one.conflict_of}
        shown[one.face]["versions"].append({**told, "bytes": known.get(at, 0), "sources": sources.get(at, [])})
        shown[one.face]["version"] = one.number
    return list(shown.values())
