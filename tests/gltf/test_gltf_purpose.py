"""Files for games, the web and film: what is in them, that it is the same person, and what is told of it."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import gltf_reader
import numpy as np
import pytest
from facepipe_gltf import Options, export
from facepipe_gltf.atlas import Atlas
from facepipe_gltf.merging import merged
from facepipe_gltf.read import Options as ReadOptions
from facepipe_gltf.read import read
from faces import grid_mesh, painted_face, replace_mesh, tiny_face
from gltf_export import Parts
from node import HERE, node_packages, three_load
from PIL import Image
from scipy.spatial import cKDTree
from textures import picture, textured

from facepipe.core.reports import ExportReport
from facepipe.heads import make
from facepipe.parts import (
    Blendshape,
    FaceParts,
    Inbetween,
    Material,
    Mesh,
    Skeleton,
    Skin,
    Texture,
    TextureInput,
    UvSet,
)
from facepipe.rig import build
from facepipe.rig.conventions import ARKIT_SHAPES

MM = 1000.0


@cache
def person() -> FaceParts:
    return make(5, textures=128)


def exported(folder: Path, parts: FaceParts | None = None, **options: Any) -> tuple[gltf_reader.Gltf, ExportReport]:
    options = {"purpose": "game", "engine": "unreal"} | options
    report = export(Parts(parts or person()), folder / "person.glb", Options(**options))
    return gltf_reader.read(report.path), report


@pytest.fixture(scope="module")
def game(tmp_path_factory: pytest.TempPathFactory) -> tuple[gltf_reader.Gltf, ExportReport]:
    return exported(tmp_path_factory.mktemp("game"))


def test_a_game_gets_one_finished_person(game: tuple[gltf_reader.Gltf, ExportReport]) -> None:
    file, report = game
    assert {mesh["name"] for mesh in file.list("meshes")} == {"Head", "Mouth", "Eyes", "Hair"}
    primitives = [primitive for mesh in file.list("meshes") for primitive in mesh["primitives"]]
    assert len(primitives) == len(file.list("materials")) == report.counts["materials"] <= 8
    assert set(file.targets("Head")) >= ARKIT_SHAPES
    assert report.counts["shapes"] == len(ARKIT_SHAPES)
    assert not any("_FACEPIPE_POINT" in primitive["attributes"] for primitive in primitives)
    assert "extras" not in file.json
    assert "52 of 131 shapes, of expressions (--customisable keeps all)" in report.chosen
    assert "8 meshes and 13 materials as 4 and 7" in report.chosen
    assert {"--quantize", "--texture-format jpeg --texture-size 1024"} <= set(report.chosen)


def test_its_points_move_as_the_face_moves(game: tuple[gltf_reader.Gltf, ExportReport], tmp_path: Path) -> None:
    """By millimetres: exact but for float32 where offsets are stored so; else each is off by half of a step of 0.03."""
    exact = exported(tmp_path, quantize=False)[1]
    for report, singly, together in ((exact, 1e-4, 1e-4), (game[1], 0.03, 0.05)):
        found = read(report.path, ReadOptions()).parts
        rigs = build(person()), build(found)
        units = MM * person().meters_per_unit, MM * found.meters_per_unit
        rest, own = (unit * rig.evaluate({}) for unit, rig in zip(units, rigs, strict=True))
        # points that lie on one another at rest may be of two lips or lids: what moves alike goes together
        away, twins = cKDTree(rest).query(own, k=6, distance_upper_bound=2e-3)
        assert away[:, 0].max() < 1e-3
        rng, names = np.random.default_rng(0), sorted(ARKIT_SHAPES)
        few = [{str(name): float(rng.random()) for name in rng.choice(names, 3, replace=False)} for _ in range(50)]
        for bound, poses in ((singly, [{name: 1.0} for name in names]), (together, few)):
            for weights in poses:
                moved, other = (unit * rig.evaluate(weights) for unit, rig in zip(units, rigs, strict=True))
                every = np.vstack([moved, np.full((1, 3), np.inf)])
                off = np.linalg.norm(every[twins] - other[:, None], axis=2).min(axis=1)
                assert off.max() < bound, weights


@pytest.mark.slow
def test_three_shows_the_same_person(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compressed as `--for web --engine three` has it: every vertex where a point of the face is."""
    node_packages()
    monkeypatch.setenv("NODE_PATH", str(HERE / "node_modules"))
    report = exported(tmp_path, purpose="web", engine="three")[1]
    assert "--meshopt" in report.chosen
    rig = build(person())
    weights = {"jawOpen": 1.0, "mouthSmileLeft": 1.0, "eyeBlinkRight": 1.0}
    rest, moved = (MM * person().meters_per_unit * rig.evaluate(one) for one in ({}, weights))
    own, other = (
        MM * np.concatenate([mesh["positions"] for mesh in three_load(report.path, one, {})["meshes"]])
        for one in ({}, weights)
    )
    away, twins = cKDTree(rest).query(own, k=6, distance_upper_bound=2e-3)
    assert away[:, 0].max() < 1e-3
    every = np.vstack([moved, np.full((1, 3), np.inf)])
    assert np.linalg.norm(every[twins] - other[:, None], axis=2).min(axis=1).max() < 0.05


