"""Persons on the head in the browser: points are those that `facepipe apply-bones` gives."""

from __future__ import annotations

import runpy
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import browser
import numpy as np
import pytest
from browser import DRAWN, READY, Step, browse, run, until
from faces import tiny_face
from import_data import shared
from places import REPOSITORY
from rebuilt_people import with_rig

import facepipe
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.heads import make
from facepipe.parts import Slider
from facepipe.payload import PayloadContent, encode
from facepipe.rig import rest_coefficients
from facepipe.stage import Face, save_parts
from facepipe.verbs.person_basis import head_basis
from facepipe.verbs.person_layers import encode_points
from facepipe.verbs.whole_faces import whole_points

pytestmark = pytest.mark.slow

FACES = ("Head", "Teeth", "EyeballLeft")
HELD = ("Brows", "Lashes", "Hair")


@pytest.fixture(scope="module")
def me(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Somebody beyond the modes."""
    points = whole_points(make(3))[: len(head_basis().mean)]
    points += 3 * np.sin(points[:, [1, 2, 0]] / 25 + [0.3, 0.8, 0.3])
    path = tmp_path_factory.mktemp("me") / "me.fpb"
    path.write_bytes(encode_points(head_basis(), points, within=1.0)[0])
    return path


def read(*meshes: str) -> Step:
    """The points of meshes, metres."""
    return run(f"return {list(meshes)}.flatMap((mesh) => Array.from(face.points(mesh)))")


def points_of(face: Face, meshes: tuple[str, ...], values: np.ndarray) -> np.ndarray:
    """Those of meshes among the points of a face in centimetres, in metres."""
    parts = face.parts()
    ends = np.cumsum([len(mesh.points) for mesh in parts.meshes])
    rows = {mesh.name: np.arange(end - len(mesh.points), end) for mesh, end in zip(parts.meshes, ends, strict=True)}
    return 0.01 * values[np.concatenate([rows[name] for name in meshes])]


@pytest.mark.gate
@pytest.mark.parametrize("rig", [False, True])
def test_the_viewers_head_becomes_a_person(me: Path, tmp_path: Path, rig: bool) -> None:
    """Points are those of `facepipe apply-bones`, moved by shapes, lids too, joints, sliders; off, the head is back."""
    if rig:
        (tmp_path / "me.fpb").write_bytes(with_rig(me.read_bytes()))
        me = tmp_path / "me.fpb"
    head, clip = tmp_path / "head.usdc", tmp_path / "clip.fpb"
    parts = make(0)
    joints = parts.skeleton.joints
    jaw = next(i for i, path in enumerate(joints) if path.endswith("jaw"))
    turn = Slider(name="turn", channels=((joints[jaw], "rx", 0.3), (joints[1], "ry", 0.2)))
    save_parts(replace(parts, sliders=(*parts.sliders, turn)), head)
    poses = rest_coefficients(len(joints))
    poses[jaw, 3], poses[1, 4] = 0.3, 0.2
    content = PayloadContent(joints=joints, coefficients=poses, meters_per_unit=parts.meters_per_unit)
    clip.write_bytes(encode(content).data)
    said = 'document.querySelector("section[aria-label=Payload] p").textContent.startsWith("{}")'
    off = run('[...document.querySelectorAll("button")].find((one) => one.textContent === "Take off").click()')
    seen = read(*FACES)
    steps: list[Step] = [
        READY,
        seen,
        {"upload": ["#payload", str(me)]},
        until(said.format("me.fpb: a person in")),
        seen,
    ]
    steps += [run("await face.setSliders({ turn: 1 })"), seen, run("await face.setSliders({ turn: 0 })")]
    steps += [
        {"upload": ["#payload", str(clip)]},
        until(said.format("clip.fpb")),
        run("await face.setShapes({ jawOpen: 0.5, eyeBlinkLeft: 0.6, eyeLookUpRight: 1 })"),
        seen,
    ]
    with browser.viewing(head) as url:
        results, problems = browse(url, *steps, run("await face.reset()"), off, DRAWN, seen)
    assert problems == []
    before, still, slid, posed, after = (np.reshape(one, (-1, 3)) for one in results if one and len(one) > 9)
    facepipe.apply_bones(head, me, out=tmp_path / "me.usdc")
    person = facepipe.open(tmp_path / "me.usdc")
    assert np.abs(still - points_of(person, FACES, person.evaluate())).max() < 1e-6
    for found, values in (
        (slid, person.evaluate(sliders={"turn": 1.0})),
        (posed, person.evaluate({"jawOpen": 0.5, "eyeBlinkLeft": 0.6, "eyeLookUpRight": 1.0}, coefficients=poses)),
    ):
        assert np.abs(found - points_of(person, FACES, values)).max() < 1e-7 * person.head_height
        assert np.abs(found - still).max() > 0.01
    np.testing.assert_array_equal(before, after)


def test_payloads_of_others_are_refused(me: Path, tmp_path: Path) -> None:
    """Damaged, of another basis, and on a face without the basis's meshes: a line each, and the face stays."""
    data = bytearray(me.read_bytes())
    for name, place in (("damaged", 40), ("other", 12)):
        broken = data[:place] + bytes([data[place] ^ 1]) + data[place + 1 : -4]
        sealed = struct.pack("<I", zlib.crc32(broken)) if name == "other" else bytes(data[-4:])
        (tmp_path / f"{name}.fpb").write_bytes(broken + sealed)
    save_parts(tiny_face(), tmp_path / "tiny.usda")
    save_parts(make(0), tmp_path / "head.usdc")
    seen, texts = read("Head"), {"run": 'document.querySelector(".messages")?.textContent ?? ""'}
    uploads = [{"upload": ["#payload", str(tmp_path / f"{name}.fpb")]} for name in ("damaged", "other")]
    said = until(f'document.querySelectorAll(".message").length === {len(uploads)}')
    with browser.viewing(tmp_path / "head.usdc") as url:
        results, problems = browse(url, READY, seen, *uploads, said, texts, seen)
    assert problems == []
    assert "damaged.fpb: is damaged: its CRC differs" in results[-2]
    assert "other.fpb: a person on another basis" in results[-2]
    assert results[1] == results[-1]
    with browser.viewing(tmp_path / "tiny.usda") as url:
        results, problems = browse(url, READY, {"upload": ["#payload", str(me)]}, {"wait": ".message"}, texts)
    assert "mesh Head has 36 points, expected the 14062 of the built-in head" in results[-1]


def test_pictures_of_a_person_are_seen(tmp_path: Path) -> None:
    """Those of the payload, and after it those of the file; a damaged one is refused in a line."""
    save_parts(make(0, textures=64), tmp_path / "head.usdc")
    save_parts(make(3, textures=64), tmp_path / "anna.usdc")
    facepipe.person(tmp_path / "anna.usdc", out=tmp_path / "me.fpb", look=True, textures=32)
    data = (tmp_path / "me.fpb").read_bytes()
    broken = data[:-4].replace(b"WEBP", b"WEBX")
    (tmp_path / "bad.fpb").write_bytes(broken + struct.pack("<I", zlib.crc32(broken)))
    sizes = run("return face.meshes[0].primitives.map(({ material: { map } }) => map.image.width)")
    said = "document.querySelector('section[aria-label=Payload] p').textContent"
    off = run('[...document.querySelectorAll("button")].find((one) => one.textContent === "Take off").click()')
    back = until("face.meshes[0].primitives[0].material.map.image.width === 64")
    steps = [READY, sizes, {"upload": ["#payload", str(tmp_path / "me.fpb")]}, until(f"{said}.startsWith('me.fpb')")]
    with browser.viewing(tmp_path / "head.usdc") as url:
        bad: list[Step] = [{"upload": ["#payload", str(tmp_path / "bad.fpb")]}, {"wait": ".message"}]
        message = {"run": "document.querySelector('.message').innerText"}
        results, problems = browse(url, *steps, sizes, off, back, sizes, *bad, message)
    assert problems == []
    assert (results[1], results[4], results[7]) == ([64, 64], [32, 32], [64, 64])
    assert "no picture that the browser reads" in results[-1]


def shown(folder: Path, payload: Path) -> None:
    """The page of samples/device: of a payload or a photo, in a phone's window; its person is that of `apply-bones`."""
    browser.chromium()
    names = runpy.run_path(str(REPOSITORY / "samples" / "device" / "make_page.py"))
    assert names["main"]([str(payload), str(folder)]) == 0
    meshes = (*FACES, *HELD)
    seen = {"run": f"{list(meshes)}.flatMap((mesh) => Array.from(face.points(mesh)))"}
    said = {"run": "document.getElementById('said').textContent"}
    vertices = """face.meshes[0].primitives.flatMap(({ geometry: { attributes } }) => {
      const [points, normals] = [attributes._facepipe_point.array, attributes.normal.array];
      return Array.from(points, (point, i) => [point, ...normals.slice(3 * i, 3 * i + 3)]);
    })"""
    with browser.serving(folder) as url:
        steps = [READY, said, seen, {"click": "#head"}, DRAWN, seen, {"click": "#person"}, DRAWN, seen]
        steps += [{"run": vertices}]
        results, problems = browse(url, *steps, phone=True)
    assert problems == []
    assert results[1].startswith(f"A person in {(folder / 'me.fpb').stat().st_size} bytes, put on in ")
    head = facepipe.open(folder / "head.usdc")
    facepipe.apply_bones(folder / "head.usdc", folder / "me.fpb", out=folder / "me.usdc")
    person = facepipe.open(folder / "me.usdc")
    for found, face in zip(results[2:9:3], (person, head, person), strict=True):
        off = np.abs(np.reshape(found, (-1, 3)) - points_of(face, meshes, face.evaluate()))
        assert off.max() < 1e-6
    skin, own = person.parts().meshes[0], np.array(results[-1])
    triangles = point_triangles(skin.face_vertex_counts, skin.face_vertex_indices)
    normals = point_normals(skin.points, triangles)[own[:, 0].astype(int)]
    assert np.linalg.norm(own[:, 1:] - normals, axis=1).max() < 1e-3


@pytest.mark.gate
def test_the_page_of_a_payload(me: Path, tmp_path: Path) -> None:
    shown(tmp_path / "page", me)
    assert (tmp_path / "page" / "me.fpb").read_bytes() == me.read_bytes()


@pytest.mark.needs_torch
def test_the_page_of_a_selfie(tmp_path: Path) -> None:
    """The whole way: a photo of a camera, 271 bytes, the person in the browser."""
    shown(tmp_path / "page", shared("photos/astronaut.png"))
    assert (tmp_path / "page" / "me.fpb").stat().st_size < 300
