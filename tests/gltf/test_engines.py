"""The engine matrix: what real engines and importers make of our GLBs, vertex by vertex.

Five engines, three faces, four layouts. Every vertex is where `Face.evaluate` has it within 1e-5 head heights, in a
quantised file within the error that its export states; or the engine can't read the layout, which is seen here too, and
then `--engine` refuses or replaces it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from engine_faces import FACES, LAYOUTS, LIMITS, Case, cases
from engines import RUNNERS, godot_project, run_godot
from facepipe_gltf import Options
from facepipe_gltf.options import ENGINES, check_engine, renamed
from gltf_builder import Builder

from facepipe.core.errors import InputError

TOLERANCE = 1e-5
WRONG = 1e-3  # an engine that can't read a layout is off by more


@pytest.fixture(scope="module", params=FACES)
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Case]:
    """A face in all layouts."""
    return cases(request.param, tmp_path_factory.mktemp(request.param))


@pytest.mark.gate
@pytest.mark.slow
@pytest.mark.parametrize("engine", RUNNERS)
def test_matrix(engine: str, made: dict[str, Case], tmp_path: Path) -> None:
    found = RUNNERS[engine]([one.file for one in made.values()], tmp_path)
    for (layout, one), pieces in zip(made.items(), found, strict=True):
        worst = one.worst(pieces)
        if one.limit(engine, layout) is None:
            assert worst < one.error + TOLERANCE, layout
        else:
            assert worst > WRONG, f"{layout}: {engine} reads it now"
        if one.four is not None and one.limit(engine, layout):  # the largest four, renormalised
            assert one._replace(expected=one.four).worst(pieces) < TOLERANCE


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("engine", RUNNERS)
def test_engine_presets_are_what_the_matrix_shows(engine: str, layout: str) -> None:
    """`--engine` refuses an option, or has another default, where the engine can't read the layout, and only there."""
    preset = Options(engine="generic" if engine == "assimp" else engine)
    can = (engine, layout) not in LIMITS
    if layout == "8 influences":
        assert (preset.reader.influences == 8) == can or engine == "assimp"  # generic stands for three.js too
    elif layout == "plain":
        assert preset.is_dense != can or engine == "assimp"  # and for Godot
    else:
        asked = replace(preset, **LAYOUTS[layout])
        if can:
            check_engine(asked)
        else:
            with pytest.raises(InputError, match=layout[:6]):
                check_engine(asked)


NAMES = (
    *("browInnerLeft", "spine05", "special06_L", "DEF-spine.001", "mixamorig:Hips", "Jaw2Left", "ABCDef", "a1b2c"),
    *(
        "x 00 y",
        "jaw/tip",
        "a@b",
        '"q"',
        "a__b",
        "_a_",
        "1abc",
        "aBCd",
        "ABC",
        "Abc12De",
        "ab007",
        "Éyé",
        "J_Bip_C_Head",
    ),
    *("def:jaw", "p:q:r", "L.Eye00", 'k"k', "m{n}", "u-v", "tooth[1]", "name%20", "x100"),
    *("XYzw", "XYz", "x1yz", "12ab34CD", "k日本", "neck_01_L"),
)


@pytest.mark.slow
def test_godot_calls_joints_as_the_export_says(tmp_path: Path) -> None:
    model = Builder()
    for i, name in enumerate(NAMES):
        model.add("nodes", {"name": name} | ({"children": [i + 1]} if i + 1 < len(NAMES) else {}))
    mesh = {"POSITION": model.array(np.eye(3)), "JOINTS_0": model.array(np.zeros((3, 4)), "u1")}
    mesh["WEIGHTS_0"] = model.array(np.tile((1, 0, 0, 0), (3, 1)))
    model.add("meshes", {"primitives": [{"attributes": mesh}]})
    model.add("skins", {"joints": [*range(len(NAMES))]})
    model.add("nodes", {"mesh": 0, "skin": 0, "name": "mesh"})
    model.add("scenes", {"nodes": [0, len(NAMES)]})
    project = godot_project(tmp_path / "godot", {"0.glb": model.glb()})
    head, _ = run_godot(project, [{"path": "0.glb", "out": "0.bin", "poses": []}])[0]
    assert head["bones"] == [renamed(ENGINES["godot"], name, joint=True) for name in NAMES]
