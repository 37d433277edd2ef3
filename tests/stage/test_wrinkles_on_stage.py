"""Wrinkles on the stage and in glTF: what was written is read."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from facepipe_gltf import export
from pxr import Sdf, Usd
from wrinkled import wrinkled_square

from facepipe.core.errors import InputError, SchemaError
from facepipe.importers import read_face
from facepipe.stage import save_parts
from facepipe.stage.textures import save_standalone
from facepipe.stage.values import same


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    path = tmp_path / "square.usda"
    save_parts(wrinkled_square(), path)
    return path


def test_a_stage_keeps_wrinkles(stage: Path) -> None:
    assert same(read_face(stage).parts().materials, wrinkled_square().materials)


def test_a_copy_keeps_wrinkles(stage: Path, tmp_path: Path) -> None:
    """A flat copy in a package is whole without the file that it was made of."""
    copy = tmp_path / "elsewhere" / "copy.usdz"
    copy.parent.mkdir()
    save_standalone(Usd.Stage.Open(str(stage)), copy)
    shutil.rmtree(stage.parent / "square_textures")
    assert same(read_face(copy).parts().materials, wrinkled_square().materials)


@pytest.mark.parametrize(
    ("attribute", "value", "error", "text"),
    [
        ("facepipe:wrinkle:left:channel", "x", SchemaError, "expected one of r, g, b, a"),
        ("facepipe:wrinkle:left:gains", [1.0], SchemaError, "1 gains and 2 shapes"),
        ("facepipe:wrinkles:normal", Sdf.AssetPath("gone.png"), InputError, "gone.png"),
    ],
)
def test_damaged_wrinkles(stage: Path, attribute: str, value: object, error: type[Exception], text: str) -> None:
    opened = Usd.Stage.Open(str(stage))
    opened.GetPrimAtPath("/Face/Materials/Skin").GetAttribute(attribute).Set(value)
    opened.Save()
    with pytest.raises(error, match=text) as caught:
        read_face(stage).parts()
    assert "\n" not in str(caught.value)


def test_a_glb_keeps_wrinkles(stage: Path, tmp_path: Path) -> None:
    """With the record and, where others have touched the file, by what extras say."""
    path = tmp_path / "square.gltf"
    export(read_face(stage), path)
    wanted = wrinkled_square().materials[0].wrinkles
    assert wanted is not None
    document = json.loads(path.read_text())
    for touched in (False, True):
        if touched:
            document["materials"][0]["name"] = "Other"
            path.write_text(json.dumps(document))
        found = read_face(path).parts().materials[0].wrinkles
        assert found is not None
        assert [(one.name, one.mask.channels, one.shapes) for one in found.regions] == [
            (one.name, one.mask.channels, one.shapes) for one in wanted.regions
        ]
        assert [used.texture.data for used in found.inputs] == [used.texture.data for used in wanted.inputs]


def test_a_material_without_its_maps_is_whole(stage: Path, tmp_path: Path) -> None:
    """Readers that don't know the extras see the same document otherwise."""
    plain = replace(wrinkled_square().materials[0], wrinkles=None)
    other = tmp_path / "plain.usda"
    save_parts(replace(wrinkled_square(), materials=(plain,)), other)
    documents = []
    for number, source in enumerate((stage, other)):
        path = tmp_path / f"{number}.gltf"
        export(read_face(source), path)
        documents.append(json.loads(path.read_text()))
    wrinkled, bare = (one["materials"] for one in documents)
    assert set(wrinkled[0].pop("extras")["facepipe"]["wrinkles"]) == {"normal", "tint", "regions"}
    assert wrinkled == bare
