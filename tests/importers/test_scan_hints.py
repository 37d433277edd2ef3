"""What files say of where a face is: pieces, joints of heads, shapes of eyes and mouths; and strips of triangles."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scan_files import CODES, read, volume
from solids import ball
from vrm_files import BONES, Person

from facepipe.core.errors import InputError
from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_hints import hints_of
from facepipe.importers.scan_landmarks import read_scan_landmarks
from facepipe.parts import Blendshape, FaceParts, Mesh, Skeleton, Skin
from facepipe.stage import save_parts

EYE = {"left": np.array([0.5, 0.3, 0.8]), "right": np.array([-0.5, 0.3, 0.8])}
MOUTH = np.array([0.0, -0.4, 0.9])
# A cube as two strips, a corner twice in a row to lead the second one on.
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64)
STRIPS = [0, 1, 2, 3, 6, 7, 4, 5, 0, 1, -1, 0, 2, 4, 6, -1, 3, 1, 7, 5]


def strips(form: str, lists: list[list[int]]) -> bytes:
    """A PLY of triangle strips, by the format's description."""
    lines = ["ply", f"format {form} 1.0", f"element vertex {len(CUBE)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element tristrips {len(lists)}", "property list int int vertex_indices", "end_header", ""]
    head = "\n".join(lines).encode()
    if form == "ascii":
        rows = [*CUBE.tolist(), *([len(one), *one] for one in lists)]
        return head + "\n".join(" ".join(f"{value:g}" for value in row) for row in rows).encode()
    order = "<" if "little" in form else ">"
    return (
        head
        + CUBE.astype(order + CODES["float"]).tobytes()
        + b"".join(np.array([len(one), *one], order + CODES["int"]).tobytes() for one in lists)
    )


def of_strips(indices: list[int]) -> list[list[int]]:
    """Triangles one by one."""
    found: list[list[int]] = []
    strip: list[int] = []
    for index in indices:
        strip = [] if index < 0 else [*strip, index]
        if len(strip) > 2 and len({*strip[-3:]}) == 3:
            a, b, c = strip[-3:]
            found.append([a, b, c] if len(strip) % 2 else [b, a, c])
    return found


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_triangle_strips_are_triangles_of_one_orientation(form: str, tmp_path: Path) -> None:
    scan = read(strips(form, [STRIPS]), tmp_path)
    assert scan.triangles.tolist() == of_strips(STRIPS)
    assert abs(volume(scan.points, scan.triangles)) == pytest.approx(1.0)
    apart = [STRIPS[:10], STRIPS[11:15], STRIPS[16:], [], [3, 1]]
    assert read(strips(form, apart), tmp_path).triangles.tolist() == scan.triangles.tolist()


@pytest.mark.parametrize("index", [8, -2])
def test_a_strip_of_points_that_are_not_there_is_refused(index: int, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"scan\.ply -> tristrips 1: vertex {index}, expected 0 to 7"):
        read(strips("binary_little_endian", [STRIPS, [0, 1, index]]), tmp_path)


def test_groups_of_an_obj_are_pieces(tmp_path: Path) -> None:
    rows = ["o all", *(f"v {x} {y} 0" for x in range(4) for y in range(2))]
    rows += ["g first", "f 1 3 4 2", "g second", "f 3 5 6 4", "g first", "f 5 7 8"]
    scan = read("\n".join(rows).encode(), tmp_path, "one.obj")
    assert scan.hints.pieces == ("first", "second")
    assert scan.hints.piece.tolist() == [0, 0, 1, 1, 0]
    assert scan.hints.mm_per_unit is None


