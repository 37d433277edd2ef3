"""Routes of actions, jobs and their events, and of who asks."""

from __future__ import annotations

import asyncio
import json
import tempfile
from collections.abc import AsyncIterator
from typing import Annotated, Any, BinaryIO, cast

from fastapi import APIRouter, Path, Response
from fastapi.responses import StreamingResponse
from starlette.background import BackgroundTask

from facepipe.registry import manifest
from facepipe.server import models, remote, tenants
from facepipe.server.jobs import ENDED, Asked
from facepipe.server.library import new_id
from facepipe.server.refusals import MissingError, RefusedError
from facepipe.server.services import BEARER, ERRORS, Server, Services, Tenant

router = APIRouter(dependencies=BEARER, responses=ERRORS)
JobId = Annotated[models.Id, Path(description="id of a job")]
_LOOK, _SIGN = 2.0, 15.0  # seconds between two looks at a job, and without news before a sign that the line stands


_SAMPLE = {"operationId": "add_job", "requestBody": {"action": "sample", "fields": {}}}


@router.get("/actions", summary="The actions that are done here", responses={200: {"links": {"ask for one": _SAMPLE}}})
def list_actions() -> models.Actions:
    known = manifest()["actions"]
    found = [
        {"action": verb, "summary": known[verb]["summary"], "fields": remote.schema(verb)} for verb in remote.verbs()
    ]
    return models.Actions(actions=[models.Action(**one) for one in found])


@router.post("/jobs", summary="Ask for work", status_code=202)
def add_job(new: models.NewJob, tenant: Tenant, server: Server) -> models.Job:
    """Once it is answered the job is not lost: it is done even if the server is ended meanwhile."""
    given = remote.given(new.action, new.fields, lambda face: server.library.newest(tenant, face))
    base = None
    if new.face is not None:
        newest = server.library.newest(tenant, new.face)
        base = newest if new.base is None else new.base
        if base > newest:
            raise MissingError(new.face, "no such version")
    asked = Asked(
        action=new.action,
        fields=given.fields,
        face=new.face or new_id(),
        base=base,
        name=new.name,
        uploads=given.uploads,
    )
    job = server.jobs.add(tenant, asked)
    server.runner.wake()
    return models.Job(**job)


@router.get("/jobs", summary="List the latest jobs, the newest first")
def list_jobs(tenant: Tenant, server: Server) -> models.Jobs:
    return models.Jobs(jobs=[models.Job(**one) for one in server.jobs.listed(tenant)])


@router.get("/jobs/{job}", summary="A job")
def get_job(job: JobId, tenant: Tenant, server: Server) -> models.Job:
    return models.Job(**server.runner.pictured(server.jobs.job(tenant, job)))


@router.delete("/jobs/{job}", summary="Cancel a job; one that has ended stays as it is")
def cancel_job(job: JobId, tenant: Tenant, server: Server) -> models.Job:
    found = server.jobs.cancel(tenant, job)
    server.runner.cancel(job)
    return models.Job(**found)


@router.get(
    "/jobs/{job}/events",
    summary="What happens to a job, until it ends",
    response_class=StreamingResponse,
    responses={200: {"description": "server-sent events: state, progress, done", "content": {"text/event-stream": {}}}},
)
async def job_events(job: JobId, tenant: Tenant, server: Server) -> Response:
    first = await asyncio.to_thread(server.jobs.job, tenant, job)
    return StreamingResponse(_events(server, tenant, first), media_type="text/event-stream")


async def _events(server: Services, tenant: str, job: dict[str, Any]) -> AsyncIterator[str]:
    last: dict[str, Any] = {}
    quiet = 0.0
    while True:
        job = server.runner.pictured(job)
        if job != last:
            kind = "done" if job["state"] in ENDED else "state" if job["state"] != last.get("state") else "progress"
            yield f"event: {kind}\ndata: {models.Job(**job).model_dump_json()}\n\n"
            if job["state"] in ENDED:
                return
            last, quiet = job, 0.0
        elif quiet >= _SIGN:
            yield ": still there\n\n"
            quiet = 0.0
        await server.runner.bus.wait(job["id"], _LOOK)
        if server.runner.stopping:
            return
        quiet += _LOOK
        try:
            job = await asyncio.to_thread(server.jobs.job, tenant, job["id"])
        except RefusedError:  # deleted with its face
            yield f"event: done\ndata: {json.dumps({'id': job['id'], 'state': 'cancelled'})}\n\n"
            return


@router.get("/me", summary="Who asks")
def get_me(tenant: Tenant, server: Server) -> models.Me:
    library = server.library
    name = tenants.name_of(library.database, tenant)
    return models.Me(tenant=name, quota=library.quota, used=library.used(tenant))


@router.get(
    "/me/export",
    summary="All that is kept of who asks, as a ZIP",
    response_class=StreamingResponse,
    responses={200: {"description": "a ZIP", "content": {"application/zip": {}}}},
)
def export_me(tenant: Tenant, server: Server) -> Response:
    file = tempfile.TemporaryFile(dir=server.work)  # noqa: SIM115  (closed when it is sent)
    try:
        tenants.export(server.library, tenant, cast("BinaryIO", file))
        file.seek(0)
    except BaseException:
        file.close()
        raise
    pieces = iter(lambda: file.read(1 << 18), b"")
    return StreamingResponse(pieces, media_type="application/zip", background=BackgroundTask(file.close))


@router.delete("/me", summary="Delete all that is kept of who asks, tokens too", status_code=204, response_model=None)
def delete_me(tenant: Tenant, server: Server) -> None:
    for job in tenants.delete(server.library, server.uploads, tenant):
        server.runner.cancel(job)
    server.sessions.forget(tenant)
