"""The viewer's server: what it gives out, to whom, and how it ends. The page itself is made up."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import exit_code, failed
from facepipe_web import Options, build, view
from facepipe_web.viewer import MOST_CONNECTIONS, Server
from faces import tiny_face

from facepipe.core.errors import InputError
from facepipe.core.policy.paths import Trust, trust, trusting
from facepipe.parts import Slider
from facepipe.stage import save_parts

SECRET = b"not for the page"


@pytest.fixture(scope="module", autouse=True)
def quick_to_end() -> Iterator[None]:
    """Servers look many times a second whether they are closed."""
    serve = Server.serve_forever
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Server, "serve_forever", lambda server, poll_interval=0.0: serve(server, 0.01))
        yield


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A built page, and a file beside its folder."""
    dist = tmp_path / "dist"
    (dist / "licences").mkdir(parents=True)
    for name in ("index.html", "viewer.js", "style.css", "a.mjs", "a.wasm", "licences/three.txt"):
        (dist / name).write_text(name)
    (dist / build.STAMP).write_text(json.dumps({"sources": build.sources_digest()}))
    (tmp_path / "secret.txt").write_bytes(SECRET)
    monkeypatch.setattr(build, "DIST", dist)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def face(page: Path) -> Path:
    save_parts(tiny_face(), page / "face.usda")
    return page / "face.usda"


def test_the_policy_towards_files_is_that_of_who_made_the_server() -> None:
    with trusting(Trust(models=True)):
        server = Server(0, {}, {"/trust": lambda sent: ("text/plain", str(trust().models).encode())})
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
        connection.request("POST", "/trust", b"{}", {"Content-Type": "application/json"})
        assert connection.getresponse().read() == b"True"
        connection.close()
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture
def server(face: Path) -> Iterator[int]:
    """The port of a viewer."""
    with view([face], Options()) as viewer:
        thread = threading.Thread(target=viewer.serve, daemon=True)
        thread.start()
        yield int(viewer.url.rstrip("/").rpartition(":")[2])
        viewer.close()
        thread.join(timeout=60)
        assert not thread.is_alive()


def get(port: int, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    found = answer.status, dict(answer.headers.items()), answer.read()
    connection.close()
    return found


@pytest.mark.parametrize(
    "path",
    [
        "/../secret.txt",
        "/%2e%2e/secret.txt",
        "/licences/../../secret.txt",
        "/licences/..%2f..%2fsecret.txt",
        "/..\\secret.txt",
        "//secret.txt",
        "secret.txt",
        "/licences",
        "/licences/",
        "/dist/index.html",
        "/etc/passwd",
        "file:///etc/passwd",
    ],
)
def test_nothing_beside_its_files(server: int, path: str) -> None:
    status, _, content = get(server, path)
    assert (status, SECRET in content) == (404, False)


def test_mime_types_and_headers(server: int) -> None:
    expected = {
        "/": "text/html; charset=utf-8",
        "/viewer.js?v=1": "text/javascript; charset=utf-8",
        "/a.mjs": "text/javascript; charset=utf-8",
        "/style.css": "text/css; charset=utf-8",
        "/a.wasm": "application/wasm",
        "/viewer.json": "application/json",
        "/faces/0/face.glb": "model/gltf-binary",
    }
    for path, kind in expected.items():
        status, headers, content = get(server, path)
        assert (status, headers["Content-Type"], int(headers["Content-Length"])) == (200, kind, len(content)), path
        assert headers["Cross-Origin-Opener-Policy"] == "same-origin"
        assert headers["Cross-Origin-Embedder-Policy"] == "require-corp"
        assert "default-src 'self'" in headers["Content-Security-Policy"]


def test_listens_on_this_machine_alone(face: Path) -> None:
    server = Server(0, {}, {})
    try:
        assert server.socket.getsockname()[0] == "127.0.0.1"
    finally:
        server.server_close()


@pytest.mark.parametrize("header", [{"Host": "evil.example"}, {"Origin": "http://evil.example"}])
def test_other_sites_get_nothing(server: int, header: dict[str, str]) -> None:
    assert get(server, "/viewer.json", **header)[0] == 403


def test_viewer_json_names_files_that_are_there(server: int) -> None:
    content = json.loads(get(server, "/viewer.json")[2])
    assert content["blend"] is None
    (entry,) = content["faces"]
    assert (entry["label"], entry["onnx"]) == ("face.usda", None)  # it has no sliders
    details = json.loads(get(server, f"/{entry['details']}")[2])
    assert details["regions"]["names"] == ["mouth", "neck"]
    masks = get(server, f"/{details['regions']['masks']}")[2]
    assert len(masks) == 2 * sum(mesh["points"] for mesh in details["meshes"]) == 2 * 45
    assert details["joints"]["paths"] == ["root", "root/jaw", "root/jaw/lip"]
    assert get(server, f"/{entry['glb']}")[2][:4] == b"glTF"


def test_its_files_are_gone_in_the_end(face: Path) -> None:
    with view([face], Options()) as viewer:
        folder = viewer._server.files["/viewer.json"].parent
        assert folder.is_dir()
    assert not folder.exists()


def test_port_in_use(face: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert exit_code("view", face, "--port", port, "--no-browser") == 2
    out, err = capsys.readouterr()
    assert (out, err) == ("", f"facepipe: --port {port}: is in use, expected a free one (0 takes any)\n")


def test_without_a_build(face: Path, capsys: pytest.CaptureFixture[str]) -> None:
    expected = "expected `python -m facepipe_web.build` before"
    (build.DIST / build.STAMP).unlink()
    said = failed(capsys, "view", face, "--no-browser", folder=face.parent)
    assert f"is older than its sources, {expected}" in said
    build.DIST.rename(face.parent / "elsewhere")
    assert f"is not built, {expected}" in failed(capsys, "view", face, "--no-browser", folder=face.parent)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["none.glb"], "none.glb: can't be read"),
        (["secret.glb"], "secret.glb: is not a GLB"),
        (["face.usda", "--port", "70000"], "--port: is 70000"),
        (["face.usda", "--onnx", "x.onnx"], "x.onnx: is for a GLB"),
        (["none.usda"], "none.usda"),
    ],
)
def test_bad_input(face: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str) -> None:
    Path("secret.glb").write_bytes(SECRET)
    assert said in failed(capsys, "view", *words, "--no-browser", folder=face.parent)


