"""Persons rebuilt by the runtime's JavaScript, in node: the points and joints of Python, and the same files refused."""

from __future__ import annotations

import json
import struct
import subprocess
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import browser
import numpy as np
import pytest
from browser import DRAWN, READY, browse, run, until
from faces import tiny_face
from node import HERE
from places import REPOSITORY

import facepipe
from facepipe.core.errors import InputError
from facepipe.heads import make
from facepipe.parts import FaceParts, Slider
from facepipe.payload import PayloadContent, encode
from facepipe.payload.basis import basis_body, decode_basis, digest_of, encode_basis
from facepipe.payload.person import PersonContent, decode_person, encode_person
from facepipe.rig import rest_coefficients
from facepipe.stage import save_parts
from facepipe.verbs.person_basis import Basis, head_basis, placed, template_basis
from facepipe.verbs.person_layers import encode_points
from facepipe.verbs.whole_faces import whole_points

pytestmark = [pytest.mark.gate, pytest.mark.slow]

MOVED = np.array([30, -20, 5, 0.2, -0.1, 0.3, 0.1])


def in_node(folder: Path, basis: Path | None, cases: Sequence[bytes]) -> tuple[list[float | str], np.ndarray]:
    """What node says of each case, and points and joints (n, 3) of the persons among them, one after another."""
    (folder / "cases").write_bytes(b"".join(struct.pack("<I", len(one)) + one for one in cases))
    names = ["-" if basis is None else str(basis), str(folder / "cases"), str(folder / "out")]
    command = ["node", str(HERE / "person_points.mjs"), str(browser.built() / "person.js"), *names]
    done = subprocess.run(command, capture_output=True, text=True, encoding="utf-8", check=False)
    assert not done.returncode, done.stderr[-2000:]
    return json.loads(done.stdout), np.fromfile(folder / "out").reshape(-1, 3)


def differences(folder: Path, basis: Basis, file: Path, persons: Sequence[bytes]) -> list[float]:
    """Millimetres of points and joints between node and Python, the largest of each person."""
    said, found = in_node(folder, file, persons)
    assert all(isinstance(one, float) for one in said), said
    largest = []
    for data, own in zip(persons, np.split(found, len(persons)), strict=True):
        points = basis.rebuilt(decode_person(data, "person"), "person")
        joints = [joint.shares @ points[joint.points] for joint in basis.content.joints]
        largest.append(float(np.abs(own - np.vstack([points, *joints])).max()))
    return largest


def warped(points: np.ndarray, seed: int) -> np.ndarray:
    phase = np.random.default_rng(seed).normal(size=3)
    return np.asarray(points + 3 * np.sin(points[:, [1, 2, 0]] / 25 + phase))


def test_people_of_the_head_in_the_box(tmp_path: Path) -> None:
    """Drawn, a blend by region of two, beyond the modes, and elsewhere at another scale: within 1e-4 mm."""
    basis = head_basis()
    count = len(basis.mean)
    anna, bob = (whole_points(make(seed))[:count] for seed in (3, 8))
    share = 1 / (1 + np.exp(-(anna[:, 1:2] - anna[:, 1].mean()) / 10))
    mixed = share * anna + (1 - share) * bob
    persons = [
        encode_points(basis, anna, within=5.0)[0],
        encode_points(basis, mixed, within=0.5)[0],
        encode_points(basis, warped(anna, 1), within=1.0)[0],
        encode_points(basis, placed(MOVED, bob, np.zeros(3)), within=5.0)[0],
        encode_person(PersonContent(basis=basis.digest, modes=np.zeros(0, np.float16))),
    ]
    assert len(persons[0]) < 340 < len(persons[1])
    file = REPOSITORY / "facepipe" / "heads" / "data" / "head.fpbasis"
    assert max(differences(tmp_path, basis, file, persons)) < 1e-4


def studio(folder: Path, parts: FaceParts | None = None) -> tuple[Basis, Path]:
    """A face of a studio as a basis, and its file."""
    basis = template_basis(parts or tiny_face(), "studio")
    file = folder / "studio.fpbasis"
    file.write_bytes(encode_basis(basis.content))
    return basis, file


def test_a_studios_own_face(tmp_path: Path) -> None:
    basis, file = studio(tmp_path)
    persons = [encode_points(basis, warped(basis.mean, seed), within=0.1)[0] for seed in range(4)]
    assert max(differences(tmp_path, basis, file, persons)) < 1e-4


