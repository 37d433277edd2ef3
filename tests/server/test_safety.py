"""Whom a server answers, and how much it takes."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
from command_line import Capsys, failed
from served import Serve, Served, ended, kept, sent

from facepipe.actions import find_action
from facepipe.declare import fields_of
from facepipe.kinds import FolderAction, InPlaceAction, Inspector
from facepipe.registry import manifest
from facepipe.server import remote

RUNS = {"trust", "trust_models", "models", "plugin", "checkpoint"}  # names of fields that would choose code


def token(folder: Path, what: str, *words: str) -> str:
    """What `facepipe serve token` prints."""
    line = [sys.executable, "-m", "facepipe", "-q", "serve", "token", what, *words, str(folder)]
    return subprocess.run(line, capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A server that needs tokens, two tenants' clients, and one of nobody."""
    folder = tmp_path_factory.mktemp("tokens") / "state"
    tokens = {name: token(folder, "add", name) for name in ("ada", "bob")}
    served = Served(folder, "--host", "0.0.0.0", "--processes", "1")
    served.url = f"http://127.0.0.1:{urlsplit(served.url).port}"
    yield served, served.asked_with(tokens["ada"]), served.asked_with(tokens["bob"]), served.asked_with()
    served.stop()


@pytest.mark.parametrize("verb", list(manifest()["actions"]))
def test_what_is_remote_makes_a_face_and_chooses_no_code(verb: str) -> None:
    kind, is_remote = find_action(verb), verb in remote.verbs()
    assert kind is not None
    assert is_remote == kind.remote
    never = (InPlaceAction, FolderAction, Inspector)
    if issubclass(kind, never) or "train" in verb or verb.startswith("database"):
        assert not is_remote
    if is_remote:
        taken = {one.name for one in remote.taken(kind)}
        assert not taken & RUNS
        assert not any(one.role == "beside" for one in fields_of(kind) if one.name in taken)
        assert taken == set(remote.schema(verb)["properties"])


def test_commands_that_are_no_remote_actions_are_none_here(client: httpx.Client) -> None:
    for verb in ("batch", "neural-rig train", "train-photo", "rebuild", "scan", "eval", "import", "export", "nothing"):
        answer = client.post("/api/v1/jobs", json={"action": verb, "fields": {}})
        assert answer.status_code == 404, verb


@pytest.mark.parametrize(
    "fields",
    [
        {"face": "/etc/passwd"},
        {"face": "../../serve.db"},
        {"face": {"face": "/etc/passwd"}},
        {"face": {"face": "a" * 24}},
        {"face": {"upload": "../serve.db"}},
        {"face": "0" * 24, "picture": "/tmp/picture.png"},
        {"face": "0" * 24, "trust_models": True},
        {"face": "s3://bucket/face.usdc"},
    ],
)
def test_no_field_names_a_file_of_the_machine(client: httpx.Client, fields: dict[str, Any]) -> None:
    answer = client.post("/api/v1/jobs", json={"action": "regions", "fields": fields})
    assert answer.status_code in (400, 404)
    assert "\n" not in answer.json()["error"]


def test_only_its_own_pages_are_answered(client: httpx.Client) -> None:
    own = str(client.base_url).rstrip("/")
    faces = "/api/v1/faces"
    assert client.get(faces, headers={"Origin": own}).status_code == 200
    assert client.get(faces, headers={"Origin": "http://evil.example"}).status_code == 403
    assert client.get(faces, headers={"Origin": "null"}).status_code == 403
    assert client.get(faces, headers={"Origin": own.replace("http:", "https:")}).status_code == 403
    assert client.get(faces, headers={"Host": "evil.example"}).status_code == 403
    assert client.get(faces, headers={"Host": f"evil.example:{client.base_url.port}"}).status_code == 403
    assert client.get(faces, headers={"Sec-Fetch-Site": "cross-site"}).status_code == 403
    assert client.options(faces, headers={"Origin": "http://evil.example"}).status_code == 403
    answer = client.get(faces)
    assert not [name for name in answer.headers if name.startswith("access-control")]
    assert answer.headers["cache-control"] == "no-store"
    assert "default-src 'self'" in answer.headers["content-security-policy"]


def test_behind_a_proxy_it_answers_to_the_names_that_browsers_use(serve: Serve, tmp_path: Path) -> None:
    """Each that was given; and whoever comes so needs a token."""
    word = token(tmp_path / "state", "add", "ada")
    names = ("faces.example.com", "faces.example.org:8443")
    served = serve(*[one for name in names for one in ("--origin", f"https://{name}")])
    for name in (*names, "faces.example.net"):
        head = {"Host": name, "Origin": f"https://{name}", "Authorization": f"Bearer {word}"}
        assert served.client.get("/api/v1/faces", headers=head).status_code == (200 if name in names else 403), name
    assert served.client.get("/api/v1/faces", headers={"Host": names[0]}).status_code == 401


def test_a_websocket_of_another_site_is_refused(client: httpx.Client) -> None:
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect
    from websockets.typing import Origin, Subprotocol

    url = f"ws://{client.base_url.host}:{client.base_url.port}/api/v1/edit"
    with pytest.raises(InvalidStatus) as refused:
        connect(url, origin=Origin("http://evil.example"), subprotocols=[Subprotocol("facepipe.1")])
    assert refused.value.response.status_code == 403