def test_unknown_requests_are_refused(server: int) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", server, timeout=10)
    connection.request("POST", "/blend", b"{}", {"Content-Type": "application/json"})
    assert connection.getresponse().status == 404  # no blend behind this face
    connection.close()


def test_actions_take_json_alone(face: Path) -> None:
    def refuse(sent: bytes) -> tuple[str, bytes]:
        if sent != b"{}":
            raise InputError("weights", "none")
        return "text/plain", b"taken"

    server = Server(0, {}, {"/do": refuse})
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        for content, kind, status in (
            (b"{}", "application/json", 200),
            (b"[]", "application/json", 400),
            (b"{}", "text/plain", 415),
        ):
            connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
            connection.request("POST", "/do", content, {"Content-Type": kind})
            assert connection.getresponse().status == status
            connection.close()
        connection.putrequest("POST", "/do")
        connection.putheader("Content-Length", str(1 << 40))
        connection.endheaders()
        assert connection.getresponse().status == 413
        connection.close()
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.mark.skipif(sys.platform == "win32", reason="consoles there send other signals")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_ends_cleanly(face: Path, tmp_path: Path, name: str) -> None:
    program = f"""
import pathlib, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # as in a terminal: a job in the background ignores it
from facepipe.cli import main
from facepipe_web import build
build.DIST = pathlib.Path({str(build.DIST)!r})
sys.exit(main(["view", "face.usda", "--no-browser"]))
"""
    files = tmp_path / "temporary"
    files.mkdir()
    environment = os.environ | {"TMPDIR": str(files)}
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )
    assert process.stdout is not None
    assert process.stdout.readline().startswith("http://127.0.0.1:")
    assert any(files.iterdir())
    process.send_signal(getattr(signal, name))
    out, err = process.communicate(timeout=20)
    assert (process.returncode, out, err) == (0, "", "")
    assert not any(files.iterdir())


def test_the_person_of_a_set_face_is_at_rest(page: Path) -> None:
    """What the page loads is what `export` writes, of the person or of the template."""
    slider = Slider(name="open", value=0.5, shapes=(("jawOpen", 1.0),))
    save_parts(replace(tiny_face(), sliders=(slider,)), page / "face.usda")
    for pose, said in (("set", ["at rest: set by sliders open=0.5"]), ("rest", [])):
        with view([page / "face.usda"], Options(pose=pose)) as viewer:
            thread = threading.Thread(target=viewer.serve)
            thread.start()
            port = int(viewer.url.rstrip("/").rpartition(":")[2])
            details = json.loads(get(port, "/faces/0/details.json")[2])
            glb = get(port, "/faces/0/face.glb")[2]
            viewer.close()
            thread.join()
        assert [line for line in details["notes"] if line.startswith("at rest")] == said
        assert exit_code("export", "face.usda", "-o", f"{pose}.glb", "--pose", pose, "--morph-normals") == 0
        assert Path(f"{pose}.glb").read_bytes() == glb
    assert Path("set.glb").read_bytes() != Path("rest.glb").read_bytes()


