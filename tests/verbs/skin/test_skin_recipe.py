"""Recipes of skinned faces: what they digest, what they give back, and damaged ones."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import exit_code
from faces import with_meshes
from skin_joints import head, weights_of, without_joints

import facepipe
from facepipe.core.errors import InputError, SchemaError
from facepipe.parts import FaceParts, Recipe
from facepipe.performing import perform, read_kept, recipe_to
from facepipe.stage import save_parts
from facepipe.verbs.skin import Skin

JOINTS = {"unit": "mm", "joints": {"head": {"position": [0, 60, 20]}, "head/jaw": {"position": [0, 0, 15]}}}


def plain(parts: FaceParts) -> FaceParts:
    return with_meshes(parts, blendshapes=())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A face over another layer, a file of joints, and a skinned face."""
    save_parts(plain(without_joints(head("sample"))), tmp_path / "below.usda")
    with facepipe.open(tmp_path / "below.usda").deriving(tmp_path / "face.usda"):
        pass
    (tmp_path / "joints.json").write_text(json.dumps(JOINTS))
    save_parts(replace(plain(head("sample")), animations=(), sliders=()), tmp_path / "other.usdc")
    (tmp_path / "results").mkdir()
    (tmp_path / "facepipe.toml").touch()  # files that recipes name may lie above their folder
    return tmp_path


def skin(folder: Path, *words: str) -> Path:
    out = folder / "results" / "out.usda"
    assert exit_code("skin", folder / "face.usda", *words, "-o", out, "--force") == 0
    return out


@pytest.mark.parametrize("way", ["joints", "face"])
def test_a_recipe_gives_back_what_skins_the_same_face_again(folder: Path, way: str) -> None:
    words = ["--joints", str(folder / "joints.json"), "--influences", "3", "--sharpness", "2"]
    if way == "face":
        words = ["--from", str(folder / "other.usdc"), "--influences", "2", "--smoothing", "0.5"]
    out = skin(folder, *words)
    kept = read_kept(out, Skin)
    assert kept.values["face"] == folder / "face.usda"
    assert kept.values["joints"] == (folder / "joints.json" if way == "joints" else None)
    assert kept.values["source"] == (folder / "other.usdc" if way == "face" else None)
    expected = {"influences": 3, "sharpness": 2.0} if way == "joints" else {"influences": 2, "smoothing": 0.5}
    assert expected.items() <= kept.values.items()
    assert not kept.values["optimise"]
    assert not kept.standalone
    assert not kept.warnings
    perform(Skin(**kept.values), folder / "again.usda")
    found, first = (facepipe.open(path) for path in (folder / "again.usda", out))
    np.testing.assert_array_equal(weights_of(found), weights_of(first))


def test_every_source_that_changes_is_reported(folder: Path) -> None:
    out = skin(folder, "--joints", str(folder / "joints.json"))
    assert not read_kept(out, Skin).warnings
    (folder / "joints.json").write_text(json.dumps(JOINTS) + "\n")
    assert read_kept(out, Skin).warnings == ("joints.json changed since out.usda was made",)
    below = folder / "below.usda"
    below.write_text(below.read_text() + "\n# a line\n")  # a layer that the face stands on
    assert [line.split()[0] for line in read_kept(out, Skin).warnings] == ["face.usda", "joints.json"]


def test_a_recipe_names_its_folder_s_neighbours_and_knows_lost_ones(folder: Path) -> None:
    out = skin(folder, "--from", str(folder / "other.usdc"), "--flatten")
    recipe = facepipe.open(out).parts().recipe
    assert recipe is not None
    assert recipe.sources == ("../face.usda", "../other.usdc")
    assert all(digest.startswith("sha256:") for digest in recipe.digests)
    assert read_kept(out, Skin).standalone
    (folder / "other.usdc").unlink()
    with pytest.raises(InputError, match=r"source 2: .*other.usdc: no such file, expected it there \(or --from\)"):
        read_kept(out, Skin)


def damaged(good: Recipe) -> dict[str, Recipe]:
    options = dict(good.options)
    return {
        "recipe of 'blend'": replace(good, verb="blend"),
        "one digest per source": replace(good, digests=good.digests[:1]),
        "joints: ./joints.json, expected one of the sources": replace(good, sources=("./face.usda",), digests=("",)),
        "no 'face', expected one": replace(good, options={}),
        "option 'sky' is unknown": replace(good, options={**options, "sky": 1}),
        "face: 5, expected the names of sources": replace(good, options={**options, "face": 5}),
        "optimise: 1, expected true": replace(good, options={**options, "optimise": 1}),
        "influences: 1.5, expected a whole number": replace(good, options={**options, "influences": 1.5}),
        "influences: is 0": replace(good, options={**options, "influences": 0}),
        "made by facepipe 99.0": replace(good, version="99.0"),
    }


def test_damaged_recipes_are_refused_in_one_line(folder: Path) -> None:
    good = recipe_to(Skin(face=folder / "face.usda", joints=folder / "joints.json"), folder / "bad.usda")
    for message, recipe in damaged(good).items():
        save_parts(replace(plain(without_joints(head("sample"))), recipe=recipe), folder / "bad.usda")
        with pytest.raises((InputError, SchemaError)) as caught:
            read_kept(folder / "bad.usda", Skin)
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="recipe of 'sample'"):
        read_kept(folder / "below.usda", Skin)
    with pytest.raises(InputError, match="expected one of them"):
        perform(Skin(face=folder / "face.usda"), folder / "bad.usda")


def test_edit_changes_what_is_given(folder: Path) -> None:
    out = skin(folder, "--joints", str(folder / "joints.json"), "--influences", "3")
    assert exit_code("skin", "--edit", out, "--sharpness", "2", "--force") == 0
    changed = read_kept(out, Skin).values
    assert (changed["influences"], changed["sharpness"]) == (3, 2.0)
    other = ["--from", str(folder / "other.usdc"), "--no-joints", "-o", str(folder / "b.usda")]
    assert exit_code("skin", "--edit", out, *other) == 0
    found = read_kept(folder / "b.usda", Skin).values
    assert (found["joints"], found["source"], found["influences"]) == (None, folder / "other.usdc", 3)
