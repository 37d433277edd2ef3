"""People drawn from the head: on one topology, the same for the same seed, and sound."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from facepipe_gltf import export
from facepipe_gltf.read import contents
from gltf_export import Parts

import facepipe
from facepipe.checks import validate
from facepipe.core.errors import InputError
from facepipe.geometry.polygons import components, edges
from facepipe.heads import make
from facepipe.heads.asset import asset
from facepipe.parts import FaceParts, Mesh
from facepipe.rig.conventions import ARKIT_SHAPES
from facepipe.stage import save_parts

SEEDS = (0, 1, 2, 24)
MM = 0.1  # centimetres

sample = cache(make)


def mesh(face: FaceParts, name: str) -> Mesh:
    return next(one for one in face.meshes if one.name == name)


def test_same_seed_gives_the_same_file(tmp_path: Path) -> None:
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        save_parts(make(3), folder / "head.usdc")
    assert (tmp_path / "a" / "head.usdc").read_bytes() == (tmp_path / "b" / "head.usdc").read_bytes()


@pytest.mark.parametrize("seed", SEEDS[1:])
def test_seeds_are_different_people_on_one_topology(seed: int) -> None:
    first, other = sample(0), sample(seed)
    assert other.skeleton.joints == first.skeleton.joints
    for name in asset().parts:
        a, b = mesh(first, name), mesh(other, name)
        np.testing.assert_array_equal(a.face_vertex_counts, b.face_vertex_counts)
        np.testing.assert_array_equal(a.face_vertex_indices, b.face_vertex_indices)
        np.testing.assert_array_equal(a.uv_sets[0].indices, b.uv_sets[0].indices)
        assert [blendshape.name for blendshape in a.blendshapes] == [blendshape.name for blendshape in b.blendshapes]
    moved = np.linalg.norm(mesh(first, "Head").points - mesh(other, "Head").points, axis=1)
    assert moved.max() > 4 * MM


def test_the_average_head_is_alike_on_both_sides() -> None:
    points = mesh(sample(0), "Head").points
    from scipy.spatial import cKDTree

    assert cKDTree(points * (-1, 1, 1)).query(points)[0].max() < 0.5 * MM


@pytest.mark.parametrize("seed", SEEDS)
def test_values_are_finite_and_sizes_human(seed: int) -> None:
    face = sample(seed)
    head = mesh(face, "Head")
    chin = head.points[head.landmarks["multipie68"].indices[8], 1]
    assert 18.5 < head.points[:, 1].max() - chin < 26.0
    for part in face.meshes:
        assert part.skin is not None
        arrays = [
            part.points,
            part.uv_sets[0].values,
            part.skin.joint_weights,
            *(blendshape.offsets for blendshape in part.blendshapes),
        ]
        assert all(np.isfinite(array).all() for array in arrays)


def test_head_is_manifold_with_one_border_at_the_neck() -> None:
    head = mesh(sample(0), "Head")
    pairs, faces = edges(head.face_vertex_counts, head.face_vertex_indices)
    assert set(faces) <= {1, 2}
    assert len(np.unique(components(len(head.points), pairs))) == 1
    assert head.anchor in pairs[faces == 1]
    assert head.points[head.anchor, 2] < 0


def test_it_has_the_52_shapes_of_arkit_and_each_moves_its_own_part_of_the_face() -> None:
    head = mesh(sample(0), "Head")
    shapes = {
        blendshape.name: blendshape
        for part in sample(0).meshes
        for blendshape in part.blendshapes
        if part.name == "Head"
    }
    assert {blendshape.name for part in sample(0).meshes for blendshape in part.blendshapes} >= ARKIT_SHAPES
    low, high = {"brow": 3.0, "eye": 0.5, "jaw": -25.0, "mouth": -12.0, "nose": -4.0, "cheek": -10.0}, 9.0
    for name in ARKIT_SHAPES - {"tongueOut"}:
        moved = np.linalg.norm(shapes[name].offsets, axis=1)
        assert moved.max() > 1 * MM, name
        middle = (moved @ head.points[shapes[name].point_indices]) / moved.sum()
        part = next(part for part in low if name.startswith(part))
        assert low[part] < middle[1] < high, name
        if name.endswith(("Left", "Right")) and not name.startswith(("jaw", "mouthLeft", "mouthRight")):
            assert middle[0] * (1 if name.endswith("Left") else -1) > 1.0, name


def test_the_tongue_comes_out_over_the_lip_between_the_teeth() -> None:
    face = facepipe.sample(textures=0)
    rest, out = (face.split(face.evaluate({"tongueOut": weight})) for weight in (0.0, 1.0))
    forward = out["GumsAndTongue"][:, 2] - rest["GumsAndTongue"][:, 2]
    tongue = out["GumsAndTongue"][forward > 5 * MM]
    lips = out["Head"][face.meshes[0].landmarks["multipie68"].indices[[62, 66]]]
    assert tongue[:, 2].max() > lips[:, 2].max() + 10 * MM
    teeth, still = out["Teeth"], (out["Teeth"] == rest["Teeth"]).all(axis=1)
    front = (np.abs(teeth[:, 0]) < 5 * MM) & (teeth[:, 2] > 8.0)
    edges_at = teeth[front & still, 1].min(), teeth[front & ~still, 1].max()
    between = tongue[(np.abs(tongue[:, 0]) < 5 * MM) & (np.abs(tongue[:, 2] - teeth[front, 2].mean()) < 5 * MM)]
    assert len(between) > 5
    assert edges_at[1] - 1 * MM < between[:, 1].min() < between[:, 1].max() < edges_at[0] + 1 * MM


@pytest.mark.parametrize("seed", SEEDS[:2])
def test_regions_sum_to_one_and_landmarks_stand_in_order(seed: int) -> None:
    for part in sample(seed).meshes:
        assert len(part.regions) == 9
        np.testing.assert_allclose(np.sum(list(part.regions.values()), axis=0), 1.0, atol=1e-6)
    head = mesh(sample(seed), "Head")
    x, y, z = head.points[head.landmarks["multipie68"].indices].T
    for run in (range(17), range(17, 27), range(48, 55), range(31, 36)):
        assert (np.diff(x[list(run)]) > 0).all()
    assert y[8] < y[57] < y[33] < y[27]
    assert z[30] > z[27]


def test_it_validates_without_findings(tmp_path: Path) -> None:
    save_parts(sample(2), tmp_path / "head.usdc")
    assert validate(tmp_path / "head.usdc") == ()


def test_its_licences_are_named_and_there() -> None:
    from importlib.resources import files

    assert "USC Institute for Creative Technologies" in sample(1).attribution
    folder = files("facepipe.heads") / "data"
    assert "Permission is hereby granted" in (folder / "LICENSE.ICT-FaceKit.txt").read_text()
    assert "CC0" in (folder / "LICENSE.MakeHuman.md").read_text()


@pytest.mark.parametrize(
    ("given", "message"),
    [({"age": 17.0}, "age: is 17, expected 18 to 80"), ({"feminine": 1.5}, "feminine: is 1.5, expected 0 to 1")],
)
def test_an_age_or_a_sex_out_of_range_is_refused(given: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make(1, **given)


def test_the_recipe_holds_the_age_and_the_sex_that_were_asked_for() -> None:
    recipe = make(3, age=70.0, feminine=1.0).recipe
    assert recipe is not None
    assert recipe.options == {"seed": 3, "textures": 0, "controls": "measures", "age": 70.0, "feminine": 1.0}


def test_a_seed_below_zero_is_refused() -> None:
    with pytest.raises(InputError, match="seed: is -1, expected 0 or more"):
        make(-1)


def test_what_an_export_of_a_head_is_made_of(tmp_path: Path) -> None:
    """No more of anything than measured, so that the head that ships does not grow unseen."""
    found = contents(export(Parts(sample(24)), tmp_path / "head.glb").path)
    assert found["primitives"] <= 12
    assert found["materials"] <= 10
    assert found["targets"] <= 244
    assert found["triangles"] <= 48_836
    assert sum(part["target_bytes"] for part in found["parts"].values()) <= 10_700_000
    assert sum(part["geometry"] for part in found["parts"].values()) <= 1_980_000
    assert found["json"] + found["other"] <= 235_000
