"""A blend whose weights are moved: the same face as `facepipe blend` makes."""

from __future__ import annotations

import http.client
import json
import threading
from pathlib import Path

import numpy as np
import pytest
from command_line import done
from facepipe_web.viewer import Blending, Server, blending_of
from faces import tiny_face
from small_sources import WORDS

import facepipe
from facepipe.core.errors import InputError
from facepipe.hosting.live_blend import LiveBlend
from facepipe.rig import build
from facepipe.stage import save_parts

Capsys = pytest.CaptureFixture[str]
ROWS = {"default": [0.5, 0.5], "mouth": [0.1, 0.9], "neck": [1.0, 0.0]}
SETS = ("--default", "0.5,0.5", "--set", "mouth=0.1,0.9", "--set", "neck=1,0")


@pytest.fixture
def child(folder: Path, capsys: Capsys) -> Path:
    """A blend of a.usda and b.usda, in the working folder."""
    done(capsys, "blend", "a.usda", "b.usda", *WORDS, "-o", "child.usda")
    return Path("child.usda")


def live_of(path: Path) -> LiveBlend:
    live = LiveBlend.from_stage(path)
    assert live is not None
    return live


def test_begins_with_the_recipe(child: Path) -> None:
    live = live_of(child)
    assert [source.name for source in live.sources] == ["a.usda", "b.usda"]
    assert live.rows == {"default": [0.5, 0.5], "mouth": [0.75, 0.25]}
    assert live.regions == ("mouth", "neck")
    found = build(live.face(live.rows)).evaluate()
    assert np.abs(found - facepipe.open(child).evaluate()).max() < 1e-6


def test_moved_weights_are_those_of_the_command(child: Path, capsys: Capsys) -> None:
    """The whole face, and its points alone; also when they are moved back and forth."""
    done(capsys, "blend", "a.usda", "b.usda", *SETS, "-o", "other_weights.usda")
    expected, live = facepipe.open("other_weights.usda"), live_of(child)
    live.points(live.rows, np.eye(4))
    parts = live.face(ROWS)
    rng = np.random.default_rng(0)
    for weights in ({}, {name: float(rng.uniform()) for name in expected.shapes}):
        assert np.abs(build(parts).evaluate(weights) - expected.evaluate(weights)).max() < 1e-6
    points = np.frombuffer(live.points(ROWS, live.base.gltf_axes), "<f4").reshape(-1, 3)
    assert np.abs(points / live.base.meters_per_unit - expected.evaluate()).max() < 1e-5  # its rest is its bind pose


def test_locked_regions_stay(child: Path, capsys: Capsys) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "--lock", "mouth=2", "-o", "locked.usda")
    live = live_of(Path("locked.usda"))
    axes = np.eye(4)
    assert live.points({**ROWS, "mouth": [1.0, 0.0]}, axes) == live.points({**ROWS, "mouth": [0.0, 1.0]}, axes)
    assert live.points({**ROWS, "neck": [0.0, 1.0]}, axes) != live.points(ROWS, axes)


def test_other_faces_have_no_blend(tmp_path: Path) -> None:
    save_parts(tiny_face(), tmp_path / "face.usda")
    assert LiveBlend.from_stage(tmp_path / "face.usda") is None


def test_a_source_that_is_gone(child: Path) -> None:
    Path("b.usda").unlink()
    with pytest.raises(InputError, match=r"b\.usda"):
        LiveBlend.from_stage(child)


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        (b"[]", "blend: no request"),
        (b"{", "blend: no request"),
        (b'{"weights": 3, "wanted": "points"}', "blend: no request"),
        (b'{"weights": {"mouth": [1]}, "wanted": "points"}', "weights -> mouth: 1 weights, expected 2"),
        (b'{"weights": {"mouth": [0, 0]}, "wanted": "face"}', "weights -> mouth: no weight above 0"),
        (b'{"weights": {"beard": [0, 1]}, "wanted": "face"}', "weights -> beard: no such region"),
        (b'{"weights": {"mouth": [NaN, 1]}, "wanted": "points"}', "weights -> regions -> mouth -> 0: nan"),
        (b'{"weights": {}, "wanted": "more"}', "blend: expected points or face"),
    ],
)
def test_requests_that_make_no_sense(child: Path, tmp_path: Path, sent: bytes, said: str) -> None:
    blending = Blending(child, live_of(child), tmp_path, Server(0, {}, {}))
    with pytest.raises(InputError) as raised:
        blending.answer(sent)
    assert str(raised.value).startswith(said)
    blending._server.server_close()


def test_versions_of_the_face_come_and_go(child: Path, tmp_path: Path) -> None:
    """Over the server: the newest are there, older ones are gone from it and from disk."""
    server = Server(0, {}, {})
    blending = blending_of(child, tmp_path / "made", server)
    assert blending is not None
    server.actions["/blend"] = blending.answer
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        entries = [json.loads(post(server.server_port, mouth)) for mouth in (0.2, 0.4, 0.6, 0.8)]
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
    there = [f"/{entry['glb']}" in server.files for entry in entries]
    assert there == [False, False, True, True]
    assert len(list((tmp_path / "made").iterdir())) == 2
    assert server.files[f"/{entries[-1]['glb']}"].read_bytes() != server.files[f"/{entries[-2]['glb']}"].read_bytes()


def post(port: int, mouth: float) -> bytes:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    body = json.dumps({"weights": ROWS | {"mouth": [mouth, 1 - mouth]}, "wanted": "face"})
    connection.request("POST", "/blend", body, {"Content-Type": "application/json"})
    answer = connection.getresponse()
    content = answer.read()
    assert answer.status == 200, content
    connection.close()
    return content
