"""What more than one file of rebuild tests reads: the stages of a rebuild, a project, and the files of a fit."""

from __future__ import annotations

import shutil
from pathlib import Path

import neutral_files
import pytest
import scan_domes
from command_line import exit_code
from rebuild_project import put_drawer
from rebuild_stages import Files, put_scans

from facepipe.scanning.database import save_database
from facepipe.stage import save_parts


@pytest.fixture(scope="session")
def stages(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """All stages of a rebuild, one after another; not to be changed."""

    files = put_scans(tmp_path_factory.mktemp("stages"))
    words = list(files.personal())
    words[words.index(files["p.usda"])] = files["personal.usda"]
    for command in (words, files.register("open"), files.register("both"), files.split()):
        assert exit_code(*command) == 0
    return files


@pytest.fixture
def files(stages: Files, tmp_path: Path) -> Files:
    """A copy to work in, without the actor."""
    for path in stages.folder.iterdir():
        if path.name != "actor.usda":
            (tmp_path / path.name).write_bytes(path.read_bytes())
    return Files(tmp_path)


@pytest.fixture(scope="session")
def drawer_of_scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("project")
    put_drawer(folder)
    return folder


@pytest.fixture
def project(drawer_of_scans: Path, tmp_path: Path) -> Path:
    """Its file, in a folder of its own."""
    folder = tmp_path / "project"
    shutil.copytree(drawer_of_scans, folder)
    return folder / "anna.toml"


@pytest.fixture(scope="session")
def database_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("domes") / "faces.fpdb"
    save_database(scan_domes.database(), path)
    return path


@pytest.fixture
def fit_files(tmp_path: Path, database_file: Path) -> neutral_files.Files:
    """Template, database and a scan with landmarks."""
    save_parts(scan_domes.face(), tmp_path / "head.usda")
    (tmp_path / "faces.fpdb").write_bytes(database_file.read_bytes())
    files = neutral_files.Files(tmp_path)
    files.put(*scan_domes.scan(neutral_files.PERSON))
    return files