def face(*, names: tuple[str, str] = ("eyeBlinkLeft", "eyeBlinkRight"), mirror: bool = False) -> FaceParts:
    """A ball of a head on a ball of a body, that a skeleton carries, with shapes of eyes and mouth."""
    points, triangles = ball(24)
    skull, body = points[:, [0, 2, 1]] * [1, 1, -1], points * 2 + [0, -4, 0]
    shapes = []
    for name, place in ((names[0], EYE["left"]), (names[1], EYE["right"]), ("jawOpen", MOUTH)):
        near = np.argsort(np.linalg.norm(skull - place, axis=1))[:5].astype(np.int32)
        shapes.append(Blendshape(name=name, point_indices=np.sort(near), offsets=np.tile([0.0, -0.1, 0.0], (5, 1))))
    if mirror:
        skull, triangles = skull * [-1, 1, 1], triangles[:, ::-1]
    meshes = []
    for number, (name, at, own) in enumerate((("Skull", skull, tuple(shapes)), ("Body", body, ()))):
        skin = Skin(joint_indices=np.full((len(at), 1), 2 - number, np.int32), joint_weights=np.ones((len(at), 1)))
        counts = np.full(len(triangles), 3, np.int32)
        meshes.append(
            Mesh(
                name=name,
                points=at,
                face_vertex_counts=counts,
                face_vertex_indices=triangles.ravel().astype(np.int32),
                skin=skin,
                blendshapes=own,
            )
        )
    bind = np.tile(np.eye(4), (3, 1, 1))
    skeleton = Skeleton(joints=("hips", "hips/spine", "hips/head"), bind_transforms=bind, rest_transforms=bind)
    return FaceParts(meshes=tuple(meshes), skeleton=skeleton, meters_per_unit=0.1)


def held_otherwise() -> FaceParts:
    """Meshes that hang on other joints than the head's."""
    parts = face()
    skins = [replace(mesh.skin, joint_indices=mesh.skin.joint_indices * 0) for mesh in parts.meshes if mesh.skin]
    meshes = tuple(replace(mesh, skin=skin) for mesh, skin in zip(parts.meshes, skins, strict=True))
    bind = parts.skeleton.bind_transforms.copy()
    bind[:, 1, 3] = [-5.0, -3.0, -0.9]
    return replace(parts, meshes=meshes, skeleton=replace(parts.skeleton, bind_transforms=bind))


def test_a_head_is_near_a_joint_that_carries_nothing() -> None:
    """By where the joint is above the hips, or the avatar looks from."""
    held = held_otherwise()
    head = hints_of(held).head
    assert head is not None
    piece = hints_of(held).piece
    assert head[piece == 0].mean() > 0.9
    assert head[piece == 1].mean() < 0.1
    looks = {"VRMC_vrm": {"lookAt": {"offsetFromHeadBone": [0.0, 10.0, 0.0]}}}
    assert hints_of(replace(held, vrm=looks)).head is None  # far above it all
    assert hints_of(replace(held, skeleton=replace(held.skeleton, joints=("a", "a/b", "a/head")))).head is None


@pytest.mark.parametrize("looks", [["a", 1, 2], [None, 1, 2], [[1], 2, 3], [10**400, 0, 0], [1e300, 0, 0], {}, "abc"])
def test_what_a_stage_says_of_where_an_avatar_looks_from_is_a_place_or_nothing(looks: Any, tmp_path: Path) -> None:
    held = held_otherwise()
    found = hints(replace(held, vrm={"VRMC_vrm": {"lookAt": {"offsetFromHeadBone": looks}}}), tmp_path)
    assert np.array_equal(found.head, hints_of(held).head)


def hints(parts: FaceParts, folder: Path) -> Any:
    save_parts(parts, folder / "face.usda")
    return read_scan(folder / "face.usda").hints


def test_a_head_is_what_its_joint_carries_and_shapes_show_its_features(tmp_path: Path) -> None:
    found = hints(face(), tmp_path)
    assert found.pieces == ("Skull", "Body")
    assert found.head.tolist() == (found.piece == 0).tolist()
    assert found.mm_per_unit == pytest.approx(100.0)
    for place, expected in zip(found.features, (EYE["left"], EYE["right"], MOUTH), strict=True):
        assert np.linalg.norm(place / np.linalg.norm(place) - expected / np.linalg.norm(expected)) < 0.15
    assert not found.swapped


