"""The queue of jobs: told once, claimed by one server at a time, ended once.

A claim is one UPDATE ... RETURNING; each is an attempt with a row of its own. A server that is killed leaves jobs
running: it takes them back when it starts again, and others do where it stays away.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from facepipe.server.library import Library, Version, new_id
from facepipe.server.refusals import MissingError, TooManyError
from facepipe.server.tables import ATTEMPTS, JOB_UPLOADS, JOBS, SERVERS, UPLOADS

QUEUED, RUNNING, DONE, FAILED, CANCELLED = "queued", "running", "done", "failed", "cancelled"
LOST, STOPPED = "lost", "stopped"  # outcomes of attempts after which the job is queued again
ENDED = (DONE, FAILED, CANCELLED)
_MOST_LOST = 3  # attempts: a job that takes its process with it so often has failed
_MOST_WAITING = 1000  # jobs of a tenant
_AWAY = 60.0  # seconds without a beat, after which others take a server's jobs
_PAGE = 100  # jobs


@dataclass(frozen=True, kw_only=True)
class Asked:
    """A job as it is asked for."""

    action: str
    fields: Mapping[str, Any]  # as JSON, with ids in place of paths
    face: str  # that gets the result
    base: int | None  # the version of it that the caller saw; None: it is new
    name: str | None = None  # of a new face
    uploads: Sequence[str] = ()  # that it reads


class Jobs:
    """The jobs in a library's database, as one server sees them."""

    def __init__(self, library: Library, server: str) -> None:
        self._library, self._database, self._server = library, library.database, server

    def add(self, tenant: str, asked: Asked) -> dict[str, Any]:
        """Accept a job: from here on it is not lost.

        :raises MissingError: an upload that is not the tenant's
        :raises TooManyError: too many wait already
        """
        job = new_id()
        with self._database.write() as rows:
            waiting = sa.select(sa.func.count()).where(JOBS.c.tenant == tenant, JOBS.c.state.in_((QUEUED, RUNNING)))
            if (rows.scalar(waiting) or 0) >= _MOST_WAITING:
                raise TooManyError("jobs", f"{_MOST_WAITING} wait, expected some of them to end before")
            place = None
            for one in asked.uploads:
                own = (UPLOADS.c.id == one) & (UPLOADS.c.tenant == tenant)
                place = rows.scalar(sa.select(UPLOADS.c.server).where(own))
                if place is None:
                    raise MissingError(one, "no such upload")
            values = {"action": asked.action, "fields": json.dumps(asked.fields), "face": asked.face}
            more = {"base": asked.base, "name": asked.name, "place": place, "state": QUEUED, "created": time.time()}
            rows.execute(JOBS.insert().values(id=job, tenant=tenant, attempt=0, **values, **more))
            for one in dict.fromkeys(asked.uploads):
                rows.execute(JOB_UPLOADS.insert().values(job=job, upload=one))
        return self.job(tenant, job)

    def job(self, tenant: str, job: str) -> dict[str, Any]:
        """:raises MissingError: no such job"""
        with self._database.read() as rows:
            found = rows.execute(sa.select(JOBS).where(JOBS.c.id == job, JOBS.c.tenant == tenant)).first()
        if found is None:
            raise MissingError(job, "no such job")
        return _shown(found)

    def listed(self, tenant: str) -> list[dict[str, Any]]:
        """The latest jobs, the newest first."""
        asked = sa.select(JOBS).where(JOBS.c.tenant == tenant).order_by(JOBS.c.created.desc()).limit(_PAGE)
        with self._database.read() as rows:
            return [_shown(one) for one in rows.execute(asked)]

    def cancel(self, tenant: str, job: str) -> dict[str, Any]:
        """Cancel a job that has not ended; who does it finds its result refused.

        :raises MissingError: no such job
        """
        with self._database.write() as rows:
            waits = JOBS.c.state.in_((QUEUED, RUNNING))
            own = JOBS.c.id == job, JOBS.c.tenant == tenant, waits
            rows.execute(JOBS.update().where(*own).values(state=CANCELLED, progress=None))
        return self.job(tenant, job)

    def claim(self) -> Any:
        """The oldest job that waits and that this server can do, now its own; None where there is none."""
        mine = JOBS.c.place.is_(None) | (JOBS.c.place == self._server)
        first = sa.select(JOBS.c.id).where(JOBS.c.state == QUEUED, mine).order_by(JOBS.c.created, JOBS.c.id).limit(1)
        # of two servers one finds the row locked, and takes the next
        chosen = first.with_for_update(skip_locked=True).scalar_subquery()
        taken = {"state": RUNNING, "server": self._server, "attempt": JOBS.c.attempt + 1}
        with self._database.write() as rows:
            update = JOBS.update().where(JOBS.c.id == chosen, JOBS.c.state == QUEUED).values(taken)
            job = rows.execute(update.returning(JOBS)).first()
            if job is not None:
                begun = {"job": job.id, "attempt": job.attempt, "server": self._server, "started": time.time()}
                rows.execute(ATTEMPTS.insert().values(begun))
        return job

    def progress(self, job: Any, said: Mapping[str, Any]) -> None:
        """Keep how far an attempt is."""
        with self._database.write() as rows:
            rows.execute(JOBS.update().where(*_held(job)).values(progress=json.dumps(said)))

    def done(self, job: Any, files: Sequence[Mapping[str, Any]], sources: Sequence[Version], report: Any) -> bool:
        """Keep a result, once: of an attempt that is no longer the job's own nothing is kept.

        :raises MissingError: the face was deleted in the meantime
        :raises TooLargeError: the tenant's quota is full
        """
        with self._database.write() as rows:
            if not _end(rows, job, DONE, report=json.dumps(report)):
                return False
            version = (job.face, job.base)
            more: dict[str, Any] = {"name": job.name or "", "sources": sources}
            made, _ = self._library.add(rows, job.tenant, version, job.action, files, **more)
            rows.execute(JOBS.update().where(JOBS.c.id == job.id).values(version=made.number))
        return True

    def failed(self, job: Any, error: str) -> None:
        """Keep why an attempt failed, which ends the job."""
        with self._database.write() as rows:
            _end(rows, job, FAILED, error=error)

    def again(self, job: Any, why: str, error: str = "") -> None:
        """Queue a job again whose attempt was lost, or that this server has no time for; not for ever.

        :param why: LOST or STOPPED
        """
        with self._database.write() as rows:
            _again(rows, job, why, error)

    def beat(self) -> None:
        """Say that this server is there, and queue the jobs of others that are not."""
        with self._database.write() as rows:
            if not rows.execute(SERVERS.update().where(SERVERS.c.id == self._server).values(beat=time.time())).rowcount:
                rows.execute(SERVERS.insert().values(id=self._server, beat=time.time()))
            gone = sa.select(SERVERS.c.id).where(SERVERS.c.beat < time.time() - _AWAY)
            for job in rows.execute(sa.select(JOBS).where(JOBS.c.state == RUNNING, JOBS.c.server.in_(gone))).all():
                _again(rows, job, LOST, "its server went away")

    def take_back(self) -> None:
        """Queue what this server did when it was ended."""
        with self._database.write() as rows:
            left = sa.select(JOBS).where(JOBS.c.state == RUNNING, JOBS.c.server == self._server)
            for job in rows.execute(left).all():
                _again(rows, job, LOST, "its server was ended")

    def counts(self) -> dict[str, int]:
        """Jobs by state, of all tenants."""
        with self._database.read() as rows:
            asked = sa.select(JOBS.c.state, sa.func.count()).group_by(JOBS.c.state)
            return {state: int(count) for state, count in rows.execute(asked)}


