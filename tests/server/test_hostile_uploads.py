"""Files that lead out of their folder, run code or never end, sent to a server: none does, each is said in a line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bombs
import httpx
import pytest
from full_faces import full_face
from hostile_folders import World, fbx, gltf, make_stock, noise, obj, over, pixels_of, textured
from served import Served, ended
from small_sources import made

TEXTURE = "{top}/private/photo.png"
LAYERS = """(
    subLayers = [@{top}/private/secret.usda@, @../../../serve.db@]
)
def SkelRoot "A" (references = @/etc/passwd@) {}"""
CASES: dict[str, tuple[Any, tuple[str, ...]]] = {
    "texture of a stage": (textured(TEXTURE), ("face.usda",)),
    "texture above": (textured("../../private/photo.png"), ("face.usda",)),
    "texture at a URL": (textured("http://127.0.0.1:1/photo.png"), ("face.usda",)),
    "layers elsewhere": (over(LAYERS), ("face.usda",)),
    "buffer elsewhere": (gltf(buffer="{top}/private/points.bin"), ("face.gltf", "own.bin")),
    "buffer at a URL": (gltf(buffer="file://{top}/private/points.bin"), ("face.gltf", "own.bin")),
    "image elsewhere": (gltf(image=TEXTURE), ("face.gltf", "own.bin")),
    "image above": (gltf(image="../../../../private/photo.png"), ("face.gltf", "own.bin")),
    "library elsewhere": (obj("/etc/passwd"), ("shapes/neutral.obj", "shapes/face.mtl")),
    "texture of a library": (obj("face.mtl", TEXTURE), ("shapes/neutral.obj", "shapes/face.mtl")),
    "picture of an FBX": (fbx(TEXTURE), ("face.fbx",)),
}
BOMBS = ("buffers of one file", "instances", "targets")


@pytest.fixture(scope="module")
def stock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Good files."""
    folder = tmp_path_factory.mktemp("stock") / "sent"
    folder.mkdir()
    make_stock(folder, full_face(), (made(0), made(1)))
    return folder


def taken(client: httpx.Client, folder: Path, names: tuple[str, ...]) -> dict[str, Any]:
    """The job that takes files in, once it has ended."""
    parts = [("files", (name, (folder / name).read_bytes())) for name in names]
    answer = client.post("/api/v1/faces", files=parts)
    assert answer.status_code == 202, answer.text
    return ended(client, answer.json()["job"]["id"])


@pytest.mark.parametrize("case", CASES)
def test_nothing_of_the_machine_comes_into_a_face(
    case: str, shared_server: Served, stock: Path, tmp_path: Path
) -> None:
    client, world = shared_server.client, World(tmp_path)
    world.settle(stock)
    make, names = CASES[case]
    make(world)
    before = world.outside()
    job = taken(client, world.sent, names)
    assert world.outside() == before
    assert not world.ran.exists()
    if job["state"] == "failed":
        assert job["error"].isprintable()
        assert job["face"] is None
        return
    secrets = (pixels_of(noise()), b"private: notes", (world.private / "points.bin").read_bytes()[:36], b"root:x:")
    for name in ("face.usdc", "face.usdz", "face.glb"):
        answer = client.get(f"/api/v1/faces/{job['face']}/versions/1/{name}")
        assert answer.status_code in (200, 400)
        assert not any(secret in answer.content for secret in secrets), name


@pytest.mark.parametrize("bomb", BOMBS)
def test_what_grows_as_it_is_read_is_refused_and_the_server_goes_on(
    bomb: str, client: httpx.Client, tmp_path: Path
) -> None:
    bombs.GROUPS["repeated"][bomb][0](tmp_path)
    names = tuple(path.name for path in tmp_path.iterdir())
    job = taken(client, tmp_path, names)
    assert job["state"] == "failed"
    assert bombs.GROUPS["repeated"][bomb][1] in job["error"]
    assert client.get("/health").status_code == 200
