"""Faces in a process that used USD before facepipe: found, and written as in any other."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from places import REPOSITORY, SUPPORT

BEFORE = {
    "nothing": "import facepipe",
    "USD loaded": "from pxr import Usd",
    "another stage opened": (
        "from pxr import Usd; stage = Usd.Stage.CreateInMemory(); stage.DefinePrim('/Other', 'Mesh').GetPropertyNames()"
    ),
    "the schema registry used": (
        "from pxr import Usd; assert Usd.SchemaRegistry().FindConcretePrimDefinition('SkelRoot')"
    ),
}
LATE = ("another stage opened", "the schema registry used")
Done = tuple[list[str], dict[str, bytes]]


def work(folder: Path, before: str) -> Done:
    """What host_work.py says, and what it writes."""
    folder.mkdir()
    environment = {name: value for name, value in os.environ.items() if name != "PXR_PLUGINPATH_NAME"}
    environment["PYTHONPATH"] = os.pathsep.join([str(SUPPORT), str(REPOSITORY)])
    program = f"{BEFORE[before]}\nimport host_work\nhost_work.work()"
    done = subprocess.run([sys.executable, "-c", program], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    files = {one.relative_to(folder).as_posix(): one.read_bytes() for one in folder.rglob("*") if one.is_file()}
    return re.sub(r" in [\d.]+ s", "", done.stdout).splitlines(), files


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Done:
    """In a process where facepipe was first."""
    return work(tmp_path_factory.mktemp("first") / "work", "nothing")


@pytest.mark.parametrize(
    "before",
    [
        "another stage opened",
        *(
            pytest.param(one, marks=pytest.mark.slow)
            for one in BEFORE
            if one not in ("nothing", "another stage opened")
        ),
    ],
)
def test_the_same_whatever_the_host_did_before(tmp_path: Path, first: Done, before: str) -> None:
    said, files = work(tmp_path / "work", before)
    assert (first[0][-1], said[-1]) == ("known", "unknown" if before in LATE else "known")
    assert said[:-1] == first[0][:-1]
    assert "mouth:group" in said[-2]
    assert len(files) >= 10
    assert files.keys() == first[1].keys()
    assert [name for name, data in files.items() if data != first[1][name]] == []


def test_import_loads_no_usd_and_registers_the_schemas() -> None:
    program = (
        "import sys, facepipe\n"
        "assert not {'pxr', 'numpy'} & {*sys.modules}\n"
        "from pxr import Usd\n"
        "assert Usd.SchemaRegistry().FindAppliedAPIPrimDefinition('FacepipeFaceAPI')\n"
    )
    environment = {**os.environ, "PXR_PLUGINPATH_NAME": os.pathsep.join(["/elsewhere", ""])}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