def colours(parts: FaceParts, mesh: Mesh, points: np.ndarray) -> dict[str, np.ndarray]:
    """(n, 4) of the base colour at the corners of each material, with the places of these."""
    known = {material.name: material for material in parts.materials}
    corner_of = np.repeat(np.arange(len(mesh.face_vertex_counts)), mesh.face_vertex_counts)
    uv_set = mesh.uv_sets[0]
    uvs = uv_set.values[mesh.face_vertex_indices if uv_set.indices is None else uv_set.indices]
    faces = {one.material: one.faces for one in mesh.material_faces} or {
        mesh.material or "": np.arange(len(mesh.face_vertex_counts))
    }
    found = {}
    for name, own in faces.items():
        corners = np.isin(corner_of, own)
        used = known[name].diffuse_color
        assert isinstance(used, TextureInput)
        picture = np.asarray(Image.open(io.BytesIO(used.texture.data)).convert("RGBA")) / 255.0
        picture = (picture**2.2 * used.scale) ** (1 / 2.2)
        height, width = picture.shape[:2]
        u, v = np.moveaxis(uvs[corners] % 1.0, 1, 0)
        texels = picture[
            np.minimum((1 - v) * height, height - 1).astype(int), np.minimum(u * width, width - 1).astype(int)
        ]
        found[name] = np.column_stack([points[mesh.face_vertex_indices[corners]], texels])
    return found


def test_pictures_side_by_side_show_what_each_showed(game: tuple[gltf_reader.Gltf, ExportReport]) -> None:
    """At corners of teeth, gums and eyes: JPEG, and another size, change a colour by a few of 255."""
    found = read(game[1].path, ReadOptions()).parts
    for whole, names in (("Mouth", ("Teeth", "GumsAndTongue")), ("Eyes", ("EyeballLeft", "EyeballRight"))):
        one = next(mesh for mesh in found.meshes if mesh.name == whole)
        made = colours(found, one, MM * found.meters_per_unit * one.points)[whole]
        for name in names:
            mesh = next(mesh for mesh in person().meshes if mesh.name == name)
            for material, known in colours(person(), mesh, MM * person().meters_per_unit * mesh.points).items():
                if material == "Cornea":  # clear: it stays by itself
                    continue
                near = cKDTree(made[:, :3]).query(known[:, :3], distance_upper_bound=1e-2)[1]
                assert (near < len(made)).all()
                # a place on a seam has several colours: those of its own corners are among them
                off = np.abs(made[near, 3:6] - known[:, 3:6]).max(axis=1)
                assert np.median(off) < 0.03, material
                assert np.mean(off) < 0.06, material


