"""docs/engines.md: what it shows for engines that run here is run as it stands."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import facepipe_gltf
import gltf_reader
import numpy as np
import pytest
from command_line import exit_code
from engine_faces import FACES, LAYOUTS, LIMITS
from engines import RUNNERS, File, godot_project, godot_server
from facepipe_gltf.options import ENGINES
from node import HERE, node_packages
from pages import blocks
from places import REPOSITORY

import facepipe
from facepipe.rig import coefficient_matrices, rest_coefficients
from facepipe.stage import Face

PAGE = (REPOSITORY / "docs" / "engines.md").read_text(encoding="utf-8")
TOLERANCE = 1e-5
TURNED = {"head": (0.1, 0.2, 0.3)}  # rx, ry, rz of the page's joint
SLIDERS = {"smile": 0.8, "noseWidth": -0.6, "blink": 0.7, "jawWidth": 0.5}


def named_blocks(kind: str) -> dict[str, str]:
    """Blocks of the page by the name in their first line."""
    found = re.findall(rf"```{kind}\n(\S+ (\w+\.\w+).*?)```", PAGE, re.DOTALL)
    return {name: text for text, name in found}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the page's own commands were run."""
    folder = tmp_path_factory.mktemp("made")
    (lines,) = blocks(PAGE, "console")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for line in lines.splitlines():
            assert exit_code(*line.split()[1:]) == 0, line
    return folder


def turned(face: Face) -> np.ndarray:
    """Bone coefficients of the page's joint."""
    found = rest_coefficients(len(face.skeleton.joints))
    for joint, angles in TURNED.items():
        found[[one.rpartition("/")[2] for one in face.skeleton.joints].index(joint), 3:6] = angles
    return found


@pytest.mark.gate
@pytest.mark.slow
@pytest.mark.parametrize("engine", ["three", "babylon"])
def test_modules_run_as_they_stand(engine: str, made: Path, tmp_path: Path) -> None:
    node, face = node_packages(), facepipe.open(made / "head.usdc")
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    for name, text in named_blocks("js").items():
        (tmp_path / name).write_text(text)
    (tmp_path / "node_modules").symlink_to(HERE / "node_modules")
    words = ["--import", str(HERE / "files_fetch.mjs"), str(HERE / "page_run.mjs"), engine, "out.bin"]
    command = [node, *words, json.dumps(SLIDERS)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    found = np.fromfile(tmp_path / "out.bin", "<f4").reshape(2, -1, 3)
    expected = [face.evaluate({"mouthSmileLeft": 0.7}, coefficients=turned(face)), face.evaluate(sliders=SLIDERS)]
    for own, points in zip(found, expected, strict=True):
        by_mesh = face.split(points * face.meters_per_unit)
        wanted = np.concatenate([by_mesh[mesh][numbers] for mesh, numbers in File(made / "head.glb", []).primitives()])
        assert np.abs(own - wanted).max() < TOLERANCE * face.head_height * face.meters_per_unit


@pytest.mark.slow
def test_the_script_runs_as_it_stands(made: Path, tmp_path: Path) -> None:
    godot_server()
    face, glb = facepipe.open(made / "head.usdc"), tmp_path / "head.glb"
    facepipe_gltf.export(face, glb, facepipe_gltf.Options(engine="godot"))
    project = godot_project(tmp_path / "project", {"head.glb": glb.read_bytes()})
    (project / "face.gd").write_text(named_blocks("gdscript")["face.gd"])
    done = subprocess.run(
        [godot_server(), "--path", str(project), "-s", "page.gd"], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "SCRIPT ERROR" not in done.stderr
    found = json.loads((project / "page.json").read_text())
    assert {name: weight for name, weight in found["shapes"].items() if weight} == {
        mesh.name: pytest.approx(0.7)
        for mesh in face.meshes
        if "mouthSmileLeft" in [blendshape.name for blendshape in mesh.blendshapes]
    }
    document = gltf_reader.read(glb)
    moved = {"head": coefficient_matrices(turned(face))[document.joint_names().index("head")]}
    names = [node["name"] for node in document.list("nodes")]
    np.testing.assert_allclose(found["head"], document.worlds(moved)[names.index("head")][:3].ravel(), atol=1e-6)


def test_the_table_has_every_cell() -> None:
    (table,) = re.findall(r"<!-- docs/engine_table.py -->\n(.*?)<!-- end -->", PAGE, re.DOTALL)
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.strip().splitlines()[2:]]
    assert len(rows) == len(RUNNERS) * len(FACES)
    titles = [*FACES.values()]
    for i, (name, face, *cells) in enumerate(rows):
        engine = [*RUNNERS][i // len(FACES)]
        assert name.startswith(ENGINES[engine].title if engine in ENGINES else engine)
        assert face == titles[i % len(FACES)]
        for layout, cell in zip(LAYOUTS, cells, strict=True):
            bar = 2e-3 if layout == "quantised" else TOLERANCE
            assert cell == LIMITS.get((engine, layout)) or float(cell) < bar, (engine, face, layout)
