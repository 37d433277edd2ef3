"""Faces of a library: taken in, listed, made into files, changed into new versions, deleted."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from io import BytesIO
from pathlib import Path

import httpx
import numpy as np
import pytest
from faces import tiny_face
from served import done, ended, kept, sent

import facepipe


def files_of(client: httpx.Client, face: str, version: int, *names: str) -> list[bytes]:
    """Files of a version."""
    answers = [client.get(f"/api/v1/faces/{face}/versions/{version}/{name}") for name in names]
    assert [one.status_code for one in answers] == [200] * len(names), [one.text[:200] for one in answers]
    return [one.content for one in answers]


def test_a_face_that_was_sent_is_the_face_that_comes_back(
    client: httpx.Client, heads: list[Path], tmp_path: Path
) -> None:
    face = kept(client, heads[0], "Ada")
    (content,) = files_of(client, face, 1, "face.usdc")
    (tmp_path / "back.usdc").write_bytes(content)
    before, after = (facepipe.open(path) for path in (heads[0], tmp_path / "back.usdc"))
    np.testing.assert_allclose(before.evaluate({"jawOpen": 0.7}), after.evaluate({"jawOpen": 0.7}), atol=1e-6)
    told = client.get(f"/api/v1/faces/{face}").json()
    assert (told["name"], told["version"], told["versions"][0]["made_by"]) == ("Ada", 1, "upload")
    assert told["versions"][0]["bytes"] >= len(content)


def test_files_of_a_version_are_those_of_their_formats_and_stay_the_same(
    client: httpx.Client, heads: list[Path]
) -> None:
    face = kept(client, heads[1])
    names = ("face.glb", "thumbnail.png", "details.json", "recipe.json", "face.onnx", "regions.bin")
    glb, picture, details, recipe, onnx, regions = files_of(client, face, 1, *names)
    assert (glb[:4], picture[:4], json.loads(recipe)) == (b"glTF", b"\x89PNG", None)
    said, parts = json.loads(details), tiny_face(1)
    assert [one["points"] for one in said["meshes"]] == [len(mesh.points) for mesh in parts.meshes]
    assert len(regions) == len(said["regions"]["names"]) * parts.point_count
    assert b"facepipe" in onnx
    assert files_of(client, face, 1, *names) == [glb, picture, details, recipe, onnx, regions]
    tag = client.get(f"/api/v1/faces/{face}/versions/1/face.glb").headers["etag"]
    again = client.get(f"/api/v1/faces/{face}/versions/1/face.glb", headers={"If-None-Match": tag})
    assert (again.status_code, again.content) == (304, b"")
    assert client.get(f"/api/v1/faces/{face}/versions/1/sliders.onnx").status_code == 404  # it has none
    assert client.get(f"/api/v1/faces/{face}/versions/2/face.glb").status_code == 404


def test_files_are_of_the_types_that_the_api_names(client: httpx.Client, heads: list[Path]) -> None:
    url = f"/api/v1/faces/{kept(client, heads[1])}/versions/1"
    paths = client.get("/api/v1/openapi.json").json()["paths"]
    named = paths["/api/v1/faces/{face}/versions/{number}/{what}"]["get"]["responses"]["200"]["content"]
    for name in ("face.glb", "thumbnail.png", "details.json", "face.usdc", "face.usdz", "regions.bin"):
        answer = client.get(f"{url}/{name}")
        assert answer.status_code == 200
        assert answer.headers["content-type"] in named, name


def test_a_blend_cooks_to_the_same_bytes_from_the_export(
    client: httpx.Client, heads: list[Path], tmp_path: Path
) -> None:
    first, second = (kept(client, head) for head in heads[:2])
    fields = {"sources": [{"face": first}, {"face": second, "version": 1}]}
    job = done(client, "blend", fields, name="Both")
    told = client.get(f"/api/v1/faces/{job['face']}").json()
    assert told["versions"][0]["sources"] == [{"face": one, "version": 1} for one in sorted((first, second))]
    with zipfile.ZipFile(BytesIO(client.get("/api/v1/me/export").content)) as export:
        export.extractall(tmp_path)
    stage = tmp_path / "faces" / job["face"] / "1" / "face.usdc"
    before = stage.read_bytes()
    line = [sys.executable, "-m", "facepipe", "cook", stage, "--force", "--root", tmp_path]
    cooked = subprocess.run(line, capture_output=True, check=False)
    assert cooked.returncode == 0, cooked.stderr
    assert stage.read_bytes() == before
    (recipe,) = files_of(client, job["face"], 1, "recipe.json")
    assert json.loads(recipe)["verb"] == "blend"


def test_of_two_who_save_over_one_version_both_are_kept_and_the_later_is_told(
    client: httpx.Client, heads: list[Path]
) -> None:
    face, other = (kept(client, head) for head in heads[:2])
    fields = {"sources": [{"face": face, "version": 1}, {"face": other}]}
    for _ in range(2):
        asked = {"from": 1, "action": "blend", "fields": fields}
        answer = client.post(f"/api/v1/faces/{face}/versions", json=asked)
        assert answer.status_code == 202, answer.text
        assert ended(client, answer.json()["job"]["id"])["state"] == "done"
    versions = client.get(f"/api/v1/faces/{face}").json()["versions"]
    assert [(one["number"], one["conflict_of"]) for one in versions] == [(1, None), (2, None), (3, 2)]


def test_a_face_that_others_are_made_of_is_deleted_only_knowingly(client: httpx.Client, heads: list[Path]) -> None:
    first, second = (kept(client, head) for head in heads[:2])
    blend = done(client, "blend", {"sources": [{"face": first}, {"face": second}]})["face"]
    refused = client.delete(f"/api/v1/faces/{first}")
    assert (refused.status_code, refused.json()["dependents"]) == (409, [blend])
    assert client.delete(f"/api/v1/faces/{first}", params={"dependents": "keep"}).status_code == 204
    assert client.get(f"/api/v1/faces/{first}").status_code == 404
    assert files_of(client, blend, 1, "face.glb")[0][:4] == b"glTF"  # it stands alone
    assert client.delete(f"/api/v1/faces/{blend}").status_code == 204
    assert client.delete(f"/api/v1/faces/{second}").status_code == 204


def test_faces_are_found_by_their_names_page_after_page(client: httpx.Client, heads: list[Path]) -> None:
    made = [kept(client, heads[0], f"100% Zoe_{number}") for number in range(2)]
    found = client.get("/api/v1/faces", params={"search": "100% zoe_"}).json()
    assert [one["id"] for one in found["faces"]] == made[::-1]
    assert client.get("/api/v1/faces", params={"search": "Zoe%0"}).json()["faces"] == []
    after = client.get("/api/v1/faces", params={"search": "100%", "after": made[1]}).json()
    assert [one["id"] for one in after["faces"]] == made[:1]
    renamed = client.patch(f"/api/v1/faces/{made[0]}", json={"name": "Zoë"}).json()
    assert renamed["name"] == "Zoë"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("head.usdc", b"PXR-USDC" + bytes(100)),
        ("head.glb", b"glTF" + bytes(20)),
        ("head.fbx", b"Kaydara FBX Binary  \0" + bytes(60)),
        ("head.obj", b"f 1 2 3\n"),
        ("head.usdz", b"PK\x03\x04" + bytes(60)),
    ],
)
def test_a_file_that_is_not_what_it_says_fails_in_one_line(client: httpx.Client, name: str, content: bytes) -> None:
    answer = client.post("/api/v1/faces", files=[("files", (name, content))])
    assert answer.status_code == 202
    job = ended(client, answer.json()["job"]["id"])
    assert (job["state"], job["face"]) == ("failed", None)
    assert job["error"]
    assert "\n" not in job["error"]
    assert "/work/" not in job["error"]


@pytest.mark.parametrize("name", ["../head.usdc", "/etc/head.usdc", "a/../../head.usdc", ".hidden.usdc"])
def test_names_that_lead_elsewhere_are_refused(client: httpx.Client, name: str) -> None:
    answer = client.post("/api/v1/faces", files=[("files", (name, b"#usda 1.0\n"))])
    assert answer.status_code == 400
    assert "name" in answer.json()["error"]


def test_what_is_no_face_is_refused_before_any_job(client: httpx.Client, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("x")
    assert sent(client, tmp_path / "notes.txt").status_code == 400
    assert client.post("/api/v1/faces", content=b"x", headers={"Content-Type": "text/plain"}).status_code == 400
    cut = b'--b\r\nContent-Disposition: form-data; name="files"; filename="a.obj"\r\n\r\nv 0 0'
    head = {"Content-Type": "multipart/form-data; boundary=b"}
    assert client.post("/api/v1/faces", content=cut, headers=head).status_code == 400
