"""What the routes stand on, and who asks them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, Request, Security
from fastapi.security import HTTPBearer

from facepipe.server.guard import Metrics
from facepipe.server.jobs import Jobs
from facepipe.server.library import Library
from facepipe.server.models import Error
from facepipe.server.runner import Runner
from facepipe.server.sessions import Sessions
from facepipe.server.uploads import Uploads


@dataclass(frozen=True)
class Services:
    """What a server stands on."""

    library: Library
    jobs: Jobs
    uploads: Uploads
    runner: Runner
    metrics: Metrics
    sessions: Sessions
    work: Path  # for files that are gone with the request


def _services(request: Request) -> Services:
    services: Services = request.app.state.services
    return services


def _tenant(request: Request) -> str:
    """As the guard has found."""
    tenant: str = request.state.tenant
    return tenant


Server = Annotated[Services, Depends(_services)]
Tenant = Annotated[str, Depends(_tenant)]
BEARER = [Security(HTTPBearer(auto_error=False, description="a token of `facepipe serve token add`"))]
_REASONS = {
    400: "a value or file that can't be used",
    401: "no token, or a wrong one",
    403: "asked by another site's page",
    404: "there is none",
    409: "others stand on it",
    413: "too many bytes",
    422: "a value of another kind or range",
    429: "too many requests",
    503: "something does not answer now",
}
ERRORS: dict[int | str, dict[str, Any]] = {
    status: {"model": Error, "description": why} for status, why in _REASONS.items()
}
