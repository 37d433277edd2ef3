"""Faces edited over a websocket: a real server, real sessions, a real client."""

from __future__ import annotations

import json
import os
import socket
import struct
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil
import pytest
from command_line import exit_code
from served import Served, done, kept, saved
from slider_faces import sample_with_sliders
from small_sources import made
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

import facepipe

pytestmark = [pytest.mark.gate, pytest.mark.slow]

WEIGHTS = {"regions": {"mouth": [0.2, 0.8]}, "default": [0.6, 0.4], "locked": {"neck": 1}}
PATIENCE = 120.0
HEAD = struct.Struct("<II")


@contextmanager
def editing(server: Served, opened: Any, **more: Any) -> Iterator[ClientConnection]:
    """A socket whose first message was sent."""
    url = f"{server.url.replace('http', 'ws', 1).rstrip('/')}/api/v1/edit"
    given: dict[str, Any] = {"subprotocols": ["facepipe.1"], "proxy": None, "open_timeout": PATIENCE} | more
    with connect(url, **given) as page:
        page.send(json.dumps({"token": None, "open": opened}))
        yield page


def told(page: ClientConnection) -> dict[str, Any]:
    """What it says next, in JSON."""
    text = page.recv(PATIENCE)
    assert isinstance(text, str)
    found: dict[str, Any] = json.loads(text)
    return found


def moved(page: ClientConnection) -> tuple[int, bool, np.ndarray]:
    """Number, whether it is settled, and offsets (n, 3) in millimetres of the next answer."""
    data = page.recv(PATIENCE)
    assert isinstance(data, bytes), data
    number, settled = HEAD.unpack_from(data)
    return number, settled == 1, np.frombuffer(data, "<f2", offset=HEAD.size).reshape(-1, 3).astype(np.float64)


