"""Routes of faces: upload, list, versions and their files, deletion."""

from __future__ import annotations

import asyncio
import shutil
from pathlib import Path as FilePath
from pathlib import PurePosixPath
from typing import Annotated, Any, Literal, get_args

from fastapi import APIRouter, Header, Path, Query, Request, Response
from fastapi.responses import StreamingResponse
from starlette.concurrency import iterate_in_threadpool

from facepipe.core.errors import InputError, system_errors
from facepipe.importers import kind_of
from facepipe.server import models, remote
from facepipe.server.jobs import Asked
from facepipe.server.library import STAGE, Version, new_id
from facepipe.server.program import MADE
from facepipe.server.refusals import MissingError
from facepipe.server.runner import UPLOAD
from facepipe.server.services import BEARER, ERRORS, Server, Services, Tenant
from facepipe.server.uploads import FACE, FILE, PHOTO, checked_name
from facepipe.stage.files import SUFFIXES

router = APIRouter(dependencies=BEARER, responses=ERRORS)
FaceId = Annotated[models.Id, Path(description="id of a face")]
VersionNumber = Annotated[models.Number, Path(description="number of a version")]
_ORDER = (*SUFFIXES, ".glb", ".gltf", ".vrm", ".fbx", ".obj", ".fpb")  # of several files the first kind is the face
_TYPES = {
    ".glb": "model/gltf-binary",
    ".json": "application/json",
    ".png": "image/png",
    ".usdc": "model/vnd.usd",
    ".usdz": "model/vnd.usdz+zip",
}
_PHOTOS = {b"\xff\xd8\xff": ".jpg", b"\x89PNG": ".png", b"RIFF": ".webp", b"ftyp": ".heic"}
BINARY: Any = {"content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}}
_FILES: Any = {kind: {"schema": {}} for kind in ("application/octet-stream", *_TYPES.values())}
_PIECE = 1 << 18  # bytes
_MOST_FILES, _MOST_FIELD = 200, 1000  # of a form, and bytes of a field that is no file
_SUFFIX = r"^\.[A-Za-z0-9]{1,10}$"


@router.post(
    "/faces",
    status_code=202,
    summary="Take a face in: one or more files of one",
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "multipart/form-data": {
                    "schema": {
                        "type": "object",
                        "properties": {
                            "files": {"type": "array", "items": {"type": "string", "format": "binary"}, "minItems": 1},
                            "name": {"type": "string", "maxLength": 200},
                        },
                        "required": ["files"],
                    }
                }
            },
        }
    },
)
async def add_face(request: Request, tenant: Tenant, server: Server) -> models.AcceptedJob:
    """The files are checked by the job, in a process of its own."""
    place = await asyncio.to_thread(server.uploads.place)
    try:
        files, name = await _received(request, place)
        main = _main(files)
        name = name or PurePosixPath(main).stem
        if not name.isprintable() or len(name) > 200:
            raise InputError("name", "expected up to 200 printable characters")

        def accept() -> dict[str, Any]:
            upload = server.uploads.add(tenant, place, FACE, main)
            asked = Asked(
                action=UPLOAD, fields={"upload": upload}, face=new_id(), base=None, name=name, uploads=[upload]
            )
            return server.jobs.add(tenant, asked)

        job = await asyncio.to_thread(accept)
    except BaseException:
        await asyncio.to_thread(shutil.rmtree, place, True)
        raise
    server.runner.wake()
    return models.AcceptedJob(job=models.Job(**job))


async def _received(request: Request, place: FilePath) -> tuple[list[str], str]:
    """Write the files of a form to a folder; what they are called, and the face.

    :raises InputError: files of one name, or names that files here can't have
    """
    if not request.headers.get("content-type", "").startswith("multipart/form-data"):
        raise InputError("Content-Type", "expected multipart/form-data")
    files: list[str] = []
    async with request.form(max_files=_MOST_FILES, max_fields=2, max_part_size=_MOST_FIELD) as form:
        for _, one in form.multi_items():
            if isinstance(one, str):
                continue
            name = checked_name(one.filename or "")
            with system_errors("files", "expected files of different names"):
                (place / name).parent.mkdir(parents=True, exist_ok=True)
                with (place / name).open("xb") as out:
                    await asyncio.to_thread(shutil.copyfileobj, one.file, out)
            files.append(name)
        named = form.get("name")
    return files, named.strip() if isinstance(named, str) else ""