def test_the_same_bases_are_refused(tmp_path: Path) -> None:
    """Bodies changed anywhere under a digest that fits, cut files, and more than they say."""
    body, rng = basis_body(studio(tmp_path)[0].content), np.random.default_rng(1)
    whole = encode_basis(studio(tmp_path)[0].content)
    cases = [b"", whole, whole[:10], whole[:20], whole[:-1], whole[:8] + bytes(8) + whole[16:]]
    for _ in range(400):
        broken = bytearray(body)
        for place in rng.integers(0, len(body), rng.integers(1, 4)):
            broken[place] = rng.choice((broken[place] ^ 1 << rng.integers(8), rng.integers(256)))
        if rng.random() < 0.2:
            del broken[rng.integers(len(body)) :]
        size = len(broken) - 1 if rng.random() < 0.05 else len(broken)
        head = struct.pack("<4sHH8sI", b"FPBA", 1, 0, digest_of(bytes(broken)), size)
        cases.append(head + zlib.compress(bytes(broken), 1))
    said, _ = in_node(tmp_path, None, cases)
    refused = 0
    for data, own in zip(cases, said, strict=True):
        try:
            expected = np.abs(decode_basis(data, "basis")[0].mean).sum()
        except InputError:
            assert isinstance(own, str)
            assert own.startswith("basis")
            refused += 1
        else:
            assert own == pytest.approx(expected)
    assert 100 < refused < len(cases) - 50


def test_the_viewers_head_becomes_a_person(tmp_path: Path) -> None:
    """Points are those of `facepipe apply-bones`, moved by shapes, joints and sliders; taken off, the head is back."""
    head, me, clip = tmp_path / "head.usdc", tmp_path / "me.fpb", tmp_path / "clip.fpb"
    parts = make(0)
    joints = parts.skeleton.joints
    jaw = next(i for i, path in enumerate(joints) if path.endswith("jaw"))
    turn = Slider(name="turn", channels=((joints[jaw], "rx", 0.3), (joints[1], "ry", 0.2)))
    save_parts(replace(parts, sliders=(*parts.sliders, turn)), head)
    points = warped(whole_points(make(3))[: len(head_basis().mean)], 1)
    me.write_bytes(encode_points(head_basis(), points, within=1.0)[0])
    poses = rest_coefficients(len(joints))
    poses[jaw, 3], poses[1, 4] = 0.3, 0.2
    content = PayloadContent(joints=joints, coefficients=poses, meters_per_unit=parts.meters_per_unit)
    clip.write_bytes(encode(content).data)
    said = 'document.querySelector("section[aria-label=Payload] p").textContent.startsWith("{}")'
    read = run('return [face.points("Head"), face.points("EyeballLeft")].flatMap((one) => Array.from(one))')
    off = run('[...document.querySelectorAll("button")].find((one) => one.textContent === "Take off").click()')
    steps = [READY, read, {"upload": ["#payload", str(me)]}, until(said.format("me.fpb: a person in")), read]
    steps += [run("await face.setSliders({ turn: 1 })"), read, run("await face.setSliders({ turn: 0 })")]
    steps += [
        {"upload": ["#payload", str(clip)]},
        until(said.format("clip.fpb")),
        run("await face.setShapes({ jawOpen: 0.5 })"),
        read,
    ]
    with browser.viewing(head) as url:
        results, problems = browse(url, *steps, run("await face.reset()"), off, DRAWN, read)
    assert problems == []
    before, still, slid, posed, after = (np.reshape(one, (-1, 3)) for one in results if one and len(one) > 9)
    facepipe.apply_bones(head, me, out=tmp_path / "me.usdc")
    person, eye = facepipe.open(tmp_path / "me.usdc"), parts.meshes[3]
    start = sum(len(mesh.points) for mesh in parts.meshes[:3])
    own = np.r_[0 : len(parts.meshes[0].points), start : start + len(eye.points)]
    assert np.abs(still - 0.01 * person.evaluate()[own]).max() < 1e-6
    for found, expected in (
        (slid, person.evaluate(sliders={"turn": 1.0})),
        (posed, person.evaluate({"jawOpen": 0.5}, coefficients=poses)),
    ):
        assert np.abs(found - 0.01 * expected[own]).max() < 1e-5 * 0.01 * person.head_height
        assert np.abs(found - still).max() > 0.01
    np.testing.assert_array_equal(before, after)
