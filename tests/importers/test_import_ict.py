"""The ICT-FaceKit importer against the model's own formula, and against damaged input."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from import_data import arrays, damaged, packed, refused, shared, wrong_array

from facepipe.core.errors import InputError, TopologyError
from facepipe.importers import ict as topology
from facepipe.importers import load
from facepipe.importers.ict import Options, read
from facepipe.parts import FaceParts, Mesh

PACKED = "ict_facekit/ict_facekit.npz"
SHAPES = ("jawOpen", "eyeBlink_L", "mouthSmile_R")
MODES = ("identity003", "identity041")


@pytest.fixture(scope="module")
def face() -> FaceParts:
    return load("ict", shared(PACKED)).parts


def whole(parts: FaceParts, shape: str | None = None) -> np.ndarray:
    """All points of the face in the order of the model, with one shape applied."""
    return np.concatenate([_deformed(mesh, shape) for mesh in parts.meshes])


def _deformed(mesh: Mesh, name: str | None) -> np.ndarray:
    points = np.array(mesh.points, dtype=np.float64)
    for shape in mesh.blendshapes:
        if shape.name == name:
            points[shape.point_indices] += shape.offsets
    return points


def test_every_shape_is_the_models_within_the_threshold(face: FaceParts) -> None:
    data = arrays(PACKED)
    names = {shape.name for mesh in face.meshes for shape in mesh.blendshapes}
    assert len(names) == 53
    for name, deltas in zip(data["expression_names"].tolist(), data["expression_deltas"], strict=True):
        ours = name.replace("_L", "Left").replace("_R", "Right")
        expected = data["neutral"].astype(np.float64) + deltas
        assert np.linalg.norm(whole(face, ours) - expected, axis=1).max() <= 2e-4 + 1e-6
    exact = read(shared(PACKED), Options(threshold=0.0)).parts
    expected = data["neutral"].astype(np.float64) + data["expression_deltas"][26]
    assert np.abs(whole(exact, "jawOpen") - expected).max() < 1e-6


def test_a_higher_threshold_keeps_fewer_points(face: FaceParts) -> None:
    def stored(parts: FaceParts) -> int:
        return sum(len(shape.point_indices) for mesh in parts.meshes for shape in mesh.blendshapes)

    exact = read(shared(PACKED), Options(threshold=0.0)).parts
    coarse = read(shared(PACKED), Options(threshold=1e-2)).parts
    assert stored(coarse) < stored(face) < stored(exact)
    lengths = [np.linalg.norm(shape.offsets, axis=1) for mesh in coarse.meshes for shape in mesh.blendshapes]
    assert min(length.min() for length in lengths) > 1e-2


def test_tables_agree_with_the_packed_ones() -> None:
    data = arrays(PACKED)
    assert [part.title for part in topology.PARTS] == data["part_names"].tolist()
    assert [part.points for part in topology.PARTS] == [tuple(pair) for pair in data["part_vertex_range"].tolist()]
    assert [part.faces for part in topology.PARTS] == [tuple(pair) for pair in data["part_face_range"].tolist()]
    assert list(topology.LANDMARKS) == data["landmarks_multipie68"].tolist()
    assert list(topology.EXPRESSIONS) == data["expression_names"].tolist()
    assert list(topology.EXTRAS) == data["extra_names"].tolist()
    assert set(topology.MATERIALS) == {*data["material_names"].tolist(), "Cornea", "Pupil"}


def test_meshes_keep_points_faces_uvs_and_materials(face: FaceParts) -> None:
    data = arrays(PACKED)
    assert [mesh.name for mesh in face.meshes][:3] == ["Head", "GumsAndTongue", "Teeth"]
    assert len(face.meshes) == 13
    assert np.abs(whole(face) - data["neutral"]).max() == 0
    assert np.array_equal(np.concatenate([mesh.face_vertex_counts for mesh in face.meshes]), data["face_vertex_counts"])
    starts = np.cumsum([0] + [len(mesh.points) for mesh in face.meshes])
    corners = [mesh.face_vertex_indices + start for mesh, start in zip(face.meshes, starts, strict=False)]
    assert np.array_equal(np.concatenate(corners), data["face_vertex_indices"])
    uvs = np.concatenate([mesh.uv_sets[0].values[mesh.uv_sets[0].indices] for mesh in face.meshes])
    assert np.array_equal(uvs, data["uv"].astype(np.float64)[data["face_uv_indices"]])
    for mesh in face.meshes:
        covered = np.sort(np.concatenate([group.faces for group in mesh.material_faces]))
        assert np.array_equal(covered, np.arange(len(mesh.face_vertex_counts)))


def test_the_pupil_is_seen_through_the_cornea(face: FaceParts) -> None:
    for mesh in face.meshes:
        if mesh.name.startswith("Eyeball"):
            groups = {group.material: group.faces for group in mesh.material_faces}
            starts = np.cumsum(mesh.face_vertex_counts) - mesh.face_vertex_counts
            cornea, pupil = (
                mesh.points[mesh.face_vertex_indices[starts[groups[name]]]] for name in ("Cornea", "Pupil")
            )
            assert len(cornea) > 50
            assert cornea[:, 2].min() > pupil[:, 2].min() - 0.3
            assert cornea[:, :2].min() <= pupil[:, :2].min()
            assert cornea[:, :2].max() >= pupil[:, :2].max()
            assert np.ptp(pupil[:, 0]) < 0.6 < np.ptp(cornea[:, 0]) < 1.4


def test_regions_sum_to_one_and_hold_their_landmarks(face: FaceParts) -> None:
    for mesh in face.meshes:
        assert len(mesh.regions) == 9
        assert np.abs(sum(mesh.regions.values()) - 1).max() < 1e-12
    head = face.meshes[0]
    marks = head.landmarks["multipie68"].indices
    assert marks.max() < len(head.points)
    owners = {
        "chin": [8],
        "eyebrows": range(17, 27),
        "nose": range(28, 36),
        "eyes": range(36, 48),
        "mouth": range(48, 68),
    }
    for region, positions in owners.items():
        assert head.regions[region][marks[list(positions)]].min() > 0.5, region
    mirrored = head.points * (-1, 1, 1)
    twin = np.linalg.norm(head.points[:9409, None][::50] - mirrored[None, :9409], axis=2).argmin(axis=1)
    for region, mask in head.regions.items():
        assert np.abs(mask[:9409:50] - mask[twin]).max() < 0.05, region


def test_the_anchor_is_in_the_middle_of_the_back(face: FaceParts) -> None:
    head = face.meshes[0]
    assert head.anchor is not None
    x, y, z = head.points[head.anchor]
    assert abs(x) < 0.1
    assert y < head.points[:, 1].min() + 0.25 * np.ptp(head.points[:, 1])
    assert z < 0


def test_identity_is_the_weighted_sum_of_modes(tmp_path: Path) -> None:
    data = arrays(PACKED)
    weights = tmp_path / "weights.json"
    weights.write_text(json.dumps({"identity003": 1.25, "identity041": -0.5}))
    parts = read(shared(PACKED), Options(identity=weights)).parts
    expected = data["neutral"] + 1.25 * data["identity_deltas"][3] - 0.5 * data["identity_deltas"][41].astype(float)
    assert np.abs(whole(parts) - expected).max() < 1e-5
    weights.write_text(json.dumps([0, 0, 0, 1.25] + [0] * 37 + [-0.5]))
    assert np.array_equal(whole(read(shared(PACKED), Options(identity=weights)).parts), whole(parts))
    assert parts.recipe is not None
    assert len(parts.recipe.digests) == 2


def test_a_seed_draws_the_same_person_again() -> None:
    data = arrays(PACKED)
    draws = np.random.Generator(np.random.PCG64(7)).standard_normal(100)
    parts = read(shared(PACKED), Options(identity_seed=7)).parts
    expected = data["neutral"] + np.tensordot(draws, data["identity_deltas"].astype(np.float64), 1)
    assert np.abs(whole(parts) - expected).max() < 1e-6
    generic = load("ict", shared(PACKED)).parts
    assert all(np.array_equal(generic.meshes[0].regions[k], v) for k, v in parts.meshes[0].regions.items())


def test_extras_and_names(face: FaceParts) -> None:
    parts = read(shared(PACKED), Options(extras=True, arkit_names=False)).parts
    names = {shape.name for mesh in parts.meshes for shape in mesh.blendshapes}
    assert names == {*topology.EXPRESSIONS, *topology.EXTRAS}


def _write_obj(path: Path, points: np.ndarray, data: dict[str, Any]) -> None:
    rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    rows += [f"vt {u!r} {v!r}" for u, v in data["uv"].astype(np.float64).tolist()]
    start, material = 0, -1
    corners = list(zip((data["face_vertex_indices"] + 1).tolist(), (data["face_uv_indices"] + 1).tolist(), strict=True))
    for count, number in zip(data["face_vertex_counts"].tolist(), data["face_material"].tolist(), strict=True):
        if number != material:
            rows.append(f"usemtl {data['material_names'][number]}")
            material = number
        rows.append("f " + " ".join(f"{p}/{t}/{p}" for p, t in corners[start : start + count]))
        start += count
    path.write_text("\n".join(rows) + "\n")


@pytest.mark.slow
def test_the_obj_folder_gives_the_same_parts_as_the_packed_form(tmp_path: Path) -> None:
    data = arrays(PACKED)
    neutral = data["neutral"].astype(np.float64)
    weights = tmp_path / "weights.json"
    weights.write_text(json.dumps({"identity003": 0.5, "identity041": -1.5}))
    folder = tmp_path / "FaceXModel"
    folder.mkdir()
    _write_obj(folder / "generic_neutral_mesh.obj", neutral, data)
    for kind, names in (("expression", SHAPES), ("identity", MODES)):
        for name in names:
            row = data[f"{kind}_names"].tolist().index(name)
            _write_obj(folder / f"{name}.obj", neutral + data[f"{kind}_deltas"][row], data)
    imported = read(tmp_path, Options(identity=weights))
    assert "browDown_L" in imported.warnings[0]
    from_npz = read(shared(PACKED), Options(identity=weights)).parts
    kept = {name.replace("_L", "Left").replace("_R", "Right") for name in SHAPES}
    for ours, theirs in zip(imported.parts.meshes, from_npz.meshes, strict=True):
        for attribute in ("name", "points", "face_vertex_counts", "face_vertex_indices", "anchor"):
            np.testing.assert_array_equal(getattr(ours, attribute), getattr(theirs, attribute))
        np.testing.assert_array_equal(ours.uv_sets[0].values, theirs.uv_sets[0].values)
        np.testing.assert_array_equal(ours.uv_sets[0].indices, theirs.uv_sets[0].indices)
        assert [group.material for group in ours.material_faces] == [group.material for group in theirs.material_faces]
        expected = [shape for shape in theirs.blendshapes if shape.name in kept]
        assert {shape.name for shape in ours.blendshapes} == {shape.name for shape in expected}
        for shape, other in zip(ours.blendshapes, expected, strict=True):
            np.testing.assert_array_equal(shape.point_indices, other.point_indices)
            np.testing.assert_array_equal(shape.offsets, other.offsets)
    assert imported.parts.materials == from_npz.materials


def test_a_folder_without_neutral_or_with_another_topology_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"generic_neutral_mesh\.obj"):
        read(tmp_path, Options())
    (tmp_path / "generic_neutral_mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(TopologyError, match="3 points and 1 faces, expected 26719 and 26384"):
        read(tmp_path, Options())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"identity100": 1}', "unknown mode"),
        ('{"identity001": NaN}', "at most 1000"),
        ('{"identity001": true}', "at most 1000"),
        ('{"identity001": -1' + "0" * 400 + "}", "at most 1000"),
        ("3", "object or list"),
        ("[", "not JSON"),
        ("[" * 100_000, "not JSON"),
        (json.dumps([0.0] * 101), "unknown mode"),
    ],
)
def test_bad_weight_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    weights = tmp_path / "weights.json"
    weights.write_text(text)
    with pytest.raises(InputError, match=message):
        read(tmp_path, Options(identity=weights))


def test_weights_and_seed_exclude_each_other(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="one of them"):
        read(tmp_path, Options(identity=tmp_path / "w.json", identity_seed=1))


@cache
def _flat_model() -> dict[str, Any]:
    """A valid packed model of the right size with nothing in it, small enough to damage often."""
    starts = np.concatenate([np.full(p.faces[1] - p.faces[0], p.points[0]) for p in topology.PARTS])
    indices = (starts[:, None] + np.arange(3)).astype(np.int32).ravel()
    empty = np.zeros((1, topology.POINT_COUNT, 3), np.float32)
    return {
        "neutral": empty[0],
        "face_vertex_counts": np.full(topology.FACE_COUNT, 3, np.int32),
        "face_vertex_indices": indices,
        "uv": np.zeros((3, 2), np.float32),
        "face_uv_indices": np.zeros(len(indices), np.int32),
        "face_material": np.zeros(topology.FACE_COUNT, np.int16),
        "material_names": np.array(["M_Face"]),
        "expression_names": np.array(["jawOpen"]),
        "expression_deltas": empty,
    }


def test_the_flat_model_is_readable(tmp_path: Path) -> None:
    file = tmp_path / "model.npz"
    file.write_bytes(packed(_flat_model()))
    assert len(read(file, Options()).parts.meshes) == 13


FUZZ = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))


@FUZZ
@given(data=st.data())
def test_damaged_archives_raise_our_errors_only(tmp_path: Path, data: st.DataObject) -> None:
    file = tmp_path / "model.npz"
    file.write_bytes(data.draw(damaged(packed(_flat_model()))))
    refused(lambda: read(file, Options()), file)


@FUZZ
@given(data=st.data())
def test_wrong_arrays_raise_our_errors_only(tmp_path: Path, data: st.DataObject) -> None:
    arrays = dict(_flat_model())
    name = data.draw(st.sampled_from(sorted(arrays)))
    arrays[name] = data.draw(wrong_array(arrays[name]))
    file = tmp_path / "model.npz"
    file.write_bytes(packed(arrays))
    refused(lambda: read(file, Options()), file)
