"""FBX files that are damaged, or ask for what no face needs: one line, in bounded memory and time."""

from __future__ import annotations

import struct
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fbx_files import Scene, binary, full_scene, layer, layers, node, property70
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from import_data import damaged

from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.policy.bounds import MOST_OF
from facepipe.importers import load

pytest.importorskip("wasmtime")

GOOD = full_scene().binary()
PLAIN = full_scene().binary(deflate=False)


def refusal(data: bytes, folder: Path) -> str:
    source = folder / "face.fbx"
    source.write_bytes(data)
    with pytest.raises(InputError) as caught:
        load("fbx", source)
    assert str(caught.value).startswith("face.fbx")
    assert "\n" not in str(caught.value)
    return str(caught.value)


def triangle(**given: Any) -> tuple[Scene, int, int]:
    scene = Scene(**given)
    model = scene.model("Head", of="Mesh")
    return scene, model, scene.mesh(model, np.eye(3), [[0, 1, 2]])


@pytest.mark.parametrize("data", [b"", b"hello", b"PK\x03\x04" + bytes(99), b"Kaydara FBX Binary  \0\x1a\0"])
def test_what_is_no_fbx_is_refused(data: bytes, tmp_path: Path) -> None:
    assert "can't be read as FBX" in refusal(data, tmp_path)


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3, 0.5, 0.7, 0.9])
def test_what_is_cut_short_is_refused(share: float, tmp_path: Path) -> None:
    assert "can't be read as FBX" in refusal(GOOD[: int(share * len(GOOD))], tmp_path)


@given(data=st.data())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damage_is_read_or_refused_in_one_line(data: st.DataObject, tmp_path: Path) -> None:
    source = tmp_path / "face.fbx"
    source.write_bytes(data.draw(damaged(data.draw(st.sampled_from([GOOD, PLAIN])))))
    said = ""
    try:
        load("fbx", source)
    except FacepipeError as error:
        said = str(error)
    assert "\n" not in said


@pytest.mark.parametrize("count", [1 << 24, (1 << 28) - 1, (1 << 31) - 1])
@pytest.mark.parametrize("good", [GOOD, PLAIN], ids=["deflated", "plain"])
def test_arrays_are_no_longer_than_the_file(good: bytes, count: int, tmp_path: Path) -> None:
    at = good.index(b"Vertices") + len("Vertices") + 1
    refusal(good[:at] + struct.pack("<I", count) + good[at + 4 :], tmp_path)


