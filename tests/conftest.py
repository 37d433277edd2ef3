"""Faces on disk that more than one file of tests reads."""

from __future__ import annotations

import gc
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import needs
import pytest
import scipy.linalg  # noqa: F401  (its BLAS is limited too)
import started
from hypothesis import HealthCheck, settings
from small_sources import made
from threadpoolctl import threadpool_limits

from facepipe.stage import save_parts

threadpool_limits(limits=1)  # tests run side by side, one on each core, and so do the programs that they start:
os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"), "1")

started.watch()  # every command of every test

settings.register_profile("busy machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy machine")


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Neighbours stay on one core, with what they share, until the other is idle."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log) if config.getvalue("dist") == "load" else None


def pytest_addoption(parser: pytest.Parser) -> None:
    """For runs of continuous integration."""
    parser.addoption("--first-cases", action="store_true", help="of a test that has several cases, run the first alone")
    parser.addoption("--nothing-left-out", action="store_true", help="a test that is skipped is a failure")


@pytest.hookimpl(tryfirst=True)
def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> Any:
    """Files that can't be imported without an extra that is missing are read, not imported."""
    return needs.left_out(module_path, parent)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """How many tests were left out, and what runs them too."""
    reports = terminalreporter.stats.get("skipped", [])
    reasons = [one.longrepr[2].removeprefix("Skipped: ") for one in reports if isinstance(one.longrepr, tuple)]
    for line in needs.summary(reasons):
        terminalreporter.write_line(line)


@pytest.hookimpl(trylast=True)  # of what markers left
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what needs what is missing, and other cases where the first is enough."""
    needs.skip(items)
    if config.getoption("first_cases"):
        first: dict[str, pytest.Item] = {}
        others = [item for item in items if first.setdefault(item.nodeid.partition("[")[0], item) is not item]
        config.hook.pytest_deselected(items=others)
        items[:] = first.values()


def pytest_sessionfinish(session: pytest.Session) -> None:
    """A run that left something out fails where that was asked for; its last lines say what."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")  # of workers: none
    if session.config.getoption("nothing_left_out") and reporter is not None and reporter.stats.get("skipped"):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Modules and tests stay to the end: garbage is looked for among what tests make."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def unflushed() -> Iterator[None]:
    """Files of tests need not outlive a loss of power."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


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
