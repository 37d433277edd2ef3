"""Folders of others, and what people do in them: no code runs, nothing outside is read, written or brought along."""

from __future__ import annotations

import os
import pickle
import re
import shutil
import sys
from pathlib import Path

import pytest
from _pytest.mark import ParameterSet
from command_line import exit_code
from full_faces import full_face
from hostile_folders import Hostile, Payload, World, harm, make_stock
from hostile_kinds import HOSTILE
from small_sources import made

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="links and pipes need rights there")

Capsys = pytest.CaptureFixture[str]
MODES = {"alone": (), "root": ("--root", "."), "roots": ()}
KEPT = ("plan, text of all lines: gigabytes", "root")  # of what takes half a second or more
DEAR = (
    KEPT[0],
    "ledger, error: none",
    "ledger, reads: http URL",
    "ledger, report: no float",
    "ledger, writes: http URL",
)


def case(hostile: Hostile, mode: str) -> ParameterSet:
    """A folder in a mode, which may be slow."""
    slow = mode == "roots" or (hostile.name in DEAR and (hostile.name, mode) != KEPT)
    return pytest.param(hostile, mode, id=f"{hostile.name}-{mode}", marks=[pytest.mark.slow] if slow else [])


@pytest.fixture(scope="module")
def stock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stock")
    make_stock(folder, full_face(), (made(1), made(2)))
    return folder


@pytest.fixture
def world(stock: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> World:
    world = World(tmp_path)
    world.settle(stock)
    monkeypatch.chdir(world.sent)
    return world


@pytest.mark.parametrize(("hostile", "mode"), [case(hostile, mode) for hostile in HOSTILE for mode in MODES])
def test_a_hostile_folder_is_of_no_harm(
    hostile: Hostile, mode: str, world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    if mode == "roots":
        monkeypatch.setenv("FACEPIPE_ROOTS", os.pathsep.join([str(world.sent), str(world.sent / "shapes")]))
    (world.sent / "shapes").mkdir()  # a root
    hostile.make(world)
    assert harm(hostile, world, MODES[mode]) == []


def test_the_payload_is_real(world: World) -> None:
    pickle.loads(world.pickled)
    assert world.ran.exists()
    assert Payload(world.ran).__reduce__()[0] is os.mkdir


def test_the_layout_of_a_studio_works_without_flags(world: World, capsys: Capsys) -> None:
    """Assets in another absolute folder, with textures below and results of their own."""
    assets = world.top / "assets" / "anna"
    shutil.copytree(world.sent, assets)
    shot = Path("shot.usda")
    units = 'metersPerUnit = 0.1\n    upAxis = "Z"'
    shot.write_text(f'#usda 1.0\n(\n    defaultPrim = "Tiny"\n    {units}\n    subLayers = [@{assets}/face.usda@]\n)\n')
    for words in (["inspect", "shot.usda"], ["cook", "shot.usda"], ["cook", f"{assets}/mix.usda"]):
        assert exit_code(*words) == 0
    assert exit_code("export", "shot.usda", "-o", "shot.glb") == 0
    assert exit_code("regions", "shot.usda", "--map", "map.png", "--legend", "legend.json", "-o", "flat.usdz") == 0
    assert exit_code("import", "usd", "shot.usda", "copy.usda") == 0
    assert any(Path("copy_textures").iterdir())
    assert "outside" not in capsys.readouterr().err


def test_there_are_enough_and_no_two_are_alike() -> None:
    names = [one.name for one in HOSTILE]
    assert len({*names}) == len(names) >= 150
    assert [name for name in names if not re.fullmatch("[^,:]+, [^:]+: [^:]+", name)] == [], "reader, field: escape"
