"""Faces that are made of each other, as a cook finds them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from pxr import Sdf, Usd
from small_sources import made

from facepipe.cli import main
from facepipe.stage import save_parts

Capsys = pytest.CaptureFixture[str]

TABLE = """
[slider.open]
shapes = { jawOpen = 0.5 }
[slider.drop]
channels = { "jaw:ty" = -0.25 }
"""
# what each is made of: mix a, b; controls mix, table.toml; posed controls; side other, a; shot, without a recipe, posed
CHAIN = ("mix.usda", "controls.usda", "posed.usda", "side.usda")
LINES = (
    ("blend", "a.usda", "b.usda", "-o", "mix.usda", "--set", "mouth=0.75,0.25", "--default", "0.5,0.5"),
    ("sliders", "mix.usda", "--from", "table.toml", "-o", "controls.usda"),
    ("sliders", "controls.usda", "--set", "open=0.5", "-o", "posed.usda"),
    ("blend", "other.usda", "a.usda", "-o", "side.usda"),
)


def make_chain(folder: Path, capsys: Capsys) -> None:
    """The chain in `folder`, which holds a.usda, b.usda, other.usda and is the working folder."""
    (folder / "table.toml").write_text(TABLE)
    for line in LINES:
        assert main(list(line)) == 0
    stage = Usd.Stage.CreateNew("shot.usda")
    stage.GetRootLayer().subLayerPaths = ["./posed.usda"]
    stage.GetRootLayer().defaultPrim = "Tiny"
    stage.OverridePrim("/Tiny").SetMetadata("comment", "mine")
    stage.Save()
    capsys.readouterr()


def change(name: str, seed: int = 9) -> None:
    """Another face of the same topology in the place of one."""
    save_parts(made(seed), Path(name))


def cook(capsys: Capsys, *words: str) -> tuple[int, dict[str, Any], str]:
    """Exit code, the report, stderr of `facepipe cook --json`."""
    code = main(["cook", *words, "--json"])
    out, err = capsys.readouterr()
    return code, json.loads(out), err


def actions(report: dict[str, Any]) -> dict[str, str]:
    """File -> what was done."""
    return {Path(one["file"]).name: one["action"] for one in report["nodes"]}


def why(report: dict[str, Any]) -> dict[str, list[str]]:
    """File -> why, of those that there is something to say of."""
    return {Path(one["file"]).name: one["why"] for one in report["nodes"] if one["why"]}


def layer(path: str, text: str) -> None:
    """A USD file of a text."""
    held = Sdf.Layer.CreateAnonymous(".usda")
    assert held.ImportFromString(f"#usda 1.0\n{text}")
    held.Export(path)
