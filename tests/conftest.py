"""Faces on disk that more than one file of tests reads."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import scipy.linalg  # noqa: F401  (its BLAS is limited too)
from blend_line import made
from threadpoolctl import threadpool_limits

from facepipe.stage import save_parts

threadpool_limits(limits=1)  # tests run side by side, one on each core


@pytest.fixture(scope="session")
def drawer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """a.usda, b.usda, other.usda: small faces on one topology."""
    folder = tmp_path_factory.mktemp("drawer")
    for seed, name in enumerate(("a", "b", "other")):
        save_parts(made(seed), folder / f"{name}.usda")
    return folder


@pytest.fixture
def folder(drawer: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with copies of those faces in it."""
    for file in drawer.iterdir():
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path
