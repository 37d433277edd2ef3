"""The scripts and notebooks in samples/; those of batches are in tests/farm/test_batch_samples.py."""

from __future__ import annotations

import dataclasses
import runpy
import shutil
from pathlib import Path
from typing import Any

import live_link
import numpy as np
import pytest
from command_line import Capsys, exit_code
from notebooks import cells, run_cells
from PIL import Image
from places import REPOSITORY
from small_head import make

import facepipe
import facepipe.heads
from facepipe.checks import validate
from facepipe.importers.scan_landmarks import read_scan_landmarks
from facepipe.parts import Blendshape, FaceParts, Landmarks, Mesh, Skeleton
from facepipe.stage import save_parts

FOLDER = REPOSITORY / "samples"
SCRIPTS = (
    "blend_family",
    "foreign_head",
    "live_link_takes",
    "pre_publish",
    "ten_people",
    "transfer_rig",
    "watch_folder",
)
NOTEBOOKS = ("engine_side", "first_face")


@pytest.fixture
def small_heads(monkeypatch: pytest.MonkeyPatch) -> None:
    """The head in the box has few triangles."""
    people = {seed: make(seed) for seed in (1, 2, 3, 5)}
    monkeypatch.setattr(facepipe.heads, "make", lambda seed, **_: people[seed])


def _names_of(script: str) -> dict[str, Any]:
    return runpy.run_path(str(FOLDER / f"{script}.py"))


def _run(script: str, *words: object) -> dict[str, Any]:
    """What a script defines, after it has done its work."""
    names = _names_of(script)
    assert names["main"]([str(word) for word in words]) == 0
    return names


def _errors(*files: Path) -> list[str]:
    return [one.message for file in files for one in validate(file) if one.severity == "error"]


def test_the_readme_lists_all_and_each_is_short() -> None:
    listed = (FOLDER / "README.md").read_text(encoding="utf-8")
    shown = {*(f"{name}.py" for name in SCRIPTS), *(f"{name}.ipynb" for name in NOTEBOOKS), "nightly.toml"}
    assert all(f"`{name}`" in listed for name in shown)
    others = {"README.md", "meshopt_wasm.py", "ufbx_tables.c", "ufbx_wasm.py"}
    assert {one.name for one in FOLDER.iterdir() if one.is_file()} == {*shown, *others}
    assert all(len((FOLDER / f"{name}.py").read_text(encoding="utf-8").splitlines()) < 60 for name in SCRIPTS)
    for name in NOTEBOOKS:
        assert all((cell["outputs"], cell["execution_count"]) == ([], None) for cell in cells(FOLDER / f"{name}.ipynb"))


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_without_words_prints_its_usage(script: str, capsys: Capsys) -> None:
    assert _names_of(script)["main"]([]) == 2
    assert f"usage: python samples/{script}.py" in capsys.readouterr().err


def test_people_are_drawn_and_exported(tmp_path: Path, small_heads: None) -> None:
    _run("ten_people", tmp_path / "crowd", 2, 0)
    files = [tmp_path / f"crowd/person_0{seed}.glb" for seed in (1, 2)]
    assert _errors(*files) == []
    first, second = (facepipe.read(file).evaluate() for file in files)
    assert np.abs(first - second).max() > 0.003  # metres
    with Image.open(tmp_path / "crowd/people.png") as sheet:
        left, right = (np.asarray(sheet.crop((x, 0, x + 320, 320)), dtype=int) for x in (0, 320))
        assert (sheet.size, np.abs(left - right).max() > 50) == ((640, 320), True)


def test_children_take_after_their_parents(folder: Path, capsys: Capsys) -> None:
    """The same parents have the same children; of one face twice they are that face."""
    for out in ("first", "again"):
        _run("blend_family", "a.usda", "b.usda", out, 2)
    assert "from the mother" in capsys.readouterr().out
    children = [Path(f"first/child_{number}.usda") for number in (1, 2)]
    assert _errors(*children, *(child.with_suffix(".glb") for child in children)) == []
    assert [Path(f"again/{child.name}").read_bytes() for child in children] == [one.read_bytes() for one in children]
    first, second = (facepipe.open(child).evaluate() for child in children)
    assert np.abs(first - second).max() > 0.01
    shutil.copy("a.usda", "twin.usda")
    _run("blend_family", "a.usda", "twin.usda", "alone", 1)
    np.testing.assert_allclose(
        facepipe.open("alone/child_1.usda").evaluate(), facepipe.open("a.usda").evaluate(), atol=1e-5
    )


