"""The tables of a server, in SQLite or PostgreSQL, and the steps from one form of them to the next.

All rows but those of servers belong to a tenant, by themselves or through a face or job; who asks is in every query.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import sqlalchemy as sa
from sqlalchemy import Boolean, Column, Float, ForeignKey, Index, Integer, String, Table, Text, UniqueConstraint

from facepipe.core.errors import FacepipeError, InputError

TABLES = sa.MetaData()
_KEY = String(32)


def _key(to: str, **more: Any) -> Column[str]:
    """A key of another table; its row goes with that one's."""
    name = more.pop("name", to.partition(".")[0].rstrip("s"))
    return Column(name, _KEY, ForeignKey(to, ondelete="CASCADE"), nullable=False, **more)


VERSION = Table("schema_version", TABLES, Column("version", Integer, nullable=False))
TENANTS = Table(
    *("tenants", TABLES),
    Column("id", _KEY, primary_key=True),
    Column("name", String(80), unique=True, nullable=False),
    Column("created", Float, nullable=False),
)
TOKENS = Table(
    *("tokens", TABLES),
    Column("digest", String(64), primary_key=True),  # sha256 of the token, which has 256 random bits: nothing to guess
    _key("tenants.id"),
    Column("created", Float, nullable=False),
)
CONSENTS = Table(
    *("consents", TABLES),
    Column("id", _KEY, primary_key=True),
    _key("tenants.id"),
    Column("text_version", String(80), nullable=False),
    Column("created", Float, nullable=False),
)
UPLOADS = Table(  # files that wait for a job, on the machine that took them
    *("uploads", TABLES),
    Column("id", _KEY, primary_key=True),
    _key("tenants.id"),
    Column("kind", String(8), nullable=False),  # photo, file, face
    Column("main", String(200), nullable=False),
    Column("bytes", Integer, nullable=False),
    Column("created", Float, nullable=False),
    Column("server", _KEY, nullable=False),
)
FACES = Table(
    *("faces", TABLES),
    Column("id", _KEY, primary_key=True),
    _key("tenants.id"),
    Column("name", String(200), nullable=False),
    Column("created", Float, nullable=False),
)
VERSIONS = Table(
    *("versions", TABLES),
    _key("faces.id", primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("created", Float, nullable=False),
    Column("made_by", String(80), nullable=False),
    Column("conflict_of", Integer),
)
SOURCES = Table(  # of versions; without a foreign key to what they were made of, which may be deleted
    *("sources", TABLES),
    _key("faces.id", primary_key=True),
    Column("version", Integer, primary_key=True),
    Column("source", _KEY, primary_key=True),
    Column("source_version", Integer, primary_key=True),
)
ARTEFACTS = Table(
    *("artefacts", TABLES),
    _key("faces.id", primary_key=True),
    Column("version", Integer, primary_key=True),
    Column("path", String(240), primary_key=True),  # face.usdc, face_textures/skin.png, thumbnail.png
    Column("digest", String(80), nullable=False),
    Column("bytes", Integer, nullable=False),
    Column("own", Boolean, nullable=False),  # of the face itself; else made of it
)
JOBS = Table(
    *("jobs", TABLES),
    Column("id", _KEY, primary_key=True),
    _key("tenants.id"),
    Column("action", String(80), nullable=False),
    Column("fields", Text, nullable=False),
    Column("name", String(200)),  # of the face that is made
    Column("face", _KEY, nullable=False),  # that gets the result: a new one, or one that is there
    Column("base", Integer),  # the version of it that the caller saw; none of a new face
    Column("state", String(10), nullable=False),
    Column("created", Float, nullable=False),
    Column("attempt", Integer, nullable=False, default=0),
    Column("progress", Text),
    Column("error", Text),
    Column("report", Text),
    Column("version", Integer),  # that was made
    Column("place", _KEY),  # the server that has its uploads; none: any does it
    Column("server", _KEY),  # that does it
)
JOB_UPLOADS = Table(
    *("job_uploads", TABLES),
    _key("jobs.id", primary_key=True),
    Column("upload", _KEY, primary_key=True),
)
ATTEMPTS = Table(
    *("attempts", TABLES),
    _key("jobs.id"),
    Column("attempt", Integer, nullable=False),
    Column("server", _KEY, nullable=False),
    Column("started", Float, nullable=False),
    Column("outcome", String(10)),  # done, failed, cancelled, lost, stopped
    UniqueConstraint("job", "attempt"),
)
SERVERS = Table(
    *("servers", TABLES),
    Column("id", _KEY, primary_key=True),
    Column("beat", Float, nullable=False),
)
Index("jobs_by_state", JOBS.c.state, JOBS.c.created)
Index("faces_by_tenant", FACES.c.tenant, FACES.c.created)
Index("sources_by_source", SOURCES.c.source)

Step = Callable[[sa.Connection], object]
STEPS: tuple[Step, ...] = ()  # from version 1 on, each to the next
LATEST = 1 + len(STEPS)
_LOCK = 0x66616365  # of PostgreSQL: one server at a time makes or changes the tables


class DatabaseError(FacepipeError):
    """A database that does not answer; it may do so later."""


class Database:
    """The tables at a URL, as SQLAlchemy writes it."""

    def __init__(self, url: str) -> None:
        """:raises InputError: no such database, its driver is missing, or its tables are of a newer facepipe"""
        try:
            self._engine = sa.create_engine(url, pool_pre_ping=True, **_settings(url))
        except (sa.exc.ArgumentError, ImportError) as error:
            what = f"needs {error.name}" if isinstance(error, ImportError) else "is no URL of a database"
            raise InputError("--database", f"{what}, expected sqlite or postgresql+psycopg://HOST/NAME") from None
        self.is_sqlite = self._engine.dialect.name == "sqlite"
        if self.is_sqlite:
            sa.event.listen(self._engine, "connect", _connected)
            sa.event.listen(self._engine, "begin", _begun)
        with self.write() as rows:
            if not self.is_sqlite:
                rows.execute(sa.select(sa.func.pg_advisory_xact_lock(_LOCK)))
            _upgrade(rows)

    @contextmanager
    def read(self) -> Iterator[sa.Connection]:
        """What is there.

        :raises DatabaseError: it does not answer
        """
        with _told(), self._engine.connect() as rows:
            yield rows

    @contextmanager
    def write(self) -> Iterator[sa.Connection]:
        """Change all or nothing.

        :raises DatabaseError: it does not answer
        """
        with _told(), self._engine.connect().execution_options(facepipe_write=True) as rows, rows.begin():
            yield rows

    def forget(self) -> None:
        """Remove from SQLite's log what was deleted; `secure_delete` has overwritten it in the pages."""
        if self.is_sqlite:
            with _told(), self._engine.connect().execution_options(isolation_level="AUTOCOMMIT") as rows:
                rows.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")

    def close(self) -> None:
        """End its connections."""
        self._engine.dispose()


def _settings(url: str) -> dict[str, Any]:
    if url.startswith("sqlite"):
        return {"connect_args": {"timeout": 20.0, "check_same_thread": False}}
    return {"pool_size": 16, "connect_args": {"connect_timeout": 5}}


def _connected(connection: Any, _: object) -> None:
    connection.isolation_level = None  # transactions begin where we say, not with the first change
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "secure_delete=ON"):
        connection.execute(f"PRAGMA {pragma}").fetchall()


def _begun(rows: sa.Connection) -> None:
    # one that is to write takes its turn at once: one that reads first fails where another has written meanwhile
    writes = rows.get_execution_options().get("facepipe_write")
    rows.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


@contextmanager
def _told() -> Iterator[None]:
    try:
        yield
    except (sa.exc.OperationalError, sa.exc.InterfaceError, sa.exc.TimeoutError) as error:
        raise DatabaseError("database", f"does not answer ({type(error).__name__})") from error


def _upgrade(rows: sa.Connection) -> None:
    if not sa.inspect(rows).has_table(VERSION.name):
        TABLES.create_all(rows)
        rows.execute(VERSION.insert().values(version=LATEST))
        return
    version = int(rows.scalar(sa.select(VERSION.c.version)) or 0)
    if not 1 <= version <= LATEST:
        raise InputError("database", f"is of version {version}, expected 1 to {LATEST}: of a newer facepipe")
    for step in STEPS[version - 1 :]:
        step(rows)
    rows.execute(VERSION.update().values(version=LATEST))