def _held(job: Any) -> tuple[Any, ...]:
    """Whether an attempt is still that of its job."""
    return JOBS.c.id == job.id, JOBS.c.attempt == job.attempt, JOBS.c.state == RUNNING


def _end(rows: sa.Connection, job: Any, state: str, **values: Any) -> bool:
    ended = rows.execute(JOBS.update().where(*_held(job)).values(state=state, progress=None, **values)).rowcount == 1
    outcome = state if ended else CANCELLED
    own = ATTEMPTS.c.job == job.id, ATTEMPTS.c.attempt == job.attempt, ATTEMPTS.c.outcome.is_(None)
    rows.execute(ATTEMPTS.update().where(*own).values(outcome=outcome))
    return ended


def _again(rows: sa.Connection, job: Any, why: str, error: str) -> None:
    lost = sa.select(sa.func.count()).where(ATTEMPTS.c.job == job.id, ATTEMPTS.c.outcome == LOST)
    if why == LOST and (rows.scalar(lost) or 0) + 1 >= _MOST_LOST:
        _end(rows, job, FAILED, error=f"{error} ({_MOST_LOST} times)")
        return
    own = ATTEMPTS.c.job == job.id, ATTEMPTS.c.attempt == job.attempt, ATTEMPTS.c.outcome.is_(None)
    rows.execute(ATTEMPTS.update().where(*own).values(outcome=why))
    rows.execute(JOBS.update().where(*_held(job)).values(state=QUEUED, server=None, progress=None))


def _shown(job: Any) -> dict[str, Any]:
    """A job as the API has it."""
    same = {name: getattr(job, name) for name in ("id", "action", "state", "created", "attempt", "error", "version")}
    told = {name: None if (text := getattr(job, name)) is None else json.loads(text) for name in ("progress", "report")}
    return {**same, **told, "face": job.face if job.state == DONE else None}
