"""Wrinkles of the head in the box: what draws them, where they are, how age leaves them at rest."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from facepipe_gltf import export
from node import validate
from PIL import Image

from facepipe.heads import make, skin
from facepipe.heads.asset import asset
from facepipe.heads.people import Look
from facepipe.parts import FaceParts, HeldFace, Material, TextureInput
from facepipe.pictures.camera import portrait
from facepipe.pictures.scene import build_scene
from facepipe.pictures.shade import Materials, Surfaces

REGIONS = {"browsUp", "browsTogether", "noseSneer", "crowsFeet", "smileFolds", "chin", "lipsPucker", "neck"}
MOST_BYTES = 1_500_000


@pytest.fixture(scope="module")
def head() -> FaceParts:
    return make(0, textures=64)


def face(parts: FaceParts) -> Material:
    return next(one for one in parts.materials if one.wrinkles is not None)


def pixels(used: TextureInput) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(used.texture.data)).convert("RGB"), np.int64)


def mask(used: TextureInput) -> np.ndarray:
    return pixels(used)[..., "rgb".index(used.channels)]


def side(name: str) -> str:
    return "Left" if name.endswith("Left") else "Right" if name.endswith("Right") else ""


def test_the_table_is_of_arkit(head: FaceParts) -> None:
    """Eight regions or more of shapes that the head has; a shape of one side draws none on the other."""
    wrinkles = face(head).wrinkles
    assert wrinkles is not None
    assert {one.name.removesuffix("Left").removesuffix("Right") for one in wrinkles.regions} >= REGIONS
    for region in wrinkles.regions:
        assert {name for name, _ in region.shapes} <= set(asset().shapes)
        if side(region.name):
            assert {side(name) for name, _ in region.shapes} <= {side(region.name), ""}
        assert 0 < region.strength(dict.fromkeys(asset().shapes, 1.0)) <= 1


def test_sides_are_sides(head: FaceParts) -> None:
    """Masks of the left lie at positive x, cut softly in the middle; left and right together have no gap there."""
    wrinkles = face(head).wrinkles
    assert wrinkles is not None
    masks = {one.name: mask(one.mask) for one in wrinkles.regions}
    places = skin.arrays("skin_maps")["face_places"][..., 0].astype(float)  # as large as the masks
    for name, values in masks.items():
        if side(name):
            sign = 1 if side(name) == "Left" else -1
            assert values[sign * places < -0.7].max() == 0
            assert values[sign * places > 0.7].max() > 250
    middle = np.abs(places) < 0.1
    together = masks["browsUpLeft"] + masks["browsUpRight"]
    assert together[middle].max() >= 250


def surfaces(parts: FaceParts, weights: dict[str, float]) -> tuple[Surfaces, np.ndarray]:
    """The skin's face tile at the middles of its triangles, and their UVs (m, 2)."""
    scene = build_scene(parts, None, 4096)
    number = next(i for i, one in enumerate(scene.surfaces) if one.material == face(parts))
    ids = np.flatnonzero(scene.surface == number)
    shares = np.full((len(ids), 3), 1 / 3, np.float32)
    camera = portrait(scene.points, "front", 4096, 4096, 0)
    normals = np.tile(np.array([0, 0, 1], np.float32), (len(ids), 1))
    found = Materials(scene, camera, weights).at(ids, shares, normals, np.ones((len(ids), 3), np.float32))
    return found, scene.uv_corners("st")[ids].mean(axis=1)


@pytest.mark.parametrize(
    ("shape", "region"),
    [("mouthSmileLeft", "smileFoldsLeft"), ("browOuterUpRight", "browsUpRight"), ("mouthPucker", "lipsPucker")],
)
def test_a_shape_wrinkles_its_region_alone(head: FaceParts, shape: str, region: str) -> None:
    """Colours and normals change where its mask is, and nowhere else."""
    before, uv = surfaces(head, {})
    after, _ = surfaces(head, {shape: 1.0})
    change = np.abs(after.normals - before.normals).max(axis=1) + np.abs(after.base - before.base).max(axis=1)
    wrinkles = face(head).wrinkles
    assert wrinkles is not None
    values = mask(next(one for one in wrinkles.regions if one.name == region).mask)
    size = len(values)
    column, row = (np.clip(at * size, 1, size - 2).astype(int) for at in (uv[:, 0] % 1, 1 - uv[:, 1] % 1))
    near = np.max([values[row + y, column + x] for y in (-1, 0, 1) for x in (-1, 0, 1)], axis=0)
    assert change[near == 0].max() < 1e-4
    assert np.percentile(change[values[row, column] > 200], 90) > 0.1


def test_age_leaves_wrinkles_at_rest() -> None:
    """None on the young, each region's deeper with every step of age, and never at full strength."""
    steps = [skin.at_rest(Look(seed=3, age=age)) for age in (0.0, 0.15, 0.4, 0.7, 1.0)]
    for name in steps[0]:
        values = [one[name] for one in steps]
        assert values[0] == values[1] == 0
        assert values[1] < values[2] < values[3] < values[4] < 1
    young, old = (skin.relief(Look(seed=3, age=age), 0, 256).astype(float) for age in (0.0, 1.0))
    assert np.abs(old[..., :2] - young[..., :2]).max() > 20


@pytest.mark.slow
def test_wrinkles_in_a_glb(tmp_path: Path) -> None:
    """At 1K all maps take 1.5 MB at most, and the Khronos validator finds nothing."""
    parts = make(0, textures=1024)
    plain = replace(parts, materials=tuple(replace(one, wrinkles=None) for one in parts.materials))
    sizes = []
    for name, one in (("with", parts), ("without", plain)):
        path = tmp_path / f"{name}.glb"
        export(HeldFace(one), path)
        sizes.append(path.stat().st_size)
    assert 0 < sizes[0] - sizes[1] <= MOST_BYTES
    issues = validate([tmp_path / "with.glb"])[tmp_path / "with.glb"]["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0)