def raw(port: int, sent: bytes) -> bytes:
    """The start of the answer to what is sent."""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(sent)
        return connection.recv(12)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ("Host: HERE", b"200"),
        ("", b"400"),
        ("Host: HERE\r\nHost: evil.example", b"400"),
        ("Host: evil.example\r\nHost: HERE", b"400"),
        ("Host: HERE\r\nHost: HERE", b"400"),
        ("Host: HERE\r\nOrigin: http://HERE\r\nOrigin: http://evil.example", b"400"),
        ("Host: HERE\r\nTransfer-Encoding: chunked", b"400"),
        ("Host: HERE.", b"403"),
        ("Host: HERE, evil.example", b"403"),
        ("Host: HERE\r\n evil.example", b"403"),
        ("Host: user@HERE", b"403"),
        ("Host: 127.0.0.1", b"403"),
        ("Host: HERE\r\nX: " + "x" * 70_000, b"431"),
        ("Host: HERE" + f"\r\nX: {'x' * 30_000}" * 3, b"431"),
        ("Host: HERE" + "\r\nX: x" * 200, b"431"),
    ],
)
def test_host_is_one_and_exact_and_headers_are_short(server: int, headers: str, status: bytes) -> None:
    sent = f"GET /viewer.json HTTP/1.1\r\n{headers}".rstrip().replace("HERE", f"127.0.0.1:{server}")
    assert raw(server, sent.encode() + b"\r\n\r\n").split()[1] == status


@pytest.mark.parametrize("length", ["9" * 5000, "-1", "1\r\nContent-Length: 2", "x"])
def test_bodies_of_no_sound_length_are_refused(server: int, length: str) -> None:
    sent = f"POST /blend HTTP/1.1\r\nHost: 127.0.0.1:{server}\r\nContent-Length: {length}\r\n\r\n{{}}"
    assert raw(server, sent.encode()).split()[1] in (b"400", b"404", b"413")


def closed(connection: socket.socket) -> bool:
    try:
        return connection.recv(1) == b""
    except ConnectionError:
        return True


@pytest.mark.parametrize(
    "stalled",
    [
        pytest.param(b"", marks=pytest.mark.slow),
        pytest.param(b"GET / HTTP/1.1\r\nHost: 127", marks=pytest.mark.slow),
        b"POST /do HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n{",
    ],
)
def test_stalled_connections_hold_up_nobody_and_few_threads(face: Path, stalled: bytes) -> None:
    server = Server(0, {"/": face}, {"/do": lambda sent: ("text/plain", sent)})
    thread = threading.Thread(target=server.serve_forever)
    before = threading.active_count()
    thread.start()
    connections = []
    try:
        for _ in range(200):
            connections.append(socket.create_connection(("127.0.0.1", server.server_port), timeout=10))
            connections[-1].sendall(stalled.replace(b"PORT", str(server.server_port).encode()))
        assert get(server.server_port, "/")[0] == 200
        for one in connections[:100]:
            assert closed(one)  # the oldest made room
        deadline = time.monotonic() + 60
        while threading.active_count() - before > 1 + MOST_CONNECTIONS and time.monotonic() < deadline:
            time.sleep(0.02)
        assert threading.active_count() - before <= 1 + MOST_CONNECTIONS
    finally:
        server.shutdown()
        thread.join()
        for one in connections:
            one.close()
        server.server_close()


def ends(connection: socket.socket) -> bool:
    """Whether a request of a byte at a time is given up; each byte comes well within what a silent one may take."""
    try:
        for _ in range(1000):
            connection.sendall(b"G")
            time.sleep(0.05)
    except OSError:
        return True
    return False


def test_requests_that_never_end_are_given_up(face: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("facepipe_web.viewer.PATIENCE", 0.5)
    server = Server(0, {"/": face}, {})
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        with socket.create_connection(("127.0.0.1", server.server_port), timeout=60) as slow:
            assert ends(slow)
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