def test_a_rig_that_is_transferred_runs_without_facepipe(tmp_path: Path) -> None:
    bare = make(4)
    meshes = tuple(dataclasses.replace(mesh, skin=None) for mesh in bare.meshes)
    save_parts(
        dataclasses.replace(
            bare, meshes=meshes, skeleton=Skeleton(), sliders=(), animations=(), played=None, bone_limits=None
        ),
        tmp_path / "bare.usda",
    )
    save_parts(make(0), tmp_path / "rigged.usda")
    pose = _run("transfer_rig", tmp_path / "bare.usda", tmp_path / "rigged.usda", tmp_path)["pose"]
    face = facepipe.open(tmp_path / "bare_rigged.usda")
    jaw = [joint.rpartition("/")[2] for joint in face.skeleton.joints].index("jaw")
    coefficients = np.zeros((len(face.skeleton.joints), 9))
    coefficients[:, 6:], coefficients[jaw, 3] = 1.0, 0.3
    points, rest = pose(tmp_path / "bare_rigged.onnx", "jaw", 0.3), face.evaluate() * face.mm_per_unit
    np.testing.assert_allclose(points, face.evaluate(coefficients=coefficients) * face.mm_per_unit, atol=0.01)
    moved = np.linalg.norm(points - rest, axis=1)
    assert moved.max() > 5.0
    assert np.median(moved) < 0.01  # the skull stays


def _quads(side: int = 12) -> FaceParts:
    """A dome of quads, coloured, with landmarks away from its border, and a mesh inside with a shape."""
    x, y = (one.ravel() for one in np.meshgrid(*[np.linspace(-5.0, 5.0, side)] * 2, indexing="ij"))
    points = np.stack([x, y, 8.0 - 0.1 * (x**2 + y**2)], axis=1)
    grid = np.arange(side * side).reshape(side, side)
    quads = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=-1).reshape(-1, 4)
    faces = {"face_vertex_counts": np.full(len(quads), 4, np.int32), "face_vertex_indices": quads.ravel()}
    marks = Landmarks(indices=grid[2:-2, 1:-1].ravel()[:68].astype(np.int32), names=())
    shape = Blendshape(name="jawOpen", point_indices=np.array([3], np.int32), offsets=np.ones((1, 3)))
    skin = Mesh(name="Head", points=points, colors=np.full_like(points, 0.5), landmarks={"multipie68": marks}, **faces)
    return FaceParts(
        name="Person", meshes=(skin, Mesh(name="Teeth", points=0.5 * points, blendshapes=(shape,), **faces))
    )


