"""What the exporter writes, the importer brings back: points, shapes with inbetweens, joints, weights, poses, UVs."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import operator
import random
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small_head as sample
from facepipe_gltf import Options, save, write
from facepipe_gltf import read as gltf
from facepipe_gltf.record_format import content_digest, stepped, steps_between
from faces import tiny_face
from import_data import shared
from parts_differences import differences

import facepipe
from facepipe.core.errors import FacepipeError
from facepipe.geometry.polygons import triangulate
from facepipe.importers import ict, makehuman
from facepipe.parts import (
    Animation,
    BoneLimits,
    FaceParts,
    FloatArray,
    IntArray,
    Material,
    MaterialFaces,
    Mesh,
    Recipe,
    Slider,
    SliderNetwork,
)
from facepipe.rig import build, rest_coefficients
from facepipe.stage import save_parts
from facepipe.stage.recipes import Imported

FACES = ("tiny", "sample")


@cache
def face(name: str) -> FaceParts:
    return tiny_face() if name == "tiny" else sample.make()


def staged(parts: FaceParts, folder: Path) -> FaceParts:
    """The face in the precision of a stage."""
    save_parts(parts, folder / "face.usdc")
    return facepipe.open(folder / "face.usdc").parts()


def there_and_back(parts: FaceParts, path: Path, options: Options | None = None) -> FaceParts:
    save(write(parts, options or Options(influences=8, animations=True)), path)
    return gltf.read(path, gltf.Options()).parts


def test_steps_go_from_one_float32_to_the_next_and_both_zeros_are_one() -> None:
    least = np.float32(2.0**-149)
    values = np.array([-1.0, -least, -0.0, 0.0, least, 1.0], np.float32)
    above, below = np.nextafter(values, np.float32(2)), np.nextafter(values, np.float32(-2))
    np.testing.assert_array_equal(steps_between(values, above), np.ones(6))
    np.testing.assert_array_equal(steps_between(values, below), -np.ones(6))
    np.testing.assert_array_equal(stepped(values, np.ones(6)), above)
    np.testing.assert_array_equal(stepped(values, -np.ones(6)), below)


@pytest.mark.parametrize("name", FACES)
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_poses_and_shapes_deform_the_same_points(name: str, suffix: str, tmp_path: Path) -> None:
    before = face(name)
    after = there_and_back(before, tmp_path / f"face{suffix}")
    unit = before.meters_per_unit
    assert after.skeleton.joints == before.skeleton.joints
    assert [mesh.name for mesh in after.meshes] == [mesh.name for mesh in before.meshes]
    one, other = build(before), build(after)
    assert other.shapes == one.shapes
    height = float(np.ptp(one.points[:, 1])) * unit
    generator = np.random.default_rng(0)
    for _ in range(10):
        weights = {shape: float(generator.uniform(-0.2, 1.2)) for shape in one.shapes}
        coefficients = rest_coefficients(len(one.joints)) + generator.normal(size=(len(one.joints), 9)) * 0.02
        coefficients[:, :3] /= unit
        expected = one.evaluate(weights, coefficients=coefficients)
        assert np.abs(other.evaluate(weights, coefficients=coefficients) - expected).max() * unit < 1e-5 * height


@pytest.mark.parametrize("name", FACES)
def test_surface_comes_back(name: str, tmp_path: Path) -> None:
    before = face(name)
    after = there_and_back(before, tmp_path / "face.glb")
    for old, new in zip(before.meshes, after.meshes, strict=True):
        (triangles, uvs), (triangles_back, uvs_back) = surface(old), surface(new)
        assert np.array_equal(triangles, triangles_back)
        assert len(uvs) == len(uvs_back)
        for one, other in zip(uvs, uvs_back, strict=True):
            assert np.abs(one - other).max() < 1e-6


def surface(mesh: Mesh) -> tuple[IntArray, list[FloatArray]]:
    """Triangles (t, 3) of points in a canonical order, their sides kept, and the UVs (t, 3, 2) of their corners."""
    corners = triangulate(mesh.face_vertex_counts).corners
    points = mesh.face_vertex_indices[corners]
    turn = (np.argmin(points, axis=1)[:, None] + np.arange(3)) % 3
    points, corners = np.take_along_axis(points, turn, axis=1), np.take_along_axis(corners, turn, axis=1)
    order = np.lexsort(points.T)
    uvs = [
        uv_set.values[(mesh.face_vertex_indices if uv_set.indices is None else uv_set.indices)[corners[order]]]
        for uv_set in mesh.uv_sets
    ]
    return points[order], uvs


def test_animations_and_materials_come_back(tmp_path: Path) -> None:
    before = face("sample")
    after = there_and_back(before, tmp_path / "face.glb")
    assert [animation.name for animation in after.animations] == [animation.name for animation in before.animations]
    materials = {material.name: material for material in after.materials}
    assert sorted(materials) == sorted(material.name for material in before.materials)
    for old in before.materials:
        new = materials[old.name]
        if isinstance(old.diffuse_color, tuple):
            assert np.allclose(np.array(new.diffuse_color), old.diffuse_color, atol=1e-6)
    for old_mesh, new_mesh in zip(before.meshes, after.meshes, strict=True):
        assert triangles_of(new_mesh) == triangles_of(old_mesh)


def triangles_of(mesh: Mesh) -> dict[str | None, int]:
    """How many triangles show each material."""
    material = np.full(len(mesh.face_vertex_counts), mesh.material, object)
    for material_face in mesh.material_faces:
        material[material_face.faces] = material_face.material
    return dict(Counter(material[triangulate(mesh.face_vertex_counts).faces]))


@pytest.mark.parametrize("name", FACES)
def test_second_trip_changes_nothing(name: str, tmp_path: Path) -> None:
    once = there_and_back(face(name), tmp_path / "once.glb")
    twice = there_and_back(once, tmp_path / "twice.glb")
    for one, other in zip(once.meshes, twice.meshes, strict=True):
        assert np.array_equal(one.points, other.points)
        assert np.array_equal(surface(one)[0], surface(other)[0])
        for shape, again in zip(one.blendshapes, other.blendshapes, strict=True):
            assert np.array_equal(shape.point_indices, again.point_indices)
            assert np.array_equal(shape.offsets, again.offsets)
            assert [x.weight for x in shape.inbetweens] == [x.weight for x in again.inbetweens]


def test_quantised_export_stays_within_its_own_error(tmp_path: Path) -> None:
    before = face("sample")
    document = write(before, Options(influences=8, quantize=True))
    save(document, tmp_path / "face.glb")
    one, other = build(before), build(gltf.read(tmp_path / "face.glb", gltf.Options()).parts)
    assert document.error_mm is not None
    for weights in ({}, dict.fromkeys(one.shapes[:3], 0.7)):
        apart = np.linalg.norm(one.evaluate(weights) - other.evaluate(weights), axis=1) * before.meters_per_unit
        assert apart.max() * 1000 <= 2 * document.error_mm + 1e-3


@pytest.mark.parametrize("name", FACES)
def test_our_own_file_is_the_same_face(name: str, tmp_path: Path) -> None:
    before = staged(face(name), tmp_path)
    after = there_and_back(before, tmp_path / "once.glb")
    recipe = after.recipe
    assert recipe is not None
    assert recipe.verb == "import gltf"
    assert recipe.options["made"] == (None if before.recipe is None else dataclasses.asdict(before.recipe))
    assert differences(before, replace(after, recipe=before.recipe), 1e-6) == []
    still = Options(influences=8)  # turns in clips get unit length each time, and so other last bits
    there_and_back(there_and_back(before, tmp_path / "once.glb", still), tmp_path / "twice.glb", still)
    assert (tmp_path / "once.glb").read_bytes() == (tmp_path / "twice.glb").read_bytes()


def odd_face() -> FaceParts:
    """Z up in decimetres, the skeleton and a mesh scaled unevenly, a point that no face uses, materials by face."""
    parts = tiny_face()
    head, teeth = parts.meshes
    uneven = np.array([[0.0, -1.2, 0.0, 3.0], [0.9, 0.0, 0.0, -1.0], [0.0, 0.0, 1.1, 0.5], [0.0, 0.0, 0.0, 1.0]])
    assert head.skin is not None
    shown = replace(
        head,
        face_vertex_counts=np.array([4] * 23 + [3], np.int32),
        face_vertex_indices=head.face_vertex_indices[4:-1],
        skin=replace(head.skin, geom_bind_transform=uneven),
        material="skin",
        material_faces=(MaterialFaces(material="lips", faces=np.array([3, 4, 9], np.int32)),),
        colors=np.linspace(0, 1, 108, dtype=np.float32).reshape(36, 3),
        normals=np.tile(np.float32([0.0, 0.6, 0.8]), (95, 1)),
    )
    return replace(
        parts,
        up_axis="Z",
        meters_per_unit=0.1,
        skeleton=replace(parts.skeleton, name="Bones", transform=np.diag([2.0, 2.0, 2.0, 1.0])),
        meshes=(shown, replace(teeth, transform=uneven @ np.diag([1.0, -1.0, 1.0, 1.0]))),
        materials=(
            Material(name="skin"),
            Material(name="lips", ior=1.4, clearcoat=0.5, clearcoat_roughness=0.1),
            Material(name="spare"),
        ),
        animations=(
            Animation(
                name="talk",
                times=np.array([0.0, 0.5, 1.0]),
                joints=("root/jaw",),
                coefficients=np.array([[[0, 0.1 * t, 0, 0.1 * t, 0, 0, 1, 1, 1]] for t in range(3)], np.float32),
                shapes=("jawOpen",),
                shape_weights=np.array([[0.0], [0.8], [0.2]], np.float32),
            ),
        ),
        attach_joint="body/neck",
        attribution="© someone",
        bone_limits=BoneLimits(lower=np.full((3, 9), -0.5), upper=np.full((3, 9), 1.5)),
        sliders=(
            Slider(name="open", shapes=(("jawOpen", 0.5),), shape_curves=(((0.0, 0.0), (1.0, 2.0)),), group="mouth"),
            Slider(name="jaw", channels=(("root/jaw", "rx", 0.1),), minimum=-1.0, value=0.25),
        ),
        slider_network=SliderNetwork(
            sliders=("open", "jaw"),
            channels=(("root/jaw", "tz"),),
            weights=(np.float32([[0.1, 0.2]]),),
            biases=(np.float32([0.3]),),
            info={"steps": 5},
        ),
        recipe=Recipe(verb="blend", sources=("a.usda",), digests=("sha256:0",), options={"weights": [0.5, 0.5]}),
    )


def test_units_axes_transforms_and_loose_points_come_back(tmp_path: Path) -> None:
    before = staged(odd_face(), tmp_path)
    after = there_and_back(before, tmp_path / "once.glb")
    loose = differences(before, replace(after, recipe=before.recipe), 1e-6)
    assert [line.partition(":")[0] for line in loose] == [  # of the one point that no face uses
        "meshes.Head.skin.joint_indices",
        "meshes.Head.skin.joint_weights",
        "meshes.Head.blendshapes.mouthSmileLeft.point_indices",
        "meshes.Head.blendshapes.mouthSmileLeft.offsets",
    ]
    save_parts(after, tmp_path / "again.usda")
    assert facepipe.open(tmp_path / "again.usda").parts().animations[0].times is not None
    one, other = build(before), build(after)
    apart = one.evaluate({"jawOpen": 0.6}) - other.evaluate({"jawOpen": 0.6})
    assert np.abs(np.delete(apart, 0, axis=0)).max() < 1e-5
    still = Options(influences=8)  # turns in clips get unit length each time, and so other last bits
    there_and_back(there_and_back(before, tmp_path / "once.glb", still), tmp_path / "twice.glb", still)
    assert (tmp_path / "once.glb").read_bytes() == (tmp_path / "twice.glb").read_bytes()


def edited(path: Path, edit: Callable[[dict[str, Any]], object], *, hidden: bool = False) -> Imported:
    """What the importer makes of a .gltf that another program has edited; `hidden`: and made the digest again."""
    document = json.loads(path.read_text())
    edit(document)
    if hidden:
        document["extras"]["facepipe"]["digest"] = content_digest(document)
    path.write_text(json.dumps(document))
    return gltf.read(path, gltf.Options())


def attributes(file: dict[str, Any]) -> dict[str, int]:
    found: dict[str, int] = file["meshes"][0]["primitives"][0]["attributes"]
    return found


@pytest.mark.parametrize(
    ("edit", "what"),
    [
        (lambda file: file["extras"]["facepipe"].update(bufferView=0), "damaged"),
        (lambda file: file["extras"]["facepipe"].update(inflated=10**6), "expected 1000000"),
        (lambda file: file["extras"]["facepipe"].update(version=9), "version 9"),
        (lambda file: file["extras"].update(facepipe={}), "no version"),
        (lambda file: file["scenes"][0]["nodes"].pop(1), "1 meshes, expected 2"),
        (lambda file: file["nodes"][3].update(translation=[1, 2, 3]), "joints moved by another program"),
        (
            lambda file: file["meshes"][0]["primitives"][0]["attributes"].pop("_FACEPIPE_POINT"),
            "_FACEPIPE_POINT is gone",
        ),
    ],
)
def test_an_edited_file_is_read_as_plain_gltf(
    edit: Callable[[dict[str, Any]], object], what: str, tmp_path: Path
) -> None:
    save(write(tiny_face(), Options(influences=8)), tmp_path / "face.gltf")
    imported = edited(tmp_path / "face.gltf", edit, hidden=True)
    (line,) = [line for line in imported.warnings if "what glTF has no place for is left out" in line]
    assert what in line
    assert imported.parts.meters_per_unit == 1.0
    assert not any(mesh.regions for mesh in imported.parts.meshes)


@pytest.mark.parametrize("seed", range(6))
def test_a_damaged_record_is_refused_in_words(seed: int, tmp_path: Path) -> None:
    """Whatever stands in it, the file is read as it was, as plain glTF, or refused by an error of ours."""
    path = tmp_path / "face.gltf"
    save(write(odd_face(), Options(influences=8, animations=True)), path)
    document = json.loads(path.read_text())
    buffer = path.with_name(document["buffers"][0]["uri"])
    said = document["extras"]["facepipe"]
    view = document["bufferViews"][said["bufferView"]]
    block = zlib.decompressobj().decompress(buffer.read_bytes()[view["byteOffset"] :])
    (length,) = struct.unpack_from("<I", block)
    generator = random.Random(seed)
    for _ in range(8):
        record = json.loads(block[4 : 4 + length])
        *way, last = generator.choice(list(places(record)))
        functools.reduce(operator.getitem, way, record)[last] = generator.choice(DAMAGE)
        text = json.dumps(record).encode()
        damaged = struct.pack("<I", len(text)) + text + block[4 + length :]
        data = buffer.read_bytes()[: view["byteOffset"]] + zlib.compress(damaged)
        (tmp_path / "damaged.bin").write_bytes(data)
        said["inflated"], view["byteLength"] = len(damaged), len(data) - view["byteOffset"]
        document["buffers"] = [{"byteLength": len(data), "uri": "damaged.bin"}]
        path.write_text(json.dumps(document))
        with contextlib.suppress(FacepipeError):
            save_parts(gltf.read(path, gltf.Options()).parts, tmp_path / "face.usda")


DAMAGE = (
    None, 0, -1, 1.5, 1e30, "x", "", [], {}, [1], ["a", "b"], True,
    {"array": ["f", 0, [3, 3]]}, {"array": ["i", 0, [4]]}, {"array": ["d", 0, [4, 4]]}, {"array": ["b", 0, [36, 3]]},
    {"array": ["f", 10**9, [3]]}, {"array": ["f", 0, [2**30, 2**30, 2]]}, {"array": [{}, 0, []]},
)  # fmt: skip


def places(value: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The ways to all values within a JSON value."""
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in pairs:
        yield (*way, key)
        yield from places(inner, (*way, key))