def test_arrays_that_unfold_to_gigabytes_are_refused(tmp_path: Path) -> None:
    whole = np.zeros(1 << 22)  # 32 MiB deflate to 32 KiB; the header of the array says 64 times as much
    scene = Scene()
    scene.mesh(scene.model("Head", of="Mesh"), whole.reshape(-1)[: len(whole) // 3 * 3].reshape(-1, 3), [[0, 1, 2]])
    data = scene.binary()
    at = data.index(b"Vertices") + len("Vertices") + 1
    tracemalloc.start()
    refusal(data[:at] + struct.pack("<I", len(whole) * 64) + data[at + 4 :], tmp_path)
    assert tracemalloc.get_traced_memory()[1] < 1 << 24  # what the module takes has a cap of its own
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("place", "number"),
    [
        (place, number)
        for place in ("Vertices", "Weights", "Transform", "UV", "Normals")
        for number in (np.nan, np.inf, -np.inf, 1e30)
        if (place, number) != ("Weights", 1e30)  # a weight of any size is normalised
    ],
)
def test_numbers_that_are_none_are_refused(place: str, number: float, tmp_path: Path) -> None:
    nodes = full_scene().nodes()

    def change(listed: Any) -> None:
        for one in listed:
            if one.name == place and one.values and isinstance(one.values[0], np.ndarray):
                one.values[0][0] = number
            change(one.children)

    change(nodes)
    refusal(binary(nodes), tmp_path)


def test_circles_of_nodes_are_refused(tmp_path: Path) -> None:
    scene, model, _ = triangle()
    above = scene.model("above")
    below = scene.model("below", above)
    scene.link(above, below)
    scene.link(model, below)
    assert "Cyclic" in refusal(scene.binary(), tmp_path)


def test_chains_of_nodes_have_an_end(tmp_path: Path) -> None:
    scene, model, _ = triangle()
    for _ in range(600):
        above = scene.model("n", 0, "LimbNode")
        scene.link(model, above)
        model = above
    assert "depth" in refusal(scene.binary(), tmp_path)


def test_a_mesh_that_thousands_show_counts_each_time(tmp_path: Path) -> None:
    scene = Scene()
    model = scene.model("Head", of="Mesh")
    geometry = scene.mesh(model, np.zeros((100_000, 3)), [[0, 1, 2]])
    for number in range(1000):
        scene.link(geometry, scene.model(f"again {number}", of="Mesh"))
    assert "far more data than it holds" in refusal(scene.binary(), tmp_path)


@pytest.mark.parametrize("seconds", [1e6, 1e8])
def test_clips_without_end_are_refused(seconds: float, tmp_path: Path) -> None:
    scene, model, _ = triangle()
    scene.curves(scene.stack("long", 0, seconds), model, "Lcl Rotation", {"d|Z": [(0, 0), (seconds, 1)]})
    assert "far more data than it holds" in refusal(scene.binary(), tmp_path)


@pytest.mark.parametrize("unit", [0.0, -1.0, 1e12])
def test_a_unit_that_is_none_is_refused_unless_one_is_given(unit: float, tmp_path: Path) -> None:
    scene, *_ = triangle(unit=unit)
    assert "option meters_per_unit gives it" in refusal(scene.binary(), tmp_path)


def test_a_file_without_polygons_is_refused(tmp_path: Path) -> None:
    scene = Scene()
    scene.model("alone", of="LimbNode")
    assert refusal(scene.binary(), tmp_path) == "face.fbx: no mesh with polygons, expected one"


def test_offsets_of_points_that_are_not_there_are_named(tmp_path: Path) -> None:
    scene, _, geometry = triangle()
    scene.channel(scene.channels(geometry), "smile", [("smile", 100, [1, 9], [[0, 0, 1], [0, 0, 2]])])
    source = tmp_path / "face.fbx"
    source.write_bytes(scene.binary())
    imported = load("fbx", source)
    assert imported.parts.meshes[0].blendshapes[0].point_indices.tolist() == [1]
    assert imported.warnings == ("face.fbx -> Head: 1 offsets of points that it does not have: left out",)


def test_without_wasmtime_one_line_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wasmtime", None)
    source = tmp_path / "face.fbx"
    source.write_bytes(GOOD)
    with pytest.raises(InputError) as caught:
        load("fbx", source)
    assert str(caught.value) == "wasmtime: is not installed, expected `pip install 'facepipe[fbx]'`"


def test_names_of_any_script_and_length_are_kept(tmp_path: Path) -> None:
    scene = Scene()
    names = ["口を開ける", "a" * 300, "with :: in it", "/etc/passwd", "tab\there"]
    for name in names:
        scene.mesh(scene.model(name, of="Mesh"), np.eye(3), [[0, 1, 2]])
    source = tmp_path / "face.fbx"
    source.write_bytes(scene.binary())
    assert [mesh.label or mesh.name for mesh in load("fbx", source).parts.meshes] == names


def test_nodes_that_hold_nothing_do_no_harm(tmp_path: Path) -> None:
    nodes = triangle()[0].nodes()
    nodes[3].children += [
        node("Geometry"),
        node("Model", np.int64(5)),
        node("Deformer", np.int64(6), "x\0\x01Deformer", "Skin"),
    ]
    source = tmp_path / "face.fbx"
    source.write_bytes(binary(nodes))
    assert len(load("fbx", source).parts.meshes) == 1


@pytest.mark.parametrize("number", [1e30, 1e200, np.inf])
def test_colours_that_no_stage_holds_are_refused(number: float, tmp_path: Path) -> None:
    """Also where a factor makes them so: in a stage and in pictures numbers are float32."""
    scene, model, _ = triangle()
    listed = [property70(name, "Number", number) for name in ("DiffuseFactor", "EmissiveFactor")]
    scene.material(model, "skin", property70("EmissiveColor", "Color", number, 1.0, 1.0), *listed)
    assert "the material skin holds NaN, infinity or numbers over 1e+18" in refusal(scene.binary(), tmp_path)


def test_more_meshes_than_a_stage_holds_are_refused(tmp_path: Path) -> None:
    most = MOST_OF["Mesh"]
    scene, _, geometry = triangle()
    for _ in range(most):
        scene.link(geometry, scene.model("Head", of="Mesh"))
    assert f"{most + 1} prims of type Mesh, expected at most {most}" in refusal(scene.binary(), tmp_path)


def test_more_materials_than_a_stage_holds_are_refused(tmp_path: Path) -> None:
    scene, most = Scene(), MOST_OF["Material"]
    model = scene.model("Head", of="Mesh")
    slots = layer("Material", "ByPolygon", "IndexToDirect", node("Materials", np.arange(most + 1, dtype="i4")))
    scene.mesh(model, np.eye(3), [[0, 1, 2]] * (most + 1), slots, layers("Material"))
    for _ in range(most + 1):
        scene.material(model, "skin")
    assert f"{most + 1} prims of type Material, expected at most {most}" in refusal(scene.binary(), tmp_path)


def test_skins_that_all_bind_otherwise_are_named_once_each(tmp_path: Path) -> None:
    scene, count = Scene(), 300
    bones = [scene.model("bone", of="LimbNode") for _ in range(2)]
    for number in range(count):
        geometry = scene.mesh(scene.model(f"part {number}", of="Mesh"), np.eye(3), [[0, 1, 2]])
        ways = zip(bones, (np.eye(4), np.eye(4) + number * np.eye(4, k=3)), strict=True)
        scene.skin(geometry, [(bone, [0, 1, 2], [0.5] * 3, way, np.eye(4)) for bone, way in ways])
    source = tmp_path / "face.fbx"
    source.write_bytes(scene.binary())
    read = load("fbx", source)
    named = [line for line in read.warnings if "joints added" in line]
    assert named[:1] == ["face.fbx -> part 1: binds 1 joints otherwise than an earlier mesh: joints added"]
    assert len(named) == count - 1 == len(read.parts.skeleton.joints) - 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("minutes", "said"), [(8, ""), (60, "face.fbx: the file asks for far more data than it holds")]
)
def test_takes_of_minutes_are_read_however_few_keys_they_have(minutes: int, said: str, tmp_path: Path) -> None:
    scene, _, geometry = triangle()
    bones = [scene.model(f"bone {number}", of="LimbNode") for number in range(100)]
    scene.skin(geometry, [(bone, [0, 1, 2], [1.0] * 3, np.eye(4), np.eye(4)) for bone in bones])
    take = scene.stack("take", 0, 60 * minutes)
    for bone in bones:
        scene.curves(take, bone, "Lcl Rotation", {f"d|{axis}": [(0, 0), (60 * minutes, 90)] for axis in "XYZ"})
    if said:
        assert refusal(scene.binary(), tmp_path) == said
        return
    source = tmp_path / "face.fbx"
    source.write_bytes(scene.binary())
    (clip,) = load("fbx", source).parts.animations
    assert clip.times is not None
    assert len(clip.times) == 24 * 60 * minutes + 1
