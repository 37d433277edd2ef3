"""Recipes of skinned faces: what they digest, what they give back, and damaged ones."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from skin_joints import head, weights_of, without_joints

import facepipe
from facepipe.cli import main
from facepipe.core.errors import InputError, SchemaError
from facepipe.parts import FaceParts, Recipe
from facepipe.processors.skin import SkinFace, SkinOptions, read_joints, read_skin_recipe, skin_recipe
from facepipe.stage import save_parts

JOINTS = {"unit": "mm", "joints": {"head": {"position": [0, 60, 20]}, "head/jaw": {"position": [0, 0, 15]}}}


def plain(parts: FaceParts) -> FaceParts:
    return replace(parts, meshes=tuple(replace(mesh, blendshapes=()) for mesh in parts.meshes))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A face over another layer, a file of joints, and a skinned face."""
    save_parts(plain(without_joints(head("sample"))), tmp_path / "below.usda")
    with facepipe.open(tmp_path / "below.usda").deriving(tmp_path / "face.usda"):
        pass
    (tmp_path / "joints.json").write_text(json.dumps(JOINTS))
    save_parts(replace(plain(head("sample")), animations=(), sliders=()), tmp_path / "other.usdc")
    (tmp_path / "results").mkdir()
    return tmp_path


def skin(folder: Path, *words: str) -> Path:
    out = folder / "results" / "out.usda"
    assert main(["skin", str(folder / "face.usda"), *words, "-o", str(out), "--force"]) == 0
    return out


@pytest.mark.parametrize("way", ["joints", "face"])
def test_a_recipe_gives_back_what_skins_the_same_face_again(folder: Path, way: str) -> None:
    words = ["--joints", str(folder / "joints.json"), "--influences", "3", "--sharpness", "2"]
    if way == "face":
        words = ["--from", str(folder / "other.usdc"), "--influences", "2", "--smoothing", "0.5"]
    out = skin(folder, *words)
    recipe = read_skin_recipe(out)
    assert recipe.face == folder / "face.usda"
    assert recipe.joints == (folder / "joints.json" if way == "joints" else None)
    assert recipe.source == (folder / "other.usdc" if way == "face" else None)
    expected = {"influences": 3, "sharpness": 2.0} if way == "joints" else {"influences": 2, "smoothing": 0.5}
    assert recipe.options == SkinOptions(**expected)  # type: ignore[arg-type]
    assert not recipe.optimise
    assert not recipe.standalone
    assert not recipe.warnings
    again = facepipe.open(recipe.face)
    joints = None if recipe.joints is None else read_joints(recipe.joints)
    source = None if recipe.source is None else facepipe.open(recipe.source)
    with again.deriving(folder / "again.usda") as face:
        SkinFace(joints=joints, source=source, optimise=recipe.optimise, options=recipe.options)(face)
    found, first = (facepipe.open(path) for path in (folder / "again.usda", out))
    np.testing.assert_array_equal(weights_of(found), weights_of(first))


def test_every_source_that_changes_is_told(folder: Path) -> None:
    out = skin(folder, "--joints", str(folder / "joints.json"))
    assert not read_skin_recipe(out).warnings
    (folder / "joints.json").write_text(json.dumps(JOINTS) + "\n")
    assert read_skin_recipe(out).warnings == ("joints.json changed since out.usda was made",)
    below = folder / "below.usda"
    below.write_text(below.read_text() + "\n# a line\n")  # a layer that the face stands on
    assert [line.split()[0] for line in read_skin_recipe(out).warnings] == ["face.usda", "joints.json"]


def test_a_recipe_names_its_folder_s_neighbours_and_knows_lost_ones(folder: Path) -> None:
    out = skin(folder, "--from", str(folder / "other.usdc"), "--flatten")
    recipe = facepipe.open(out).parts().recipe
    assert recipe is not None
    assert recipe.sources == ("../face.usda", "../other.usdc")
    assert all(one.startswith("sha256:") for one in recipe.digests)
    assert read_skin_recipe(out).standalone
    (folder / "other.usdc").unlink()
    with pytest.raises(InputError, match=r"source 2: .*other.usdc: no such file, expected it there \(or --from\)"):
        read_skin_recipe(out)


def damaged(good: Recipe) -> dict[str, Recipe]:
    options = dict(good.options)
    return {
        "recipe of 'blend'": replace(good, verb="blend"),
        "one digest per source": replace(good, digests=good.digests[:1]),
        "1 sources, expected": replace(good, sources=good.sources[:1], digests=good.digests[:1]),
        "expected an object of from, optimise, options": replace(good, options={}),
        "from: sky, expected one of joints, face": replace(good, options={**options, "from": "sky"}),
        "optimise: 1, expected true": replace(good, options={**options, "optimise": 1}),
        "options -> influences": replace(good, options={**options, "options": {"influences": 1.5}}),
        "influences: is 0": replace(good, options={**options, "options": {"influences": 0}}),
        "made by facepipe 99.0": replace(good, version="99.0"),
    }


def test_damaged_recipes_are_refused_in_one_line(folder: Path) -> None:
    good = skin_recipe(folder / "face.usda", folder / "bad.usda", joints=folder / "joints.json")
    for message, recipe in damaged(good).items():
        save_parts(replace(plain(without_joints(head("sample"))), recipe=recipe), folder / "bad.usda")
        with pytest.raises((InputError, SchemaError)) as caught:
            read_skin_recipe(folder / "bad.usda")
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="recipe of 'sample'"):
        read_skin_recipe(folder / "below.usda")
    with pytest.raises(InputError, match="expected one of them"):
        skin_recipe(folder / "face.usda", folder / "bad.usda")
