"""A head of others in Blender: the button gives it the shapes that `facepipe transfer` gives its file; a take plays."""

from __future__ import annotations

import json
from pathlib import Path

import live_link
import numpy as np
import pytest
from blender_python import blender, needs_blender
from command_line import exit_code

import facepipe
from facepipe.geometry.polygons import point_triangles
from facepipe.heads import make
from facepipe.parts import FaceParts, Mesh
from facepipe.rig.conventions import ARKIT_SHAPES

pytestmark = [pytest.mark.gate, pytest.mark.slow, needs_blender]

PARTS = ("Head", "GumsAndTongue", "Teeth", "EyeballLeft", "EyeballRight")
NEAR = 1e-6 * 30  # of the head's height, in its centimetres
Found = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``head.obj``, whose skin has other points and triangles than the package's head, with ``head.landmarks.json``.

    The average head stays as it is however people are drawn: at a corner of a mouth that is shut a point may be as near
    to both lips, and which of them it goes with is for the last digit to say.
    """
    import fast_simplification

    made, folder, lines, start = make(0), tmp_path_factory.mktemp("head"), list[str](), 1
    for mesh in made.meshes:
        triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
        points = np.asarray(mesh.points, np.float64)
        if mesh.name == "Head":
            marks = points[mesh.landmarks["multipie68"].indices]
            (folder / "head.landmarks.json").write_text(json.dumps({"points": marks.tolist()}))
            few = fast_simplification.simplify(
                points.astype(np.float32), triangles.astype(np.int32), target_count=12_000
            )
            used, triangles = np.unique(few[1], return_inverse=True)
            points, triangles = few[0][used], triangles.reshape(-1, 3)
        lines += [f"o {mesh.name}", *(f"v {x} {y} {z}" for x, y, z in points.tolist())]
        lines += [f"f {a} {b} {c}" for a, b, c in (triangles + start).tolist()]
        start += len(points)
    (folder / "head.obj").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module")
def pressed(folder: Path) -> tuple[Found, str]:
    """What Blender has before and after the button, undone and again; and what it says."""
    paths = [folder / name for name in ("head.obj", "head.landmarks.json", "out.usda")]
    return blender("head_shapes.py", *paths, answer=folder / "answer.npz")


@pytest.fixture(scope="module")
def wanted(folder: Path) -> FaceParts:
    """What the command gives the file."""
    facepipe.transfer(folder / "head.obj", out=folder / "wanted.usda", only=("shapes",))
    return facepipe.open(folder / "wanted.usda").parts()


def named(pressed: tuple[Found, str], when: str, part: str) -> list[str]:
    return [str(name) for name in pressed[0][f"{when} names {part}"]]


def dense(mesh: Mesh) -> Found:
    """Key -> (n, 3) what it holds."""
    found = {}
    for shape in mesh.blendshapes:
        for name, weight, one in shape.sculpts:
            delta = np.zeros((len(mesh.points), 3))
            delta[shape.point_indices] = one.offsets
            at = name.removeprefix(f"{shape.name}_")
            key = name if weight == 1.0 else f"{shape.name}@{weight:g} {at}"
            found[key] = delta if weight == 1.0 else delta - weight * found[shape.name]
    return found


def test_keys_are_those_of_the_command(pressed: tuple[Found, str], wanted: FaceParts) -> None:
    found, said = pressed
    assert [mesh.name for mesh in wanted.meshes] == [*PARTS]
    keys = {name for part in PARTS for name in named(pressed, "after", part) if "@" not in name}
    assert keys - {"Basis"} == {*ARKIT_SHAPES} - {"mouthSmileLeft"} | {"mouthSmile_L"}, said
    for mesh in wanted.meshes:
        shapes = {key: delta for key, delta in dense(mesh).items() if key != "mouthSmileLeft"}
        own = ["Basis", "mouthSmile_L"] if mesh.name == "Head" else ["Basis"]
        assert {*named(pressed, "after", mesh.name)} == {*own, *shapes}
        for key, delta in shapes.items():
            mirrored = (-1, 1, 1) if mesh.name == "EyeballRight" else (1, 1, 1)
            off = np.abs(found[f"after key {mesh.name} {key}"] * mirrored - delta).max(axis=1)
            # fits of eyes and lids choose between points that are as near: the last digit of a turned head decides
            assert np.mean(off > NEAR) < 0.002, key
            assert off.max() < 1e-3, key
            assert found[f"after value {mesh.name} {key}"] == 0.0


def test_all_else_stays_and_one_undo_takes_the_keys_away(pressed: tuple[Found, str]) -> None:
    found, _ = pressed
    for part in PARTS:
        own = {"Head": ["Basis", "mouthSmile_L"]}.get(part, [])
        assert named(pressed, "before", part) == named(pressed, "undone", part) == own
        assert named(pressed, "again", part) == named(pressed, "after", part)
        for when in ("after", "undone", "again"):
            assert np.array_equal(found[f"{when} points {part}"], found[f"before points {part}"])
            assert found[f"{when} rest {part}"] == found[f"before rest {part}"]
    assert found["after value Head mouthSmile_L"] == found["before value Head mouthSmile_L"] == 0.5
    assert np.array_equal(found["after key Head mouthSmile_L"], found["before key Head mouthSmile_L"])


def test_it_says_what_it_made_and_what_is_wrong(pressed: tuple[Found, str]) -> None:
    found, said = pressed
    assert "Head: 51 shapes added" in said
    assert "51 made, 1 the head's own" in said
    assert "usual unit" not in said
    nothing, torch, lost, mirror, done = found["said"].tolist()
    assert "no mesh with faces is selected, expected a head" in nothing
    assert "face of Teeth: finding it needs torch, which Blender's Python lacks, expected a file of landmarks" in torch
    assert "out.json.none: can't be read" in lost
    assert "Teeth: a Mirror modifier makes half of it, expected it applied" in mirror
    assert done == ""
    assert found["buttons"].tolist()[-1] == "facepipe.transfer"


def test_a_live_link_take_plays_on_it(pressed: tuple[Found, str], folder: Path) -> None:
    values = live_link.performance(40)
    live_link.write(folder / "take.csv", values)
    paths = [str(folder / name) for name in ("out.usda", "take.csv", "played.usda")]
    assert exit_code("animate", *paths[:2], "-o", paths[2]) == 0
    played, _ = blender(
        "round_trip.py", folder / "played.usda", folder / "later.usda", {}, False, answer=folder / "played.npz"
    )
    face = facepipe.open(folder / "played.usda")
    at = 60 * played["frame"] / face.frames_per_second  # of the take
    columns = {name[0].lower() + name[1:]: one for name, one in zip(live_link.COLUMNS, values.T, strict=True)}
    weights = {name: float(np.interp(at, np.arange(len(values)), columns[name])) for name in ARKIT_SHAPES}
    weights["mouthSmile_L"] = weights.pop("mouthSmileLeft")
    for part, points in face.split(face.evaluate(weights)).items():
        np.testing.assert_allclose(played[f"played {part}"], points, rtol=0, atol=1e-3, err_msg=part)