def test_what_is_given_beside_it_holds(tmp_path: Path) -> None:
    file, report = exported(
        tmp_path, shapes="jawOpen", quantize=False, texture_format="kept", texture_size=None, purpose="web"
    )
    assert report.counts["shapes"] == 1
    assert "extensionsRequired" not in file.json
    data = {texture.data for material in person().materials for texture in material.textures}
    skin = next(i for i, image in enumerate(file.list("images")) if image["name"] == "skin_face")
    assert file.image(skin) in data
    whole, report = exported(tmp_path, customisable=True, engine="blender")
    assert report.counts["shapes"] == len(person().shapes)
    assert set(whole.targets("Head")) >= {shape.name for shape in person().meshes[0].blendshapes}


def test_the_web_gets_webp_where_it_is_read(tmp_path: Path) -> None:
    file, report = exported(tmp_path, purpose="web", engine="blender", texture_size=64)
    assert {image["mimeType"] for image in file.list("images")} == {"image/webp"}
    assert "EXT_texture_webp" in file.json["extensionsRequired"]
    assert all(max(Image.open(io.BytesIO(file.image(i))).size) <= 64 for i in range(len(file.list("images"))))
    assert read(report.path, ReadOptions()).parts.materials
    file, report = exported(tmp_path, purpose="web", engine="unreal")
    assert {image["mimeType"] for image in file.list("images")} == {"image/jpeg", "image/png"}
    assert "pictures as JPEG: Unreal (Interchange) reads no WebP" in report.chosen


def test_skin_alone_has_normals_of_targets(tmp_path: Path) -> None:
    """Where they are asked for by the engine, and the file is to be small."""

    def kinds(**options: Any) -> dict[str, set[str]]:
        file, _ = exported(tmp_path, engine="babylon", meshopt=False, **options)
        primitives = [(mesh["name"], one) for mesh in file.list("meshes") for one in mesh["primitives"]]
        return {name: {kind for target in one.get("targets", []) for kind in target} for name, one in primitives}

    game = kinds()
    assert game["Head"] == {"POSITION", "NORMAL"}
    assert game["Mouth"] == game["Hair"] == {"POSITION"}
    assert kinds(purpose="film")["GumsAndTongue"] == {"POSITION", "NORMAL"}


def test_pictures_that_are_made_of_several_are_packed_as_all(tmp_path: Path) -> None:
    """Of colour and opacity, and of roughness and metal, that come in files of their own."""
    rng = np.random.default_rng(0)
    face = painted_face(Image.fromarray(rng.integers(0, 255, (64, 64, 3), np.uint8)))
    noise = [picture(f"{number}.png", rng.integers(0, 255, (64, 64), np.uint8)) for number in range(3)]
    own = [textured(one, "r") for one in noise]
    material = replace(face.materials[0], opacity=own[0], roughness=own[1], metallic=own[2])
    for kind, mimes in (("jpeg", ["image/png", "image/jpeg"]), ("webp", ["image/webp"] * 2)):
        file, _ = exported(
            tmp_path, replace(face, materials=(material,)), purpose=None, engine="three", texture_format=kind
        )
        assert [image["mimeType"] for image in file.list("images")] == mimes
        if kind == "jpeg":
            assert Image.open(io.BytesIO(file.image(0))).mode == "P"


def test_pictures_change_without_a_purpose_too(tmp_path: Path) -> None:
    """A size alone keeps what each picture is; a format alone keeps its size."""
    plain, _ = exported(tmp_path, purpose=None)
    mimes = {image["name"]: image["mimeType"] for image in plain.list("images")}
    small, report = exported(tmp_path, purpose=None, texture_size=32)
    assert {image["name"]: image["mimeType"] for image in small.list("images")} == mimes
    assert max(map(max, sizes(small).values())) == 32 < max(map(max, sizes(plain).values()))
    assert report.chosen == ()
    for purpose in (None, "film"):
        file, report = exported(tmp_path, purpose=purpose, texture_format="jpeg")
        assert sizes(file) == sizes(plain)
        assert "image/jpeg" in {image["mimeType"] for image in file.list("images")}
    assert "--texture-format jpeg" in report.chosen