@pytest.mark.parametrize(
    "edit",
    [
        lambda file: file["meshes"][0]["extras"]["targetNames"].reverse(),
        lambda file: file["nodes"][0].update(name="face"),
        lambda file: file["nodes"][3].update(translation=[0, 0, 1e-3]),
        lambda file: file["materials"][0]["pbrMetallicRoughness"].update(baseColorFactor=[1, 0, 0, 1]),
    ],
)
def test_edits_of_another_program_win_over_the_record(edit: Callable[[dict[str, Any]], object], tmp_path: Path) -> None:
    path = tmp_path / "face.gltf"
    save(write(tiny_face(), Options(influences=8)), path)
    text = path.read_text()
    path.write_text(json.dumps(json.loads(text, parse_float=whole), indent=2))  # as JavaScript writes numbers
    assert edited(path, lambda file: None).parts.meters_per_unit == tiny_face().meters_per_unit
    assert path.write_text(text)
    imported = edited(path, edit)
    assert imported.parts.meters_per_unit == 1.0
    assert any("another program has changed the file since facepipe wrote it" in line for line in imported.warnings)


def whole(text: str) -> float | int:
    return int(float(text)) if float(text).is_integer() else float(text)


def real_face(name: str) -> FaceParts:
    if name == "ict":
        return ict.read(shared("ict_facekit/ict_facekit.npz"), ict.Options()).parts
    return makehuman.read(shared("makehuman/makehuman_head.npz"), makehuman.Options()).parts


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ict", "makehuman"])
def test_real_faces_come_back_the_same(name: str, tmp_path: Path) -> None:
    before = staged(real_face(name), tmp_path)
    after = there_and_back(before, tmp_path / "once.glb")
    left = differences(before, replace(after, recipe=before.recipe), 1e-6)
    assert all(line.startswith(("meshes.Head.skin.", "meshes.Tongue.skin.")) for line in left), left  # nine influences
    assert not left or name == "makehuman"
    if name == "ict":  # clips come back to float32: no bytes
        there_and_back(after, tmp_path / "twice.glb")
        assert (tmp_path / "once.glb").read_bytes() == (tmp_path / "twice.glb").read_bytes()
