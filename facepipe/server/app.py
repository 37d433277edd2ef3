"""The application: what a server stands on, put together, and its routes."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse, PlainTextResponse
from starlette.exceptions import HTTPException

from facepipe.core import __version__
from facepipe.core.errors import FacepipeError
from facepipe.registry import host
from facepipe.server import edit, faces_api, jobs_api
from facepipe.server.artefacts import Artefacts
from facepipe.server.guard import API, Gate, Guard, Metrics
from facepipe.server.jobs import Jobs
from facepipe.server.library import Library, new_id
from facepipe.server.runner import Runner
from facepipe.server.services import Services
from facepipe.server.sessions import Sessions
from facepipe.server.settings import Settings
from facepipe.server.tables import Database, DatabaseError
from facepipe.server.tenants import LOCAL, tenant_named
from facepipe.server.uploads import Uploads
from facepipe.tasks.remote import StoreError

_PAGES = ("studio.html", "index.html")  # the first that is there


@dataclass(frozen=True)
class Address:
    """Where a server is reached."""

    hosts: frozenset[str]
    origins: frozenset[str]
    is_loopback: bool


def database_of(settings: Settings, folder: Path) -> Database:
    """:raises InputError: a database that can't be used"""
    return Database(settings.database or f"sqlite:///{folder / 'serve.db'}")


def services_in(folder: Path, settings: Settings) -> Services:
    """What a server stands on, in its folder; jobs are done from here on.

    :raises InputError: a database, place of artefacts or cluster that can't be used
    """
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    name = folder / "server"  # by which rows know which machine has their uploads
    if not name.exists():
        name.write_text(new_id(), encoding="utf-8")
    server = name.read_text(encoding="utf-8")
    database = database_of(settings, folder)
    library = Library(
        database, Artefacts(settings.artefacts or str(folder / "artefacts")), int(settings.quota_gb * 1e9)
    )
    jobs = Jobs(library, server)
    uploads = Uploads(database, folder / "uploads", server, retain=settings.retain)
    limits: Any = {"seconds": settings.seconds, "memory_mb": settings.memory_mb}
    way: Any = {"processes": settings.processes, "cluster": settings.cluster}
    runner = Runner(library, jobs, uploads, folder / "work", **way, **limits)
    sessions = Sessions(folder / "work" / "sessions", library.lay, settings.sessions, settings.sessions_mb)
    return Services(library, jobs, uploads, runner, Metrics(), sessions, folder / "work")


def create_app(services: Services, address: Address, settings: Settings) -> FastAPI:
    """The application of a server at an address."""

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        services.runner.bus.begin()
        yield
        services.sessions.close()
        await asyncio.to_thread(services.runner.close)

    about = "Faces that are kept, worked on and streamed; docs/serve.md has how it is run and what it keeps."
    app = FastAPI(
        title="facepipe",
        version=__version__,
        description=about,
        openapi_url=f"{API}/openapi.json",
        docs_url=None,  # their pages load scripts of other hosts
        redoc_url=None,
        generate_unique_id_function=lambda route: route.name,  # by which links name operations
        lifespan=lifespan,
    )
    app.state.services = services
    gate = Gate(
        hosts=address.hosts,
        origins=address.origins,
        needs_token=not address.is_loopback,
        local=tenant_named(services.library.database, LOCAL),
        rate=settings.rate,
        upload_bytes=int(settings.upload_mb * 1e6),
    )
    app.add_middleware(Guard, gate=gate, database=services.library.database, metrics=services.metrics)
    app.include_router(faces_api.router, prefix=API)
    app.include_router(jobs_api.router, prefix=API)
    app.include_router(edit.router, prefix=API)
    _add_errors(app)
    _add_health(app, services)
    _add_pages(app)
    return app


def _add_errors(app: FastAPI) -> None:
    """Every error is a line of JSON with a status."""

    def told(_: Request, error: Exception) -> Response:
        status = getattr(error, "status", 503 if isinstance(error, DatabaseError | StoreError) else 400)
        more = {"dependents": dependents} if (dependents := getattr(error, "dependents", ())) else {}
        return JSONResponse({"error": str(error), **more}, status)

    def invalid(_: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        first = error.errors()[0]
        where = " -> ".join(ascii(one)[1:-1] if isinstance(one, str) else str(one) for one in first["loc"][:4])
        return JSONResponse({"error": f"{where[:200]}: {ascii(first['msg'])[1:-1][:300]}"}, 422)

    def other(_: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        return JSONResponse({"error": str(error.detail)}, error.status_code, headers=error.headers)

    app.add_exception_handler(FacepipeError, told)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(HTTPException, other)


def _add_health(app: FastAPI, services: Services) -> None:
    @app.get("/health", summary="Whether the process answers", response_class=PlainTextResponse)
    async def health() -> str:
        return "ok\n"

    @app.get("/ready", summary="Whether what it stands on answers too", response_class=PlainTextResponse)
    def ready() -> Response:
        try:
            services.jobs.counts()
        except DatabaseError as error:
            return PlainTextResponse(f"{error}\n", 503)
        return PlainTextResponse("ok\n")

    @app.get("/metrics", summary="Counts, as Prometheus reads them", response_class=PlainTextResponse)
    def metrics() -> str:
        return services.metrics.text(services.jobs.counts())


def _add_pages(app: FastAPI) -> None:
    """The files of the page, by a fixed list."""
    files: Mapping[str, Path] = host("view").page_files()
    page = next((files[f"/{name}"] for name in _PAGES if f"/{name}" in files), None)

    @app.get("/{path:path}", include_in_schema=False)
    async def file(path: str) -> Response:
        found = page if not path else files.get(f"/{path}")
        if found is None or not await asyncio.to_thread(found.is_file):
            raise HTTPException(404, f"/{ascii(path)[1:-1][:80]}: no such file")
        kinds = {".wasm": "application/wasm", ".mjs": "text/javascript", ".js": "text/javascript"}
        return FileResponse(found, media_type=kinds.get(found.suffix))