def sizes(file: gltf_reader.Gltf) -> dict[str, tuple[int, int]]:
    """By the name of an image."""
    images = enumerate(file.list("images"))
    return {image["name"]: Image.open(io.BytesIO(file.image(number))).size for number, image in images}


def test_film_gets_everything(tmp_path: Path) -> None:
    file, report = exported(tmp_path, purpose="film")
    assert report.counts["shapes"] == len(person().shapes)
    assert report.counts["animations"] == len(person().animations) > 0
    assert "facepipe" in file.json["extras"]
    assert report.chosen == ("--animations",)


def test_pictures_of_lower_levels_are_smaller() -> None:
    game = Options(purpose="game")
    assert [game.at_level(level).texture_size for level in (0, 1, 2)] == [None, 512, 256]
    assert Options(purpose="game", texture_size=400).at_level(2).texture_size == 400
    assert Options().at_level(2) == Options()
    assert Options(purpose="film").at_level(2) == Options(purpose="film")


def test_shapes_without_names_of_a_table_all_stay(tmp_path: Path) -> None:
    parts = tiny_face()
    names = {shape: f"zz{number}" for number, shape in enumerate(parts.shapes)}
    meshes = tuple(
        replace_mesh(mesh, blendshapes=tuple(replace(shape, name=names[shape.name]) for shape in mesh.blendshapes))
        for mesh in parts.meshes
    )
    parts = replace(parts, meshes=meshes, sliders=(), animations=(), slider_network=None)
    _, report = exported(tmp_path, parts)
    assert report.counts["shapes"] == len(names)
    assert any(f"all {len(names)} shapes: none has a name" in line for line in report.chosen)


def saved(picture: Image.Image, kind: str) -> bytes:
    stream = io.BytesIO()
    picture.save(stream, format=kind)
    return stream.getvalue()


DEEP = np.arange(64, dtype=np.uint16).reshape(8, 8) * 1024
ODD = {
    "deep.png": saved(Image.fromarray(DEEP), "PNG"),
    "print.jpg": saved(Image.new("CMYK", (40, 24), (10, 200, 30, 0)), "JPEG"),
    "dot.png": saved(Image.new("RGB", (1, 1), (200, 20, 90)), "PNG"),
    "palette.png": saved(Image.new("P", (9, 5), 1), "PNG"),
}


@pytest.mark.parametrize("name", ODD)
def test_odd_pictures_are_made_anew(name: str, tmp_path: Path) -> None:
    source = textured(Texture(name=name, data=ODD[name]))
    material = Material(name="skin", diffuse_color=source)
    mesh = replace_mesh(grid_mesh(size=8), material="skin")
    file, report = exported(tmp_path, FaceParts(name="Face", meshes=(mesh,), materials=(material,)), texture_size=16)
    made = Image.open(io.BytesIO(file.image(0)))
    known = Image.open(io.BytesIO(ODD[name]))
    assert made.mode == "RGB"
    assert max(made.size) <= 16
    assert not [line for line in report.warnings if "texture" in line]
    if name == "deep.png":
        expected = np.repeat((DEEP >> 8).astype(np.uint8)[..., None], 3, axis=2)
    else:
        expected = np.asarray(known.convert("RGB").resize(made.size))
    assert np.abs(np.asarray(made).astype(int) - expected).max() < 12


def test_a_picture_that_cannot_be_read_is_told(tmp_path: Path) -> None:
    material = Material(name="skin", diffuse_color=textured(Texture(name="cut.png", data=ODD["dot.png"][:40])))
    mesh = replace_mesh(grid_mesh(size=8), material="skin")
    _, report = exported(tmp_path, FaceParts(name="Face", meshes=(mesh,), materials=(material,)))
    assert any("cut.png" in line for line in report.warnings)


