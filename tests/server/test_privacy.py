"""What is gone is nowhere: not in files, in the database and its log, in temporary folders, in lines of logs."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import sqlite3
import time
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faces import tiny_face
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from region_painter import legend_of
from served import Serve, Served, done, ended, kept

from facepipe.stage import open_face

MARK = b"taken in Main Street 12"
_PIECE = 48  # bytes of a file that are looked for


def needles(content: bytes) -> list[bytes]:
    """Pieces of a file."""
    return [content[place : place + _PIECE] for place in range(0, max(1, len(content) - _PIECE), 97)]


def found(served: Served, *needles: bytes) -> list[str]:
    """Where one of some pieces is, of all that a server has written."""
    files = [Path(folder, name) for folder, _, names in os.walk(served.folder) for name in names]
    places = []
    for path in (*files, served.log):
        with contextlib.suppress(FileNotFoundError):  # some go while they are looked at
            content = path.read_bytes()
            if any(one in content for one in needles):
                places.append(path.name)
    return places


@pytest.fixture
def photo(tmp_path: Path) -> bytes:
    """A picture that says where it was taken; red and green, so that it is a map of regions too."""
    pixels = np.zeros((64, 64, 3), np.uint8)
    pixels[:, :32, 0] = pixels[:, 32:, 1] = 255
    said = PngInfo()
    said.add_text("Comment", MARK.decode())
    said.add_text("Noise", secrets.token_hex(2000))
    file = BytesIO()
    Image.fromarray(pixels).save(file, "PNG", pnginfo=said)
    return file.getvalue()


def sent_photo(served: Served, photo: bytes) -> str:
    """The id of a photo that was sent with consent."""
    answer = served.client.post("/api/v1/photos", content=photo, headers={"X-Facepipe-Consent": "2026-11"})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["artefact"])


def regions_of(served: Served, face: str, photo: str, regions: tuple[str, str]) -> dict[str, Any]:
    """A job that uses a photo."""
    answer = served.client.post(
        "/api/v1/files", params={"suffix": ".json"}, content=json.dumps(legend_of(list(regions))).encode()
    )
    fields = {"face": {"face": face}, "map": photo, "legend": answer.json()["artefact"]}
    return ended(
        served.client,
        served.client.post("/api/v1/jobs", json={"action": "regions", "fields": fields, "face": face}).json()["id"],
    )


@pytest.mark.parametrize("outcome", ["done", "failed"])
def test_after_a_job_its_photo_is_nowhere(outcome: str, serve: Serve, heads: list[Path], photo: bytes) -> None:
    served = serve("--processes", "1")
    face, sent = kept(served.client, heads[0]), sent_photo(served, photo)
    assert found(served, MARK) == ["photo.png"]
    regions = ("left", "right") if outcome == "done" else ("not a name", "right")
    job = regions_of(served, face, sent, regions)
    assert job["state"] == outcome, job
    _until(lambda: not found(served, MARK, *needles(photo)))
    again = served.client.post(
        "/api/v1/jobs", json={"action": "regions", "fields": {"face": {"face": face}, "map": sent}}
    )
    assert again.status_code in (400, 404)
    with sqlite3.connect(served.folder / "serve.db") as rows:
        ((text, created),) = rows.execute("select text_version, created from consents")
    assert text == "2026-11"
    assert abs(time.time() - created) < 600


def test_a_photo_that_is_kept_on_purpose_stays(serve: Serve, heads: list[Path], photo: bytes) -> None:
    served = serve("--processes", "1", "--retain")
    face, sent = kept(served.client, heads[0]), sent_photo(served, photo)
    assert regions_of(served, face, sent, ("left", "right"))["state"] == "done"
    assert found(served, MARK) == ["photo.png"]


@pytest.mark.parametrize("retain", [(), ("--retain",)])
def test_a_photo_that_is_not_used_after_all_is_deleted_at_once(
    retain: tuple[str, ...], serve: Serve, heads: list[Path], photo: bytes
) -> None:
    """Only by whom it is of, and not under a job that waits for it."""
    served = serve("--processes", "1", *retain)
    client, sent = served.client, sent_photo(served, photo)
    assert client.get(f"/api/v1/photos/{sent}/landmarks").status_code != 404
    assert client.delete(f"/api/v1/photos/{sent}").status_code == 204
    assert found(served, MARK, *needles(photo)) == []
    assert client.delete(f"/api/v1/photos/{sent}").status_code == 404
    file = client.post("/api/v1/files", params={"suffix": ".json"}, content=b"{}").json()["artefact"]
    assert client.delete(f"/api/v1/photos/{file}").status_code == 404  # a job may have it next
    face, other = kept(client, heads[0]), kept(client, heads[1])
    busy = [client.post("/api/v1/jobs", json=_blend(face, other)).json()["id"] for _ in range(3)]
    again = sent_photo(served, photo)
    fields = {"face": {"face": face}, "map": again, "legend": file}
    job = client.post("/api/v1/jobs", json={"action": "regions", "fields": fields, "face": face}).json()["id"]
    refused = client.delete(f"/api/v1/photos/{again}")
    assert refused.status_code == 409, refused.text
    for one in (*busy, job):
        client.delete(f"/api/v1/jobs/{one}")
    assert ended(client, job)["state"] in ("cancelled", "failed")


def test_no_consent_no_photo(served_once: Served, photo: bytes) -> None:
    assert served_once.client.post("/api/v1/photos", content=photo).status_code == 422
    answer = served_once.client.post("/api/v1/photos", content=b"no photo", headers={"X-Facepipe-Consent": "1"})
    assert answer.status_code == 400
    assert list((served_once.folder / "uploads").glob("*/photo*")) == []


@pytest.fixture
def served_once(serve: Serve) -> Served:
    """A server of a test's own."""
    return serve("--processes", "1")


