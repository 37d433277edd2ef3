"""Compact glTF layouts and the engines that they are for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import failed
from facepipe_gltf.buffers import Encoding
from facepipe_gltf.options import ENGINES
from faces import replace_mesh, tiny_face
from gltf_export import (
    TOLERANCE,
    Writing,
    difference,
    head_height,
    motion,
    random_coefficients,
    random_weights,
    reference,
    writing,
    written,
)
from gltf_reader import Gltf, local_matrix
from import_data import shared
from node import node_packages, three_load
from placed_faces import FACES
from places import REPOSITORY

from facepipe.importers import load
from facepipe.parts import Blendshape, FaceParts
from facepipe.stage import save_parts

__all__ = ["writing", "written"]
SHORT, FLOAT = 5122, 5126


def shaped(count: int, reach: float, seed: int = 8) -> FaceParts:
    """A face with `count` shapes that move every point up to `reach` metres along each axis."""
    rng = np.random.default_rng(seed)
    face = tiny_face()
    points = np.arange(36, dtype=np.int32)
    offsets = rng.uniform(-1, 1, (count, 36, 3)) * reach / face.meters_per_unit
    shapes = tuple(Blendshape(name=f"shape{i}", point_indices=points, offsets=one) for i, one in enumerate(offsets))
    return replace(face, meshes=(replace_mesh(face.meshes[0], blendshapes=shapes),))


def stored_types(file: Gltf, name: str) -> set[int]:
    """Component types of an attribute of all morph targets."""
    targets = [t for mesh in file.list("meshes") for one in mesh["primitives"] for t in one.get("targets", [])]
    return {file.list("accessors")[target[name]]["componentType"] for target in targets if name in target}


@pytest.mark.parametrize("name", FACES)
def test_quantised_skins_have_the_nodes_and_binds_of_the_plain_ones(name: str, writing: Writing) -> None:
    """No scale hides anywhere: an importer that looks at nodes and binds alone sees one and the same skeleton."""
    plain, _ = writing(FACES[name]())
    compact, _ = writing(FACES[name](), "quantised.glb", quantize=True)
    assert compact.list("nodes") == plain.list("nodes")
    skin, other = plain.list("skins")[0], compact.list("skins")[0]
    binds = plain.stored(skin["inverseBindMatrices"]), compact.stored(other["inverseBindMatrices"])
    assert np.array_equal(*binds)
    for one, exact in zip(compact.list("meshes"), plain.list("meshes"), strict=True):
        accessor, expected = (mesh["primitives"][0]["attributes"]["POSITION"] for mesh in (one, exact))
        assert np.array_equal(compact.stored(accessor), plain.stored(expected))


@pytest.mark.parametrize("options", [{"quantize": True}, {"drop_deltas": 2.0}, {"quantize": True, "drop_deltas": 2.0}])
def test_the_error_holds_whatever_shapes_are_on(options: dict[str, Any], writing: Writing) -> None:
    parts = shaped(12, 0.01)
    file, report = writing(parts, **options)
    assert report.error_mm is not None
    names = [shape.name for shape in parts.meshes[0].blendshapes]
    rng = np.random.default_rng(1)
    worst = 0.0
    for number in range(1, 200):
        weights = dict(zip(names, rng.integers(0, 2, 12) if number < 150 else rng.random(12), strict=True))
        worst = max(worst, difference(file.evaluate(weights), reference(parts, weights), parts) * 1000)
    assert 0 < worst <= report.error_mm + 1e-5  # float32 itself
    assert report.error_mm < 2.5 * worst
    alone = max(difference(file.evaluate({name: 1.0}), reference(parts, {name: 1.0}), parts) for name in names) * 1000
    assert alone <= (2.0 if "drop_deltas" in options else 0.0) + (0.0265 if "quantize" in options else 1e-5)


def test_the_error_has_rounded_weights(writing: Writing) -> None:
    face = FACES["posed rest"]()
    parts = replace(face, meshes=(replace_mesh(face.meshes[0], blendshapes=()),))
    plain, _ = writing(parts, "plain.glb")
    file, report = writing(parts, quantize=True)
    assert report.error_mm is not None
    rng = np.random.default_rng(5)
    worst = 0.0
    for _ in range(50):
        moves = motion(parts, plain, random_coefficients(parts, rng, 0.1))
        worst = max(worst, 1000 * difference(file.evaluate(motion=moves), plain.evaluate(motion=moves), parts))
    assert 0 < worst <= report.error_mm < 1e-4 * head_height(parts) * 1000


def test_offsets_of_metres_stay_floats(writing: Writing) -> None:
    parts = shaped(2, 1.5)
    file, report = writing(parts, quantize=True)
    assert stored_types(file, "POSITION") == {FLOAT}
    assert report.error_mm is not None
    assert report.error_mm < 1e-4 * head_height(parts) * 1000  # of weights
    small, _ = writing(shaped(2, 0.5), "small.glb", quantize=True)
    assert stored_types(small, "POSITION") == {SHORT}


def test_short_offsets_are_left_out_and_the_others_kept(writing: Writing) -> None:
    parts = shaped(6, 0.01)
    plain, _ = writing(parts, "plain.glb")
    file, _ = writing(parts, drop_deltas=5.0)
    for number in range(6):
        given, kept = (
            one.decoded(one.mesh("Head")["primitives"][0]["targets"][number]["POSITION"]) for one in (plain, file)
        )
        long = np.linalg.norm(given, axis=1) >= 0.005
        assert 0 < long.sum() < len(long)
        assert np.array_equal(kept, given * long[:, None])


def test_quantised_weights_are_the_nearest_of_65535_steps_and_the_largest_takes_the_rest() -> None:
    weights = np.array([24576.25, 16383.75]) / 65535
    found = Encoding(quantize=True).weights(np.stack([1 - weights, weights], axis=1)).array
    assert found.tolist() == [[65535 - 24576, 24576], [65535 - 16384, 16384]]


@pytest.mark.parametrize("quantize", [False, True])
def test_dense_files_hold_the_same_without_sparse_accessors(quantize: bool, writing: Writing) -> None:
    parts = tiny_face()
    sparse, _ = writing(parts, quantize=quantize)
    dense, report = writing(parts, "dense.glb", dense=True, quantize=quantize)
    assert any("sparse" in one for one in sparse.list("accessors"))
    assert all("bufferView" in one and "sparse" not in one for one in dense.list("accessors"))
    assert report.counts["sparse accessors"] == 0
    weights = random_weights(parts, np.random.default_rng(2))
    expected = sparse.evaluate(weights)
    assert all(np.array_equal(points, expected[name]) for name, points in dense.evaluate(weights).items())


@pytest.mark.parametrize("engine", ENGINES)
def test_each_engine_gets_what_its_reader_takes(engine: str, writing: Writing) -> None:
    reader, parts = ENGINES[engine], FACES["placed, Z up"]()
    file, _ = writing(parts, engine=engine, quantize=reader.quantized)
    head = file.mesh("Head")["primitives"][0]
    assert reader.sparse or not any("sparse" in one for one in file.list("accessors"))
    assert ("KHR_mesh_quantization" in file.json.get("extensionsRequired", [])) == reader.quantized
    if reader.target_normals:
        teeth = file.mesh("Teeth")["primitives"][0]  # its shape has none of its own
        assert all("NORMAL" in one for one in teeth["targets"])
    assert "JOINTS_1" not in head["attributes"] or reader.influences == 8


@pytest.mark.parametrize(
    ("words", "flag"),
    [
        ("--engine godot --quantize", "--quantize"),
        ("--engine generic --quantize", "--quantize"),
        ("--engine three --influences 8", "--influences 8"),
        ("--engine godot --no-dense", "--no-dense"),
        ("--engine gdot", "--engine"),
        ("--drop-deltas -1", "drop_deltas"),
        ("--drop-deltas nan", "drop_deltas"),
    ],
)
def test_what_an_engine_cannot_read_is_refused(
    words: str, flag: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stage, out = tmp_path / "face.usda", tmp_path / "face.glb"
    save_parts(tiny_face(), stage)
    assert flag in failed(capsys, "export", stage, "-o", out, *words.split(), folder=tmp_path)


def test_the_documentation_has_the_same_table() -> None:
    text = (REPOSITORY / "docs" / "files.md").read_text(encoding="utf-8")
    for name, engine in ENGINES.items():
        row = next(line for line in text.splitlines() if line.startswith(f"| `{name}`"))
        _, influences, targets, quantize, meshopt, lods, normals = (cell.strip() for cell in row.split("|")[1:8])
        assert int(influences) == engine.influences
        assert targets == ("sparse" if engine.sparse else "dense")
        assert quantize == ("yes" if engine.quantized else "refused")
        assert meshopt == ("yes" if engine.meshopt else "refused")
        assert lods == ("yes" if engine.lods else "refused")
        assert normals == ("computed" if engine.target_normals else "those of the face")


def test_an_option_beats_what_the_engine_asks_for(writing: Writing) -> None:
    parts = tiny_face()
    file, _ = writing(parts, engine="three", morph_normals=False, dense=True)
    assert {*map(frozenset, file.mesh("Teeth")["primitives"][0]["targets"])} == {frozenset({"POSITION"})}
    assert not any("sparse" in one for one in file.list("accessors"))


def test_three_calls_joints_what_the_report_says(writing: Writing) -> None:
    node_packages()
    parts = tiny_face()
    skeleton = replace(parts.skeleton, joints=("root", "root/rig:jaw open", "root/rig:jaw open/lip.L[1]"))
    parts = replace(parts, skeleton=skeleton)
    file, report = writing(parts, engine="three")
    said = next(line for line in report.warnings if "changes 2 names" in line)
    assert "'rig:jaw open' is 'rigjaw_open' there" in said
    assert "'lip.L[1]' is 'lipL1' there" in said
    coefficients = random_coefficients(parts, np.random.default_rng(3), 0.1)
    moves = motion(parts, file, coefficients)
    own = {one["name"]: local_matrix(one) for one in file.list("nodes")}
    there = {"root": "root", "rig:jaw open": "rigjaw_open", "lip.L[1]": "lipL1"}
    joints = {there[name]: (own[name] @ move).T.ravel().tolist() for name, move in moves.items()}
    head = three_load(report.path, {}, joints)["meshes"][0]
    expected = file.evaluate(motion=moves)["Head"][np.array(head["points"], int)]
    assert np.abs(np.array(head["positions"]) - expected).max() < TOLERANCE * head_height(parts)


def with_joints(names: Sequence[str]) -> FaceParts:
    """A face with further joints, all children of its root."""
    face = tiny_face()
    paths = ("root", *(f"root/{name}" for name in names))
    rest = np.tile(np.eye(4), (len(paths), 1, 1))
    return replace(face, skeleton=replace(face.skeleton, joints=paths, bind_transforms=rest, rest_transforms=rest))


def test_joints_that_godot_cannot_have_are_named(writing: Writing) -> None:
    _, report = writing(with_joints(["\u3042\u3054", "jaw", "---"]), engine="godot")
    assert report.warnings == (
        "Godot 3 does not load the file for 2 names: '\u3042\u3054', '---': joints need an ASCII letter or digit "
        "(--rename gives others)",
    )


def test_quantised_real_head_stays_within_its_error(writing: Writing) -> None:
    parts = load("ict", shared("ict_facekit/ict_facekit.npz")).parts
    file, report = writing(parts, quantize=True)
    assert report.error_mm is not None
    names = list(dict.fromkeys(shape.name for mesh in parts.meshes for shape in mesh.blendshapes))
    for weights in (dict.fromkeys(names, 1.0), dict.fromkeys(names[::2], 1.0), {names[0]: 1.0}):
        found = difference(file.evaluate(weights), reference(parts, weights), parts) * 1000
        assert found <= (report.error_mm if len(weights) > 1 else 0.0265)
    assert report.bytes < 4e6
