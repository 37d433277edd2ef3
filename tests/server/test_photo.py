"""A photo goes up and a person comes down; of the photo nothing stays, nor where its landmarks are."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path

import numpy as np
import pytest
from import_data import shared
from PIL import Image
from served import Serve, ended
from test_privacy import found, needles

pytestmark = [pytest.mark.needs_torch, pytest.mark.slow, pytest.mark.gate]


def test_landmarks_are_found_moved_and_fitted_and_are_nowhere_then(serve: Serve) -> None:
    """They are those of a detector of others; events show the fit over the photo."""
    served, file = serve("--processes", "1"), shared("photos/astronaut.png")
    photo, client = file.read_bytes(), served.client
    sent = client.post("/api/v1/photos", content=photo, headers={"X-Facepipe-Consent": "1"}).json()["artefact"]
    answer = client.get(f"/api/v1/photos/{sent}/landmarks")
    assert answer.status_code == 200, answer.text
    marks = answer.json()
    known = json.loads(file.with_name("astronaut.landmarks.json").read_text())
    off = np.linalg.norm(np.array(marks["multipie68"]) - np.array(known["multipie68"])[:, :2], axis=1)
    assert off[17:].mean() < 4.0, "pixels, of a face with 60 between the eyes"
    assert client.get(f"/api/v1/photos/{'0' * 24}/landmarks").status_code == 404
    marks["multipie68"][30][0] += 1.0
    moved = client.post("/api/v1/files", params={"suffix": ".json"}, content=json.dumps(marks).encode())
    fields = {"photos": [sent], "landmarks": [moved.json()["artefact"]], "iterations": 8, "size": 64}
    asked = client.post("/api/v1/jobs", json={"action": "fit-photo", "fields": fields, "name": "Eileen"})
    assert asked.status_code == 202, asked.text
    with client.stream("GET", f"/api/v1/jobs/{asked.json()['id']}/events") as events:
        told = [json.loads(line[5:]) for line in events.iter_lines() if line.startswith("data:")]
    pictures = [one["progress"]["picture"] for one in told if one["progress"] and one["progress"].get("picture")]
    with Image.open(io.BytesIO(base64.b64decode(pictures[-1]))) as picture:
        assert 32 <= min(picture.size) <= 128
    job = ended(client, asked.json()["id"])
    assert job["state"] == "done", job
    person = client.get(f"/api/v1/faces/{job['face']}/versions/1/face.fpb")
    assert 100 < len(person.content) < 5000
    assert found(served, *needles(photo)[:2000]) == []
    assert found(served, *[repr(one).encode() for point in marks["multipie68"] for one in point]) == []
    ends = [piece for one in pictures for piece in (one[-96:-8].encode(), base64.b64decode(one)[-64:-8])]
    assert found(served, *ends) == []
    assert [path for path in Path(served.folder / "uploads").rglob("*") if path.is_file()] == []
