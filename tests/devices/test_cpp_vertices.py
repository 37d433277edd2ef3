"""samples/cpp/person.cpp shows a person as `facepipe.rig` does: shapes, bones, cards; it needs g++."""

from __future__ import annotations

import json
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

import gltf_reader
import numpy as np
import pytest
from device_readers import SANITIZED, cpp_person, run
from person_corpus import basis_file
from rebuilt_people import PEOPLE

import facepipe
from facepipe.heads import make
from facepipe.heads.assembly import LIDS, skeleton, with_own_lids
from facepipe.heads.holds import held
from facepipe.parts import Blendshape, FaceParts, Holds, Mesh
from facepipe.payload import PayloadContent, encode
from facepipe.payload.person import decode_person, encode_person
from facepipe.rig import build
from facepipe.rig.bone_coefficients import rest_coefficients
from facepipe.stage import save_parts
from facepipe.verbs.person_basis import head_basis

pytestmark = [pytest.mark.slow, pytest.mark.gate]
_MM = 1e3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The head that persons are put on, its basis, and a person with points."""
    folder = tmp_path_factory.mktemp("head")
    save_parts(make(0, textures=32), folder / "head.usdc")
    facepipe.export(folder / "head.usdc", folder / "head.glb", purpose="persons", quantize=False, meshopt=False)
    facepipe.export(folder / "head.usdc", folder / "small.glb", purpose="persons", engine="unreal")
    (folder / "head.fpbasis").write_bytes(basis_file("head"))
    (folder / "me.fpb").write_bytes(PEOPLE["drawn with points"][1]())
    (folder / "blend.fpb").write_bytes(PEOPLE["blended with a rig"][1]())
    return folder


def of_person(folder: Path, person: str = "me.fpb") -> FaceParts:
    """The head with the person's points, joints and shapes, cards on the skin, and lids as Python fits them to the
    eyeballs."""
    content = decode_person((folder / person).read_bytes(), "me")
    points, rig = head_basis().rebuilt(content, "me") / 10, head_basis().rig_change(content)
    parts = held(facepipe.open(folder / "head.usdc").parts())
    ends = np.cumsum([mesh.points for mesh in head_basis().content.meshes])
    places = dict(zip((mesh.name for mesh in head_basis().content.meshes), np.split(points, ends), strict=False))
    meshes: list[Mesh] = []
    for mesh in parts.meshes:
        held_on: Holds | None = mesh.holds
        if held_on is None:
            meshes.append(replace(mesh, points=places[mesh.name]))
        else:
            corners = places[held_on.mesh][held_on.corners]
            placed = np.einsum("nk,nkc->nc", held_on.shares, corners) + held_on.offsets
            meshes.append(replace(mesh, points=placed))
    own = rig.skeleton(skeleton(points))
    joints = replace(parts.skeleton, bind_transforms=own.bind_transforms, rest_transforms=own.rest_transforms)
    whole = rig.turned(replace(parts, meshes=tuple(meshes), skeleton=joints))
    fitted = with_own_lids(whole, points)
    skin, before = fitted.meshes[0], parts.meshes[0]
    for number, mesh in enumerate(whole.meshes):
        if mesh.holds is not None and mesh.holds.mesh == skin.name:
            shapes = tuple(_farther(shape, mesh, before, skin) for shape in mesh.blendshapes)
            meshes[number] = replace(mesh, blendshapes=shapes)
        else:
            meshes[number] = fitted.meshes[number]
    return replace(whole, meshes=tuple(meshes))


def _farther(shape: Blendshape, mesh: Mesh, before: Mesh, skin: Mesh) -> Blendshape:
    """A shape of cards that goes as much farther as the skin does below them."""
    if shape.name not in LIDS:
        return shape
    moves = []
    for number in range(1 + len(shape.inbetweens)):
        old, new, own = (_moves(one, shape.name, number) for one in (before, skin, mesh))
        moves.append(own + np.einsum("nk,nkc->nc", mesh.holds.shares, (new - old)[mesh.holds.corners]))
    inbetweens = tuple(replace(one, offsets=own) for one, own in zip(shape.inbetweens, moves[1:], strict=True))
    rows = np.arange(len(mesh.points), dtype=np.int32)
    return replace(shape, point_indices=rows, offsets=moves[0], normal_offsets=None, inbetweens=inbetweens)


def _moves(mesh: Mesh, name: str, number: int) -> np.ndarray:
    """(n, 3) of a shape, or of one of its inbetweens."""
    shape = next(one for one in mesh.blendshapes if one.name == name)
    whole = np.zeros((len(mesh.points), 3))
    whole[shape.point_indices] = (shape, *shape.inbetweens)[number].offsets
    return whole


def rows_of(path: Path, parts: FaceParts) -> np.ndarray:
    """(v,) whole points of the vertices of a GLB, primitive after primitive."""
    glb, firsts, count = gltf_reader.read(path), {}, 0
    for mesh in parts.meshes:
        firsts[mesh.name] = count
        count += len(mesh.points)
    rows = [
        firsts[mesh["name"]] + glb.decoded(primitive["attributes"]["_FACEPIPE_POINT"]).astype(int)
        for mesh in glb.list("meshes")
        for primitive in mesh["primitives"]
    ]
    return np.concatenate(rows)


def shown(folder: Path, *words: str, head: str = "head.glb", person: str = "me.fpb") -> np.ndarray:
    """(v, 3) metres that the program writes."""
    files = [str(folder / name) for name in (head, "head.fpbasis", person)]
    run([*cpp_person(), *files, *words, "-o", str(folder / "out.bin")])
    return np.fromfile(folder / "out.bin", "<f4").reshape(-1, 3)


WEIGHTS = {"jawOpen": 0.7, "eyeBlinkLeft": 0.4, "eyeLookDownRight": 0.8, "mouthSmileLeft": 1.2, "browInnerUp": -0.5}


def bones(count: int) -> np.ndarray:
    """(j, 9) of all joints, in centimetres."""
    rng = np.random.default_rng(0)
    return rest_coefficients(count) + rng.normal(0, [0.1] * 3 + [0.05] * 3 + [0.03] * 3, (count, 9))


@pytest.mark.parametrize("posed", [False, True])
@pytest.mark.parametrize("person", ["me.fpb", "blend.fpb"])
def test_vertices_are_those_of_the_rig(folder: Path, person: str, posed: bool) -> None:
    parts = of_person(folder, person)
    words = [f"{name}={value}" for name, value in WEIGHTS.items()]
    coefficients = None
    if posed:
        coefficients = bones(len(parts.skeleton.joints))
        pose = PayloadContent(joints=parts.skeleton.joints, coefficients=coefficients, meters_per_unit=0.01)
        (folder / "pose.fpb").write_bytes(encode(pose).data)
        coefficients = coefficients.astype(np.float32).astype(np.float64)
        words += ["--pose", str(folder / "pose.fpb")]
        with_pose = replace(decode_person((folder / person).read_bytes(), "me"), coefficients=encode(pose).data)
        (folder / "posed.fpb").write_bytes(encode_person(with_pose))
    expected = 0.01 * build(parts).evaluate(WEIGHTS, coefficients=coefficients)
    vertices = shown(folder, "--weights", *words, person=person)
    away = _MM * np.abs(vertices - expected[rows_of(folder / "head.glb", parts)])
    assert away.max() < 1e-3
    if posed:
        inside = shown(folder, "--weights", *words[:-2], person="posed.fpb")
        np.testing.assert_array_equal(inside, vertices)
    still = 0.01 * build(facepipe.open(folder / "head.usdc").parts()).evaluate(WEIGHTS)
    assert _MM * np.abs(still - expected).max() > 3, "a person who is the head shows nothing"


def test_small_numbers_are_read_too(folder: Path) -> None:
    """KHR_mesh_quantization: offsets of targets in steps of 0.03 mm."""
    parts = of_person(folder)
    expected = 0.01 * build(parts).evaluate(WEIGHTS)
    vertices = shown(folder, "--weights", *(f"{name}={value}" for name, value in WEIGHTS.items()), head="small.glb")
    away = _MM * np.abs(vertices - expected[rows_of(folder / "small.glb", parts)])
    assert away.max() < 0.1


def test_an_obj_is_those_vertices(folder: Path) -> None:
    vertices = shown(folder)
    files = [str(folder / name) for name in ("head.glb", "head.fpbasis", "me.fpb")]
    run([*cpp_person(), *files, "-o", str(folder / "me.obj")])
    lines = [line.split() for line in (folder / "me.obj").read_text().splitlines()]
    points = np.array([line[1:] for line in lines if line[0] == "v"], float)
    corners = np.array([line[1:] for line in lines if line[0] == "f"], int)
    np.testing.assert_allclose(points, vertices, atol=1e-6)
    assert (corners.min(), corners.max()) == (1, len(points))


def failed(*words: object) -> str:
    """The one line that it ends with."""
    done = subprocess.run([*cpp_person(*SANITIZED), *map(str, words)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    return done.stderr


def test_what_is_wrong_is_one_line(folder: Path, tmp_path: Path) -> None:
    head, basis, person = folder / "head.glb", folder / "head.fpbasis", folder / "me.fpb"
    out = ("-o", tmp_path / "out.bin")
    assert "expected HEAD.glb" in failed(head, *out, basis)
    assert "no such shape" in failed(head, "--weights", "jawOpn=1", *out)
    assert "expected NAME=VALUE" in failed(head, "--weights", "jawOpen", *out)
    assert "no GLB" in failed(person, basis, person, *out)
    assert "no basis" in failed(head, person, basis, *out)
    assert "no person" in failed(head, basis, basis, *out)
    (tmp_path / "cut.fpb").write_bytes(person.read_bytes()[:-9])
    assert "cut.fpb: is damaged" in failed(head, basis, tmp_path / "cut.fpb", *out)
    assert "can't be read" in failed(head, basis, tmp_path / "none.fpb", *out)
    assert not out[1].exists()


def test_damaged_glbs_are_refused_or_shown(folder: Path, tmp_path: Path) -> None:
    """Under sanitizers: numbers of the JSON changed, and bytes."""
    data = (folder / "small.glb").read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    text, rest = data[20 : 20 + size], data[20 + size :]
    rng, codes = np.random.default_rng(0), set()
    places = [i for i, byte in enumerate(text) if chr(byte).isdigit()]
    for number in range(40):
        broken = bytearray(text)
        for place in rng.choice(places, 6 if number % 2 else 200):
            broken[place] = ord(rng.choice(list('0123456789-e"{[]')))
        (tmp_path / "head.glb").write_bytes(data[:20] + broken + rest)
        words = [*cpp_person(*SANITIZED), str(tmp_path / "head.glb"), "-o", str(tmp_path / "out.bin")]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        assert done.returncode in (0, 2), done.stderr
        assert done.stderr.count("\n") == (done.returncode == 2)
        codes.add(done.returncode)
    document = json.loads(text)
    document["accessors"][0]["count"] = 1 << 30
    changed = json.dumps(document).encode()
    (tmp_path / "head.glb").write_bytes(data[:12] + struct.pack("<I", len(changed)) + b"JSON" + changed + rest)
    assert "more numbers than its bytes are worth" in failed(tmp_path / "head.glb", "-o", tmp_path / "out.bin")
    assert 2 in codes