def test_meshes_of_a_role_become_one_with_all_that_they_have() -> None:
    """Shapes of one name with inbetweens at other weights, influences of other counts, UVs of points and of corners."""
    rng = np.random.default_rng(0)
    meshes = []
    for number, (weight, influences) in enumerate(((0.25, 1), (0.5, 3))):
        grid = grid_mesh(size=4)
        count = len(grid.points)
        offsets = rng.normal(size=(3, count, 3))
        shape = Blendshape(
            name="jawOpen",
            point_indices=np.arange(count, dtype=np.int32),
            offsets=offsets[0],
            normal_offsets=offsets[1],
            inbetweens=(Inbetween(name="mid", weight=weight, offsets=offsets[2], normal_offsets=offsets[1] / 2),),
        )
        weights = rng.random((count, influences)) + 0.1
        skin = Skin(
            joint_indices=np.tile(np.arange(influences, dtype=np.int32), (count, 1)),
            joint_weights=weights / weights.sum(axis=1, keepdims=True),
        )
        uvs = UvSet(values=rng.random((count, 2)))
        if number:
            uvs = UvSet(values=uvs.values[grid.face_vertex_indices], indices=np.arange(len(grid.face_vertex_indices)))
        changed = {"uv_sets": (uvs,), "skin": skin, "blendshapes": (shape,), "regions": {"mouth": np.ones(count)}}
        meshes.append(replace_mesh(grid, name=f"Part{number}", material=f"m{number}", **changed))
    materials = tuple(Material(name=f"m{number}", diffuse_color=(0.2 + 0.5 * number,) * 3) for number in range(2))
    skeleton = Skeleton(
        joints=("a", "b", "c"),
        bind_transforms=np.tile(np.eye(4), (3, 1, 1)),
        rest_transforms=np.tile(np.eye(4), (3, 1, 1)),
    )
    parts = FaceParts(name="Face", meshes=tuple(meshes), materials=materials, skeleton=skeleton)
    whole = merged(parts)
    (one,) = whole.meshes
    assert one.name == one.material == "Mouth"
    assert [material.name for material in whole.materials] == ["Mouth"]
    count = len(meshes[0].points)
    for weights in ({}, {"jawOpen": 0.25}, {"jawOpen": 0.4}, {"jawOpen": 0.5}, {"jawOpen": 1.0}):
        coefficients = np.tile([0.0] * 6 + [1.0] * 3, (3, 1))
        coefficients[:, :3] = rng.normal(size=(3, 3))
        moved = [build(face).evaluate(weights, coefficients=coefficients) for face in (parts, whole)]
        np.testing.assert_allclose(*moved, atol=1e-9)
    (shape,) = one.blendshapes
    assert [between.weight for between in shape.inbetweens] == [0.25, 0.5]
    assert len({between.name for between in shape.inbetweens}) == 2
    np.testing.assert_allclose(shape.normal_offsets[:count], meshes[0].blendshapes[0].normal_offsets)
    apart = replace_mesh(meshes[1], transform=np.diag([2.0, 2.0, 2.0, 1.0]))
    assert len(merged(replace(parts, meshes=(meshes[0], apart))).meshes) == 2


def test_cells_of_an_atlas_do_not_reach_into_one_another() -> None:
    materials = [
        Material(
            name=str(number),
            diffuse_color=textured(Texture(name=f"{number}.png", data=saved(Image.new("RGB", (64, 64), color), "PNG"))),
            roughness=0.2 * number,
        )
        for number, color in enumerate([(255, 0, 0), (0, 255, 0), (0, 0, 255)])
    ]
    atlas = Atlas(materials, "st")
    made = atlas.material("All")
    assert isinstance(made.diffuse_color, TextureInput)
    assert isinstance(made.roughness, TextureInput)
    assert made.metallic == 0.0
    colour, rough = (
        np.asarray(Image.open(io.BytesIO(used.texture.data))) for used in (made.diffuse_color, made.roughness)
    )
    for number in range(3):
        ends = atlas.uvs(number, np.array([[0.0, 0.0], [1.0, 1.0], [0.5, 0.5]]))
        for u, v in ends:
            texel = int((1 - v) * len(colour)), int(u * len(colour))
            assert colour[texel].argmax() == number
            assert abs(rough[texel][1] - 51 * number) <= 1