def test_a_foreign_head_is_the_same_surface_on_another_mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It looks outward still, has none of the person's points, and landmarks lie on it."""
    person = _quads()
    monkeypatch.setattr(facepipe.heads, "make", lambda seed, **_: person)
    names = _run("foreign_head", tmp_path / "hero.glb", 2)
    assert _errors(tmp_path / "hero.glb") == []
    head = facepipe.read(tmp_path / "hero.glb")
    assert (head.shapes, head.skeleton.joints, [mesh.name for mesh in head.meshes]) == ((), (), ["Head", "Teeth"])
    skin, own = head.parts().meshes[0], person.meshes[0].points @ names["TO_METRES"]
    apart = np.linalg.norm(skin.points[:, None] - own[None], axis=2).min(axis=1)
    assert 0.005 < apart.min() <= apart.max() < 0.008  # the middles of quads of 9 mm
    assert sorted({*skin.face_vertex_counts.tolist()}) == [4]
    corners = skin.points[skin.face_vertex_indices.reshape(-1, 4)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = np.array([0.0, 0.0, 1.0]) @ names["TO_METRES"]
    assert (normals @ outward > 0).all()
    marks = read_scan_landmarks(tmp_path / "hero.landmarks.json").points
    np.testing.assert_allclose(marks, own[person.meshes[0].landmarks["multipie68"].indices], atol=1e-6)


def test_takes_become_clips_of_one_file(tmp_path: Path, capsys: Capsys) -> None:
    save_parts(make(0), tmp_path / "head.usda")
    (tmp_path / "takes").mkdir()
    takes = {name: live_link.performance(20, seed) for seed, name in enumerate(("hello", "yawn"))}
    for name, values in takes.items():
        live_link.write(tmp_path / f"takes/{name}.csv", values)
    _run("live_link_takes", tmp_path / "head.usda", tmp_path / "takes", tmp_path / "head.glb")
    assert "yawn.csv: 20 frames at 60 fps" in capsys.readouterr().out
    assert _errors(tmp_path / "head.glb") == []
    clips = {clip.name: clip for clip in facepipe.read(tmp_path / "head.glb").animations}
    assert {*takes} <= {*clips}
    column = live_link.COLUMNS.index("JawOpen")
    for name, values in takes.items():
        weights = clips[name].shape_weights[:, clips[name].shapes.index("jawOpen")]
        np.testing.assert_allclose(weights, values[:, column], atol=1e-4)


@pytest.mark.parametrize("notebook", NOTEBOOKS)
def test_a_notebook_runs(
    notebook: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys, small_heads: None
) -> None:
    """Cells check themselves what they show."""
    monkeypatch.chdir(tmp_path)
    names = run_cells(FOLDER / f"{notebook}.ipynb")
    made = {one.name for one in (tmp_path / notebook).iterdir()}
    if notebook == "first_face":
        assert {"head.usdc", "smile.png", "jaw.png", "person.glb"} <= made
        assert names["moved"].max() > 2.0
        assert np.abs(names["opened"] - names["neutral"]).max() * names["face"].mm_per_unit > 5.0
        assert names["both"].size == (640, 320)
    else:
        assert {"head.onnx", "head.onnx.json", "sliders.onnx"} <= made
        assert np.abs(names["expected"] - names["face"].evaluate()).max() > 0.1
        assert "skinning_matrices: (1, " in capsys.readouterr().out


def test_a_face_is_published_up_to_date_or_not_at_all(tmp_path: Path, capsys: Capsys) -> None:
    """The example of an asset build: it cooks what is stale, and hands on nothing that a check finds an error in."""
    heads = [tmp_path / f"head{seed}.usdz" for seed in (0, 5)]
    for seed, head in zip((0, 5), heads, strict=True):
        save_parts(make(seed), head)
    child, out = tmp_path / "child.usda", tmp_path / "published"
    out.mkdir()
    assert exit_code("blend", *heads, "-o", child) == 0
    first = child.read_bytes()
    shutil.copy(heads[0], heads[1])
    _run("pre_publish", child, out)
    assert "child.usda: cooked; head5.usdz changed" in capsys.readouterr().out
    assert child.read_bytes() != first
    published = {path.name: path.read_bytes() for path in out.iterdir()}
    assert sorted(published) == ["child.glb", "child.onnx", "child.onnx.json"]
    found = [one for name in ("child.glb", "child.onnx") for one in validate(out / name)]
    assert [one for one in found if one.severity == "error"] == []
    child.write_text(child.read_text().replace('upAxis = "Y"', 'upAxis = "X"'))
    publish = _names_of("pre_publish")["main"]
    assert publish([str(child), str(out)]) == 1
    heads[0].unlink()
    assert publish([str(child), str(out)]) == 2
    assert {path.name: path.read_bytes() for path in out.iterdir()} == published


def test_a_publish_that_cannot_begin_ends_with_one_line(tmp_path: Path, capsys: Capsys) -> None:
    head = tmp_path / "head0.usdz"
    save_parts(make(0), head)
    publish = _names_of("pre_publish")["main"]
    for words in ((head, tmp_path / "nowhere"), (tmp_path / "none.usda", tmp_path)):
        code = publish([str(word) for word in words])
        out, err = capsys.readouterr()
        assert (code, err.count("\n"), out) == (2, 1, ""), err
    assert publish([str(head)]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["head0.usdz"]
