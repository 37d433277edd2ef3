"""What the API takes and gives, as OpenAPI describes it."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints

from facepipe.server.remote import verbs

Id = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{24}$")]
Name = Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]+$")]
Number = Annotated[int, Field(ge=1, le=2**31 - 1)]
Verb = Annotated[str, Field(json_schema_extra={"enum": list(verbs())})]  # others are told as missing, with 404
Time = Annotated[
    str, BeforeValidator(lambda one: datetime.fromtimestamp(one, UTC).isoformat() if isinstance(one, float) else one)
]


class _Told(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Error(_Told):
    """Why something is refused, in one line."""

    error: str
    dependents: list[Id] | None = None


class SourceVersion(_Told):
    """A version that another was made of."""

    face: Id
    version: Number


class FaceVersion(_Told):
    """A version of a face."""

    number: Number
    created: Time
    made_by: str
    bytes: int
    sources: list[SourceVersion]
    conflict_of: Number | None


class Face(_Told):
    """A face, with its versions from the oldest to the newest."""

    id: Id
    name: str
    created: Time
    version: Number
    versions: list[FaceVersion]


class Faces(_Told):
    """A page of faces; `next` goes on from there."""

    faces: list[Face]
    next: Id | None


class Progress(_Told):
    """How far a job is."""

    text: str
    share: float
    picture: str | None = None  # a JPEG of how it stands, in base64


class Job(_Told):
    """Work that was accepted."""

    id: Id
    action: str
    state: Literal["queued", "running", "done", "failed", "cancelled"]
    created: Time
    attempt: int
    progress: Progress | None
    error: str | None
    report: dict[str, Any] | None
    face: Id | None
    version: Number | None


class Jobs(_Told):
    """The latest jobs."""

    jobs: list[Job]


class AcceptedJob(_Told):
    """A job that was accepted."""

    job: Job


class Uploaded(_Told):
    """A file that fields of jobs may name."""

    artefact: Id


class Action(_Told):
    """An action that is done here, with the JSON schema of its fields."""

    action: str
    summary: str
    fields: dict[str, Any]


class Actions(_Told):
    """All of them."""

    actions: list[Action]


class Me(_Told):
    """Who asks."""

    tenant: str
    quota: int
    used: int


class NewJob(_Told):
    """Work to do: the result is a new face, or a version of `face` after its version `from`."""

    model_config = ConfigDict(extra="forbid", validate_by_name=True)

    action: Verb
    fields: dict[str, Any] = {}
    name: Name | None = None
    face: Id | None = None
    base: Number | None = Field(None, alias="from")


class NewVersion(_Told):
    """Work to do whose result is the version after `from`."""

    model_config = ConfigDict(extra="forbid", validate_by_name=True)

    action: Verb
    fields: dict[str, Any] = {}
    base: Number = Field(alias="from")


class NewName(_Told):
    """A face's name."""

    name: Name