def test_each_tenant_sees_its_own_alone(two: Any, heads: list[Path]) -> None:
    served, ada, bob, nobody = two
    face = kept(ada, heads[0], "Ada's")
    job = ada.get("/api/v1/jobs").json()["jobs"][0]["id"]
    assert (ada.get("/api/v1/me").json()["tenant"], bob.get("/api/v1/me").json()["tenant"]) == ("ada", "bob")
    paths = [f"/api/v1/faces/{face}", f"/api/v1/faces/{face}/versions/1/face.usdc", f"/api/v1/jobs/{job}"]
    for path in (*paths, f"/api/v1/jobs/{job}/events"):
        own, other = ada.get(path), bob.get(path)
        none = bob.get(path.replace(face, "0" * 24).replace(job, "0" * 24))
        assert (own.status_code, other.status_code, none.status_code) == (200, 404, 404), path
        assert len(other.text) == len(none.text)  # another's looks like none
    assert bob.get("/api/v1/faces").json()["faces"] == bob.get("/api/v1/jobs").json()["jobs"] == []
    assert bob.patch(f"/api/v1/faces/{face}", json={"name": "x"}).status_code == 404
    assert bob.delete(f"/api/v1/faces/{face}").status_code == 404
    assert bob.delete(f"/api/v1/jobs/{job}").status_code == 404
    blend = {"action": "blend", "fields": {"sources": [{"face": face}, {"face": face}]}}
    assert bob.post("/api/v1/jobs", json=blend).status_code == 404
    assert face not in bob.get("/api/v1/me/export").content.decode("latin-1")
    for path in ("/api/v1/faces", "/api/v1/me", "/metrics", paths[1]):
        assert nobody.get(path).status_code == 401
    assert nobody.get("/api/v1/me", headers={"Authorization": "Bearer wrong"}).status_code == 401
    assert nobody.get("/health").status_code == nobody.get("/ready").status_code == 200
    log = served.log.read_text()
    assert "request" in log
    for said in ("Ada's", face, job, ada.headers["Authorization"].split()[1]):
        assert said not in log


def test_a_token_that_was_taken_back_opens_nothing(two: Any) -> None:
    served, *_ = two
    client = served.asked_with(token(served.folder, "add", "eve"))
    assert client.get("/api/v1/me").json()["tenant"] == "eve"
    assert "eve" in token(served.folder, "list")
    token(served.folder, "revoke", "eve")
    assert client.get("/api/v1/me").status_code == 401


def test_a_quota_and_an_upload_have_their_limits(serve: Serve, heads: list[Path], tmp_path: Path) -> None:
    served = serve("--quota-gb", "0.0001", "--upload-mb", "1", "--rate", "1000")
    (tmp_path / "large.obj").write_bytes(b"v 0 0 0\n" * 200_000)
    assert sent(served.client, tmp_path / "large.obj").status_code == 413

    def endless() -> Any:
        yield b'--b\r\nContent-Disposition: form-data; name="files"; filename="a.obj"\r\n\r\n'
        for _ in range(1000):
            yield b"v 0 0 0\n" * 1000

    head = {"Content-Type": "multipart/form-data; boundary=b"}
    with contextlib.suppress(httpx.TransportError):  # the answer came while it was still being sent
        assert served.client.post("/api/v1/faces", content=endless(), headers=head).status_code == 413
    assert served.client.post("/api/v1/jobs", content=b" " * (2 << 20)).status_code == 413
    assert list((served.folder / "uploads").iterdir()) == []
    for _ in range(20):
        job = ended(served.client, sent(served.client, heads[0]).json()["job"]["id"])
        if job["state"] == "failed":
            break
    assert "full" in job["error"]
    assert served.client.get("/api/v1/me").json()["used"] <= 100_000


def test_who_asks_too_often_is_told_to_wait(serve: Serve) -> None:
    served = serve("--rate", "5")
    statuses = [served.client.get("/health").status_code for _ in range(200)]
    assert {200, 429} == set(statuses)
    assert statuses.index(429) >= 50
    time.sleep(1.0)
    assert served.client.get("/health").status_code == 200


def test_a_connection_that_says_nothing_or_nonsense_stops_nobody(client: httpx.Client) -> None:
    address = (client.base_url.host, client.base_url.port)
    silent = [socket.create_connection(address) for _ in range(50)]
    for number, one in enumerate(silent):
        one.sendall((b"GET / HT", b"\x00\xff" * 100, b"POST /api/v1/faces HTTP/1.1\r\n")[number % 3])
    assert client.get("/health").status_code == 200
    for one in silent:
        one.close()


def test_metrics_count_without_naming(client: httpx.Client, heads: list[Path]) -> None:
    face = kept(client, heads[0], "Somebody")
    client.get(f"/api/v1/faces/{face}")
    text = client.get("/metrics").text
    assert 'facepipe_jobs{state="done"}' in text
    assert 'route="/faces/{face}",status="200"' in text
    assert face not in text
    assert "Somebody" not in text


def test_elsewhere_than_here_somebody_must_have_a_token(tmp_path: Path, capsys: Capsys) -> None:
    line, before = ("serve", tmp_path / "state", "--host", "0.0.0.0", "--port", "0"), tempfile.gettempdir()
    assert "nobody has a token" in failed(capsys, *line, folder=tmp_path / "other")
    assert tempfile.gettempdir() == before


def test_the_interface_describes_itself(client: httpx.Client) -> None:
    said = client.get("/api/v1/openapi.json").json()
    for path, methods in said["paths"].items():
        for method, one in methods.items():
            assert one["summary"], (path, method)
            assert any(status[0] == "2" for status in one["responses"]), (path, method)
    assert {"/api/v1/faces", "/api/v1/jobs/{job}/events", "/api/v1/me"} <= set(said["paths"])
    assert json.dumps(said)