def _main(files: list[str]) -> str:
    """The file that is the face.

    :raises InputError: none, or several
    """
    for suffix in _ORDER:
        found = [one for one in files if one.lower().endswith(suffix)]
        if len(found) == 1:
            return found[0]
        if found:
            raise InputError("files", f"{len(found)} of {suffix}, expected one face")
    if files:
        kind_of(files[0])  # says what is read
    raise InputError("files", "none of a face")


async def _taken(request: Request, tenant: str, server: Services, kind: str, name: str, consent: str = "") -> str:
    place = await asyncio.to_thread(server.uploads.place)
    try:
        with (place / name).open("xb") as file:
            async for piece in request.stream():
                file.write(piece)
        if kind == PHOTO:
            name = (place / name).rename(place / f"photo{_photo_suffix(place / name)}").name
        return await asyncio.to_thread(server.uploads.add, tenant, place, kind, name, consent)
    except BaseException:
        await asyncio.to_thread(shutil.rmtree, place, True)
        raise


def _photo_suffix(file: FilePath) -> str:
    """By what is in it, whatever it was called.

    :raises InputError: no photo
    """
    with file.open("rb") as opened:
        head = opened.read(16)
    for start, suffix in _PHOTOS.items():
        if head.startswith(start) or head[4:].startswith(start):
            return suffix
    raise InputError("photo", "is none that is read here, expected JPEG, PNG, WebP or HEIC")


_BODY = {"requestBody": {"required": True, **BINARY}}


@router.post("/photos", summary="Send a photo, for a job that uses it", status_code=201, openapi_extra=_BODY)
async def add_photo(
    request: Request,
    tenant: Tenant,
    server: Server,
    consent: Annotated[str, Header(alias="X-Facepipe-Consent", pattern=r"^[\w.-]{1,80}$")],
) -> models.Uploaded:
    """It is deleted after that job, or after an hour; the version of the text that was agreed to is kept, and when."""
    return models.Uploaded(artefact=await _taken(request, tenant, server, PHOTO, "photo", consent))


@router.delete("/photos/{photo}", summary="Delete a photo that no job waits for", status_code=204, response_model=None)
def delete_photo(
    photo: Annotated[models.Id, Path(description="id of a photo")], tenant: Tenant, server: Server
) -> None:
    """At once, also where photos are kept after their jobs."""
    server.uploads.discard(tenant, photo)


@router.get("/photos/{photo}/landmarks", summary="Where the landmarks of the face in a photo are")
async def find_landmarks(
    photo: Annotated[models.Id, Path(description="id of a photo")], tenant: Tenant, server: Server
) -> dict[str, Any]:
    """As `--landmarks` of `facepipe fit-photo` takes them; nothing of them is kept here."""
    found: dict[str, Any] = await server.runner.landmarks(tenant, photo)
    return found


@router.post(
    "/files", summary="Send a file that fields of jobs name: a clip, a scan", status_code=201, openapi_extra=_BODY
)
async def add_file(
    request: Request, tenant: Tenant, server: Server, suffix: Annotated[str, Query(pattern=_SUFFIX)]
) -> models.Uploaded:
    """It is deleted after the job that uses it, or after an hour."""
    return models.Uploaded(artefact=await _taken(request, tenant, server, FILE, f"file{suffix.lower()}"))


_FIRST, _SECOND = ({"face": f"$response.body#/faces/{one}/id"} for one in range(2))
_LINKS: Any = {
    "blend two": {
        "operationId": "add_job",
        "requestBody": {"action": "blend", "fields": {"sources": [_FIRST, _SECOND]}},
    },
    "fetch one": {
        "operationId": "get_file",
        "parameters": {**_FIRST, "number": "$response.body#/faces/0/version", "what": "face.glb"},
    },
}