def blend_of(faces: list[str]) -> dict[str, Any]:
    return {"blend": {"sources": [{"face": face, "version": 1} for face in faces]}}


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Small faces of one topology that differ."""
    folder = tmp_path_factory.mktemp("sources")
    return [saved(made(seed), folder / f"source{seed}.usdc") for seed in (1, 2)]


@pytest.fixture(scope="module")
def faces(shared_server: Served, sources: list[Path]) -> list[str]:
    return [kept(shared_server.client, one) for one in sources]


def test_weights_that_are_dragged_are_what_is_saved_and_cooked(
    shared_server: Served, faces: list[str], sources: list[Path], tmp_path: Path
) -> None:
    """The last answer has the points of the saved face, and the command makes the same bytes of its recipe."""
    with editing(shared_server, blend_of(faces)) as page:
        opened = told(page)["opened"]
        page.send(json.dumps({"n": 7, "weights": WEIGHTS}))
        answers = [moved(page), moved(page)]
    assert [(number, settled) for number, settled, _ in answers] == [(7, False), (7, True)]
    fields = blend_of(faces)["blend"] | {"weights": WEIGHTS}
    job = done(shared_server.client, "blend", fields, name="Child")
    with zipfile.ZipFile(BytesIO(shared_server.client.get("/api/v1/me/export").content)) as export:
        export.extractall(tmp_path)
    stage = tmp_path / "faces" / job["face"] / "1" / "face.usdc"
    before, child = facepipe.open(sources[0]), facepipe.open(stage)
    expected = (child.evaluate() - before.evaluate()) @ before.parts().gltf_axes[:3, :3].T * 1e3
    assert sum(mesh["points"] for mesh in opened["meshes"]) == len(expected)
    largest = np.abs(expected).max()
    assert np.abs(answers[1][2] - expected).max() <= 2.0**-10 * largest
    assert largest > 0.0
    content = stage.read_bytes()
    assert exit_code("cook", stage, "--force", "--root", tmp_path) == 0
    assert stage.read_bytes() == content


@pytest.mark.skipif(sys.platform != "linux", reason="threads have no niceness of their own there")
def test_what_settles_gives_way_to_quick_answers(shared_server: Served, faces: list[str]) -> None:
    with editing(shared_server, blend_of(faces)) as page:
        told(page)
        page.send(json.dumps({"n": 1, "weights": WEIGHTS}))
        moved(page)
        sessions = [
            one
            for one in psutil.Process(shared_server.process.pid).children()
            if "facepipe.server.session_program" in one.cmdline()
        ]
        threads = [[os.getpriority(os.PRIO_PROCESS, one.id) for one in session.threads()] for session in sessions]
    own = os.getpriority(os.PRIO_PROCESS, shared_server.process.pid)
    assert (own, max(own, 10)) in [(min(of), max(of)) for of in threads]


def test_of_weights_that_come_at_once_the_newest_is_answered(shared_server: Served, faces: list[str]) -> None:
    """Some of those before it may be; each answer is that of the weights it names."""
    with editing(shared_server, blend_of(faces)) as page:
        told(page)
        rows = {n: {"default": [1 - n / 40, n / 40]} for n in range(1, 31)}
        for n, weights in rows.items():
            page.send(json.dumps({"n": n, "weights": weights}))
        numbers = []
        while True:
            number, settled, last = moved(page)
            numbers.append(number)
            if settled:
                break
        page.send(json.dumps({"n": 99, "weights": rows[30]}))
        again = moved(page)[2]
    assert numbers[-1] == 30
    assert numbers == sorted(numbers)
    assert np.abs(again - last).max() <= 2.0**-10 * np.abs(last).max() + 0.3


def test_sliders_move_points(shared_server: Served, tmp_path: Path) -> None:
    parts = sample_with_sliders()
    face = kept(shared_server.client, saved(parts, tmp_path / "sample.usdc"))
    with editing(shared_server, {"sliders": {"face": face, "version": 1}}) as page:
        names = [one["name"] for one in told(page)["opened"]["sliders"]]
        page.send(json.dumps({"n": 1, "values": {"curved": -0.5}}))
        number, settled, offsets = moved(page)
        page.send(json.dumps({"n": 2, "values": {"curbed": -0.5}}))
        no = told(page)["error"]
    assert sorted(names) == sorted(one.name for one in parts.sliders)
    assert (number, settled) == (1, True)
    stage = facepipe.open(tmp_path / "sample.usdc")
    expected = (stage.evaluate(sliders={"curved": -0.5}) - stage.evaluate(pose="set")) @ parts.gltf_axes[:3, :3].T * 1e3
    assert np.abs(offsets - expected).max() <= 2.0**-10 * np.abs(expected).max()
    assert "no slider 'curbed', did you mean 'curved'?" in no


@pytest.mark.parametrize(
    "first",
    [
        "{",
        "[]",
        json.dumps({"open": {}}),
        json.dumps({"open": {"blend": {"sources": []}}}),
        json.dumps({"open": {"sliders": {"face": "../../etc", "version": 1}}}),
        json.dumps({"open": {"sliders": {"face": "0" * 24, "version": 1}}}),
        json.dumps({"token": "wrong", "open": {"sliders": {"face": "0" * 24, "version": 1}}}),
    ],
)
def test_a_first_message_that_opens_nothing_ends_the_socket(shared_server: Served, first: str) -> None:
    url = f"{shared_server.url.replace('http', 'ws', 1).rstrip('/')}/api/v1/edit"
    with connect(url, subprotocols=[Subprotocol("facepipe.1")], proxy=None, open_timeout=PATIENCE) as page:
        page.send(first)
        assert told(page)["error"]
        with pytest.raises(ConnectionClosed) as closed:
            page.recv(PATIENCE)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1008


def test_a_message_that_is_too_long_ends_the_socket(shared_server: Served, faces: list[str]) -> None:
    with editing(shared_server, blend_of(faces)) as page:
        told(page)
        page.send(json.dumps({"n": 1, "weights": {"default": [0.5] * 20_000}}))
        with pytest.raises(ConnectionClosed) as closed:
            page.recv(PATIENCE)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1009


@pytest.mark.parametrize(
    "sent", ["{", '{"n": -1, "weights": {}}', '{"n": 1}', '{"n": 1, "weights": {"beard": [1, 0]}}']
)
def test_an_edit_that_makes_no_sense_is_told_and_the_next_one_is_done(
    shared_server: Served, faces: list[str], sent: str
) -> None:
    with editing(shared_server, blend_of(faces)) as page:
        told(page)
        page.send(sent)
        assert told(page)["error"]
        page.send(json.dumps({"n": 3, "weights": WEIGHTS}))
        assert moved(page)[0] == 3


def test_pages_of_other_sites_and_other_names_of_this_one_get_no_socket(shared_server: Served) -> None:
    port = int(shared_server.url.rstrip("/").rpartition(":")[2])
    own, other = f"ws://127.0.0.1:{port}/api/v1/edit", f"ws://elsewhere.example:{port}/api/v1/edit"
    pages: list[tuple[str, Any]] = [
        (own, {"origin": "http://elsewhere.example"}),
        (own, {"origin": "null"}),
        (other, {}),
    ]
    for url, more in pages:
        given: dict[str, Any] = {"sock": socket.create_connection(("127.0.0.1", port)), "subprotocols": ["facepipe.1"]}
        with pytest.raises(InvalidStatus) as refused, connect(url, **given, **more):
            pass
        assert refused.value.response.status_code == 403, url


def test_a_payload_of_other_values(client: httpx.Client, faces: list[str]) -> None:
    """Only of faces that have a basis, sliders that they have, and versions that there are."""
    for version, values, status in ((1, {}, 400), (1, {"nose": 1.0}, 400), (2, {}, 404)):
        answer = client.post(f"/api/v1/faces/{faces[0]}/versions/{version}/sliders", json={"values": values})
        assert (answer.status_code, list(answer.json())) == (status, ["error"]), answer.text
