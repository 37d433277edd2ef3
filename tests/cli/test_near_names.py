"""Whoever mistypes a name is shown the right one: commands, flags, choices, and all that a face has."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import Capsys, exit_code, failed
from faces import tiny_face
from full_faces import full_face

import facepipe
from facepipe.stage import save_parts

LINES = {
    "bland tiny.usda": "blend",
    "fit-bone tiny.usda": "fit-bones",
    "database inf": "info",
    "neural-rig trian x": "train",
    "inspect tiny.usda --josn": "--json",
    "neural-rig apply tiny.usda --flaten": "--flatten",
    "export tiny.usda -o x.glb --quantise": "--quantize",
    "export tiny.usda -o x.glb --engine thre": "three",
    "export tiny.usda -o x.gbl": ".glb",
    "export tiny.usda -o x.glb --rename akrit": "arkit",
    "export tiny.usda -o x.glb --shapes jawOpn": "jawOpen",
    "import gtlf a.glb x.usda": "gltf",
    "render tiny.usda -o x.png --view sied": "side",
    "render tiny.usda -o x.png --set jawOpn=1": "jawOpen",
    "render tiny.usda -o x.png --bone jwa:rx=1": "jaw",
    "render full.usda -o x.png --slider opne=1": "open",
    "render full.usda -o x.png --pose pse": "pose",
    "render full.usda -o x.png --landmarks cornesr": "corners",
    "render full.usda -o x.png --heatmap facepipe:region:mouht": "facepipe:region:mouth",
    "eval tiny.onnx --set jawOpn=1 -o x.npz": "jawOpen",
    "eval tiny.onnx --bone jwa:rx=1 -o x.npz": "jaw",
    "eval sliders.onnx --slider opne=1 -o x.npz": "open",
    "sliders full.usda --set opne=1 -o x.usda": "open",
    "fit-bones tiny.usda --target jawOpn -o x.usda": "jawOpen",
    "blend tiny.usda other.usda -o x.usda --edges unifrom": "uniform",
    "blend tiny.usda other.usda -o x.usda --set mouht=1,0": "mouth",
    "blend tiny.usda other.usda -o x.usda --lock mouht=1": "mouth",
    "blend tiny.usda other.usda -o x.usda --weights weights.json": "mouth",
    "blend --edit mixed.usda --force --unlock mouht": "mouth",
    "landmarks tiny.usda --from points.json --mesh Teht -o x.usda": "Teeth",
    "animate tiny.usda take.csv --head jwa -o x.usda": "jaw",
}

CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "argument": (lambda: facepipe.blend(["tiny.usda"], out="x.usda", edgs="uniform"), "edges"),
    "option": (lambda: facepipe.blend(["tiny.usda", "other.usda"], out="x.usda", edges="unifrom"), "uniform"),
    "format": (lambda: facepipe.export("tiny.usda", "x.glb", engin="three"), "engine"),
    "engine": (lambda: facepipe.export("tiny.usda", "x.glb", engine="thre"), "three"),
    "kind": (lambda: facepipe.read("x", kind="gtlf"), "gltf"),
    "shape": (lambda: facepipe.open("tiny.usda").evaluate({"jawOpn": 1.0}), "jawOpen"),
    "slider": (lambda: facepipe.open("full.usda").evaluate(sliders={"opne": 1.0}), "open"),
    "pose": (lambda: facepipe.open("full.usda").evaluate(pose="pse"), "pose"),
    "animation": (lambda: facepipe.open("full.usda").sample("clp"), "clip"),
    "scheme": (lambda: facepipe.open("full.usda").landmarks("cornesr"), "corners"),
}


@pytest.fixture(scope="module")
def drawer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Faces and files that the lines name."""
    folder = tmp_path_factory.mktemp("near")
    faces = {"tiny": tiny_face(), "other": tiny_face(2), "full": full_face()}
    for name, parts in faces.items():
        save_parts(parts, folder / f"{name}.usda")
    assert exit_code("export", folder / "tiny.usda", "-o", folder / "tiny.onnx") == 0
    assert exit_code("export", folder / "full.usda", "--sliders", "-o", folder / "sliders.onnx") == 0
    mixed = ("blend", folder / "tiny.usda", folder / "other.usda", "--lock", "mouth=2", "-o", folder / "mixed.usda")
    assert exit_code(*mixed) == 0
    (folder / "take.csv").write_text("Time,jawOpen\n0,0\n0.1,1\n")
    (folder / "points.json").write_text("[1, 2]")
    (folder / "weights.json").write_text(json.dumps({"mouht": [1, 0]}))
    return folder


@pytest.mark.parametrize("line", LINES)
def test_a_line_with_a_wrong_name(line: str, drawer: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(drawer)
    assert f", did you mean '{LINES[line]}'?" in failed(capsys, *line.split(), folder=drawer)


@pytest.mark.parametrize("what", CALLS)
def test_a_call_with_a_wrong_name(what: str, drawer: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(drawer)
    call, near = CALLS[what]
    with pytest.raises((facepipe.FacepipeError, TypeError), match=rf", did you mean '{near}'\?"):
        call()
