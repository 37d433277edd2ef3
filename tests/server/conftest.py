"""A server that tests share, and one of a test's own."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from faces import tiny_face
from postgres import Postgres, program
from served import Serve, Served, saved


@pytest.fixture(scope="session")
def heads(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Small faces of one topology."""
    folder = tmp_path_factory.mktemp("heads")
    return [saved(tiny_face(seed), folder / f"head{seed}.usdc") for seed in range(3)]


@pytest.fixture(scope="session")
def shared_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """One for all tests that leave it as it was for others."""
    served = Served(tmp_path_factory.mktemp("serve") / "state", "--processes", "1", "--rate", "10000")
    yield served
    served.stop()


@pytest.fixture(scope="module")
def postgres() -> Iterator[Postgres]:
    """PostgreSQL, where it is installed."""
    pytest.importorskip("psycopg", reason="no psycopg")
    if program("initdb") is None:
        pytest.skip("no PostgreSQL")
    with tempfile.TemporaryDirectory() as folder:  # pytest's are its user's alone
        server = Postgres(Path(folder))
        yield server
        server.stop()


@pytest.fixture
def client(shared_server: Served) -> httpx.Client:
    """Asks the shared server as who needs no token."""
    return shared_server.client


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Serve]:
    """Starts servers, and ends those that are left."""
    started: list[Served] = []

    def start(*words: object, folder: Path = tmp_path / "state", **more: Any) -> Served:
        started.append(Served(folder, *words, **more))
        return started[-1]

    yield start
    for one in started:
        if one.process.poll() is None:
            one.kill()