def test_names_of_a_mirrored_mesh_are_seen_to_be_changed_over(tmp_path: Path) -> None:
    found = hints(face(mirror=True), tmp_path)
    assert found.swapped
    assert found.features[0, 0] > 0.3 > -0.3 > found.features[1, 0]  # as the surface has left and right


def test_expressions_of_a_vrm_name_the_shapes(tmp_path: Path) -> None:
    person = Person()
    humanoid = {"humanBones": {bone: {"node": person.node[bone]} for bone in BONES}}
    meta = {"name": "x", "authors": ["y"], "licenseUrl": "https://vrm.dev/licenses/1.0/"}
    preset = {
        name: {"morphTargetBinds": [{"node": person.node["Face"], "index": index, "weight": 1.0}]}
        for name, index in (("blinkLeft", 1), ("blinkRight", 2), ("aa", 0))
    }
    vrm = {"specVersion": "1.0", "meta": meta, "humanoid": humanoid, "expressions": {"preset": preset}}
    (tmp_path / "one.vrm").write_bytes(person.glb({"VRMC_vrm": vrm}))
    scan = read_scan(tmp_path / "one.vrm")
    assert scan.hints.features is not None
    head = scan.points[np.unique(scan.triangles[scan.hints.head])]
    assert head[:, 1].min() * scan.hints.mm_per_unit > 1450.0  # the ball about the head, and no other


def test_landmarks_may_be_numbers_of_vertices(tmp_path: Path) -> None:
    """Also where points that no triangle uses, or that lie at one place, have numbers of their own."""
    rows = ["v 9 9 9", "v 0 0 0", "v 0 0 0", "v 1 0 0", "v 0 1 0", "f 3 4 5"]
    scan = read("\n".join(rows).encode(), tmp_path, "one.obj")
    marks = tmp_path / "one.json"
    marks.write_text(json.dumps({"vertices": {"30": 3, "8": 4}}))
    found = read_scan_landmarks(marks, scan)
    assert found.points[[30, 8]].tolist() == [[1.0, 0, 0], [0.0, 1, 0]]
    assert found.known.sum() == 2
    marks.write_text(json.dumps({"vertices": [2, *[None] * 66, 0]}))
    assert read_scan_landmarks(marks, tmp_path / "one.obj").points[[0, 67]].tolist() == [[0.0, 0, 0], [9.0, 9, 9]]


@pytest.mark.parametrize(("content", "what"), [
    ({"vertices": {"30": 5}}, "30: 5, expected 0 to 4"),
    ({"vertices": {"30": True}}, "30: True, expected"),
    ({"vertices": {"nose": 1}}, "landmark 'nose', expected a number from 0 to 67"),
    ({"vertices": [1, 2]}, "expected a list of 68"),
    ({"vertices": {"30": 1}, "mesh": "Body"}, "mesh: 'Body', expected the name of a mesh"),
    ({"vertices": {"30": 1}, "points": [None] * 68}, "points and vertices"),
    ({"vertices": {}}, "no landmark and no marker"),
])  # fmt: skip
def test_wrong_vertices_are_named(content: Any, what: str, tmp_path: Path) -> None:
    rows = [*(f"v {x} {x * x} 0" for x in range(5)), "f 1 2 3"]
    scan = read("\n".join(rows).encode(), tmp_path, "one.obj")
    (tmp_path / "one.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=what):
        read_scan_landmarks(tmp_path / "one.json", scan)


def test_vertices_need_a_scan_and_of_several_meshes_a_name(tmp_path: Path) -> None:
    save_parts(face(), tmp_path / "face.usda")
    marks = tmp_path / "one.json"
    marks.write_text(json.dumps({"vertices": {"30": 1}}))
    with pytest.raises(InputError, match="expected a scan"):
        read_scan_landmarks(marks)
    with pytest.raises(InputError, match="expected the name of a mesh of the scan: 'Skull', 'Body'"):
        read_scan_landmarks(marks, tmp_path / "face.usda")
    marks.write_text(json.dumps({"vertices": {"30": 1}, "mesh": "Skull"}))
    assert read_scan_landmarks(marks, tmp_path / "face.usda").known.sum() == 1