@router.get("/faces", summary="List faces, the newest first", responses={200: {"links": _LINKS}})
def list_faces(
    tenant: Tenant,
    server: Server,
    search: Annotated[str, Query(max_length=200, pattern=r"^[^\x00]*$", description="part of their names")] = "",
    after: Annotated[models.Id | None, Query(description="`next` of the page before")] = None,
) -> models.Faces:
    faces, last = server.library.faces(tenant, search, after or "")
    return models.Faces(faces=[models.Face(**one) for one in faces], next=last)


@router.get("/faces/{face}", summary="A face")
def get_face(face: FaceId, tenant: Tenant, server: Server) -> models.Face:
    return models.Face(**server.library.face(tenant, face))


@router.patch("/faces/{face}", summary="Name a face")
def rename_face(face: FaceId, new: models.NewName, tenant: Tenant, server: Server) -> models.Face:
    server.library.rename(tenant, face, new.name)
    return models.Face(**server.library.face(tenant, face))


@router.delete(
    "/faces/{face}", summary="Delete a face with all that was made of it", status_code=204, response_model=None
)
def delete_face(
    face: FaceId,
    tenant: Tenant,
    server: Server,
    dependents: Annotated[Literal["keep"] | None, Query(description="faces that were made of it stay")] = None,
) -> None:
    """Without `dependents=keep` it is refused where recipes of others name it; these are listed."""
    for job in server.library.delete(tenant, face, keep=dependents == "keep"):
        server.runner.cancel(job)
    server.sessions.forget(tenant, face)


@router.post("/faces/{face}/versions", summary="Save an edit of a version", status_code=202)
def add_version(face: FaceId, new: models.NewVersion, tenant: Tenant, server: Server) -> models.AcceptedJob:
    """Where `from` is no longer the newest, both are kept, and the new one's `conflict_of` says which it passed by."""
    if new.base > server.library.newest(tenant, face):
        raise MissingError(face, "no such version")
    given = remote.given(new.action, new.fields, lambda one: server.library.newest(tenant, one))
    asked = Asked(action=new.action, fields=given.fields, face=face, base=new.base, uploads=given.uploads)
    job = server.jobs.add(tenant, asked)
    server.runner.wake()
    return models.AcceptedJob(job=models.Job(**job))


What = Literal[
    "thumbnail.png", "face.glb", "face.fpb", "face.usdc", "face.usdz", "face.onnx", "face.onnx.json",
    "sliders.onnx", "sliders.onnx.json", "regions.bin", "details.json", "recipe.json",
]  # fmt: skip


@router.get(
    "/faces/{face}/versions/{number}/{what}",
    summary="A file of a version",
    response_class=StreamingResponse,
    responses={200: {"description": "the file", "content": _FILES}, 304: {"description": "it is what the caller has"}},
)
async def get_file(
    face: FaceId,
    number: VersionNumber,
    what: What,
    tenant: Tenant,
    server: Server,
    known: Annotated[str | None, Header(alias="If-None-Match")] = None,
) -> Response:
    """Made when it is first asked for, and kept then."""
    content = await server.runner.made(tenant, Version(face, number), what)
    if content is None:
        raise MissingError(what, "this face has none")
    headers = {"ETag": f'"{content.removeprefix("sha256:")}"'}
    if known is not None and headers["ETag"] in known:
        return Response(status_code=304, headers=headers)
    file = await asyncio.to_thread(server.library.open, tenant, face, content)
    size = file.seek(0, 2)
    file.seek(0)

    def pieces() -> Any:
        with file:
            while piece := file.read(_PIECE):
                yield piece

    kind = _TYPES.get(PurePosixPath(what).suffix, "application/octet-stream")
    headers |= {"Content-Length": str(size)}
    return StreamingResponse(iterate_in_threadpool(pieces()), headers=headers, media_type=kind)


assert {*get_args(What)} == {STAGE, *MADE}
