"""Faces that move while they are edited: a websocket over warm sessions, and the payload of a face with other sliders.

Saving is a job like any other: `POST /jobs` or `POST /faces/{face}/versions`, with the weights or values that were last
seen. So there is one way to make a face, the command's, and `facepipe cook` makes the same bytes of its recipe.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import APIRouter, Response, WebSocket
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError, model_validator
from starlette.websockets import WebSocketDisconnect, WebSocketState

from facepipe.core.errors import FacepipeError
from facepipe.server import models
from facepipe.server.faces_api import BINARY, FaceId, VersionNumber
from facepipe.server.library import Version
from facepipe.server.refusals import RefusedError
from facepipe.server.services import BEARER, ERRORS, Server, Services, Tenant
from facepipe.server.sessions import Answer, Opening

router = APIRouter()
PROTOCOL = "facepipe.1"
_HEAD = struct.Struct("<II")  # number of the request, and whether no other answer to it follows
_MOST_SOURCES = 16
_MOST_SOCKETS = 64
_PATIENCE = 10.0  # seconds for the first one
_REFUSED, _TOO_MANY = 1008, 1013  # codes of closing
_Slider = Annotated[str, StringConstraints(min_length=1, max_length=200)]


class _Sources(BaseModel):
    sources: list[models.SourceVersion] = Field(min_length=2, max_length=_MOST_SOURCES)


class _Open(BaseModel):
    blend: _Sources | None = None
    sliders: models.SourceVersion | None = None

    @model_validator(mode="after")
    def _one(self) -> _Open:
        if (self.blend is None) == (self.sliders is None):
            raise ValueError("expected blend or sliders")
        return self


class _First(BaseModel):
    token: str | None = None
    open: _Open


class _Edit(BaseModel):
    """Weights or values; the newest is answered."""

    n: int = Field(ge=0, lt=1 << 32)
    weights: dict[str, Any] | None = None
    values: dict[_Slider, float] | None = None

    @property
    def request(self) -> Mapping[str, Any]:
        """As a session takes it."""
        return {"weights": self.weights} if self.values is None else {"values": self.values}


class SliderValues(BaseModel):
    """Values of sliders; those that are not named stay as they are."""

    model_config = ConfigDict(extra="forbid")

    values: dict[_Slider, float] = {}


@router.post(
    "/faces/{face}/versions/{number}/sliders",
    summary="The payload of a version with other values of its sliders",
    response_class=Response,
    dependencies=BEARER,
    responses={**ERRORS, 200: {"description": "a person: .fpb", **BINARY}},
)
async def payload(face: FaceId, number: VersionNumber, new: SliderValues, tenant: Tenant, server: Server) -> Response:
    """Nothing is kept; `POST /jobs` with the action `sliders` saves it."""
    await asyncio.to_thread(server.library.artefact, tenant, Version(face, number), "")  # says what is missing
    opening = Opening("sliders", (Version(face, number),), tenant)
    answer = await server.sessions.ask(opening, {"values": new.values, "wanted": "payload"})
    return Response(answer.body, media_type="application/octet-stream")


@router.websocket("/edit")
async def edit(socket: WebSocket) -> None:
    """A blend, or sliders, from the first message to the last; host and origin were looked at by the guard."""
    server: Services = socket.app.state.services
    if PROTOCOL not in socket.scope.get("subprotocols", ()):
        await socket.close(_REFUSED)
        return
    await socket.accept(PROTOCOL)
    try:
        if server.sessions.sockets >= _MOST_SOCKETS:
            await _say(socket, "server: too many are being edited, expected another try later")
            await socket.close(_TOO_MANY)
            return
        server.sessions.sockets += 1
        try:
            opening = await _opening(socket)
            if opening is not None:
                await _Editing(socket, server, opening).run()
        finally:
            server.sessions.sockets -= 1
    except (WebSocketDisconnect, RuntimeError):  # it has gone, perhaps while something was being sent
        pass


async def _opening(socket: WebSocket) -> Opening | None:
    """What the first message opens; None where it is told why not."""
    try:
        text = await asyncio.wait_for(socket.receive_text(), _PATIENCE)
        first = _First.model_validate_json(text)
        tenant = await socket.state.tenant_of(first.token)
    except (ValidationError, KeyError, TimeoutError, RefusedError) as error:
        told = str(error) if isinstance(error, RefusedError) else "message: expected {token, open} first"
        await _say(socket, told)
        await socket.close(_REFUSED)
        return None
    named = first.open.blend.sources if first.open.blend else [first.open.sliders]
    faces = tuple(Version(one.face, one.version) for one in named if one is not None)
    return Opening("blend" if first.open.blend else "sliders", faces, tenant)


class _Editing:
    """One socket: the newest edit that waits is asked for, and what comes of it is sent."""

    def __init__(self, socket: WebSocket, server: Services, opening: Opening) -> None:
        self._socket, self._server, self._opening = socket, server, opening
        self._waiting: _Edit | None = None
        self._there = asyncio.Event()
        self._out = asyncio.Lock()
        self._late: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        """Until the page goes."""
        asking = asyncio.create_task(self._ask())
        try:
            while True:
                text = await self._socket.receive_text()
                try:
                    self._waiting = _Edit.model_validate_json(text)
                except ValidationError:
                    await self._send("message: expected {n, weights} or {n, values}")
                else:
                    self._there.set()
        except KeyError:  # bytes
            await self._socket.close(_REFUSED)
        finally:
            for task in (asking, *self._late):
                task.cancel()

    async def _ask(self) -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            try:
                await self._send({"opened": await self._server.sessions.opened(self._opening)})
            except FacepipeError as error:
                await self._send(str(error))
                await self._socket.close(_REFUSED)
                return
            while True:
                await self._there.wait()
                self._there.clear()
                if self._waiting is None:
                    continue
                asked, self._waiting = self._waiting, None
                try:
                    answer = await self._server.sessions.ask(self._opening, asked.request, self._settled(asked.n))
                except FacepipeError as error:
                    await self._send(str(error))
                else:
                    await self._send(_framed(asked.n, answer))

    def _settled(self, number: int) -> Any:
        def send(answer: Answer) -> None:
            task = asyncio.create_task(self._send(_framed(number, answer)))
            self._late.add(task)
            task.add_done_callback(self._late.discard)

        return send

    async def _send(self, what: str | bytes | Mapping[str, Any]) -> None:
        async with self._out:
            if self._socket.application_state != WebSocketState.CONNECTED:
                return
            if isinstance(what, bytes):
                await self._socket.send_bytes(what)
            elif isinstance(what, str):
                await _say(self._socket, what)
            else:
                await self._socket.send_text(json.dumps(what))


def _framed(number: int, answer: Answer) -> bytes:
    return _HEAD.pack(number, answer.settled) + answer.body


async def _say(socket: WebSocket, why: str) -> None:
    await socket.send_text(json.dumps({"error": why}))