def test_after_a_deletion_the_face_is_nowhere(served_once: Served, heads: list[Path]) -> None:
    served, client = served_once, served_once.client
    other, face = kept(client, heads[1], "Somebody else"), kept(client, heads[0], "Margarethe Unverwechselbar")
    url = f"/api/v1/faces/{face}/versions/1"
    made = [client.get(f"{url}/{name}").content for name in ("face.usdc", "face.glb", "thumbnail.png", "face.onnx")]
    points = tiny_face(0).meshes[0].points
    person = np.asarray(points + tiny_face(0).meshes[0].blendshapes[1].offsets, np.float16).tobytes()
    pieces = [piece for content in made for piece in needles(content) if len(set(piece)) > 24]
    assert found(served, *pieces)
    assert found(served, b"Margarethe")
    waiting = [client.post("/api/v1/jobs", json=_blend(face, other)).json()["id"] for _ in range(3)]
    gone = client.delete(f"/api/v1/faces/{face}", params={"dependents": "keep"})
    assert gone.status_code == 204
    states = [ended(client, job)["state"] for job in waiting if client.get(f"/api/v1/jobs/{job}").status_code == 200]
    assert set(states) <= {"cancelled", "done"}
    for one in client.get("/api/v1/faces").json()["faces"]:
        if one["id"] != other:  # a mix that was done before
            client.delete(f"/api/v1/faces/{one['id']}")
    kept_still = client.get(f"/api/v1/faces/{other}/versions/1/face.usdc").content
    own = [one for one in pieces if one not in kept_still]
    _until(lambda: not found(served, b"Margarethe", person[:_PIECE], *own))


def _blend(first: str, second: str) -> dict[str, Any]:
    return {"action": "blend", "fields": {"sources": [{"face": first}, {"face": second}]}}


def test_who_leaves_takes_all_and_had_all_before(served_once: Served, heads: list[Path], tmp_path: Path) -> None:
    served, client = served_once, served_once.client
    face = kept(client, heads[0], "Margarethe Unverwechselbar")
    done(client, "blend", {"sources": [{"face": face}, {"face": kept(client, heads[1])}]})
    with zipfile.ZipFile(BytesIO(client.get("/api/v1/me/export").content)) as export:
        rows = json.loads(export.read("rows.json"))
        assert sorted(rows) == ["consents", "faces", "files", "jobs", "versions"]
        assert len(rows["faces"]) == len(rows["versions"]) == len(rows["jobs"]) == 3
        export.extractall(tmp_path / "export")
    assert open_face(tmp_path / "export" / "faces" / face / "1" / "face.usdc").shapes
    assert client.delete("/api/v1/me").status_code == 204
    assert client.get("/api/v1/faces").json()["faces"] == client.get("/api/v1/jobs").json()["jobs"] == []
    assert client.get("/api/v1/me").json()["used"] == 0
    assert not [path for path in (served.folder / "artefacts").rglob("*") if path.is_file()]
    assert found(served, b"Margarethe", face.encode()) == []
    assert kept(client, heads[0])  # who comes back begins anew


def _until(holds: Any) -> None:
    until = time.monotonic() + 30
    while not holds():
        assert time.monotonic() < until
        time.sleep(0.2)
