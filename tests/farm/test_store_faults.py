"""A store whose connections are cut, stall, or answer wrongly: files are whole there and here, or the task fails."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import pytest
from conftest import PLAN, Runner

from facepipe.core.errors import InputError
from facepipe.core.policy.paths import trust, trusting
from facepipe.tasks import remote
from facepipe.tasks.mirror import mirror
from facepipe.tasks.remote import Store, StoreError

fsspec = pytest.importorskip("fsspec")
s3fs = pytest.importorskip("s3fs")
pytest.importorskip("moto.moto_server.werkzeug_app")

from faulty_proxy import (  # noqa: E402
    FaultyProxy,
    answer_cut,
    answer_cut_unseen,
    answer_lost,
    body_cut,
    refused,
    spoiling,
)
from s3_server import S3Server, serving  # noqa: E402  (needs moto)

ERRORS = refused(500, "InternalError"), refused(503, "SlowDown")
UPLOADS = (body_cut, answer_lost, *ERRORS, refused(400, "RequestTimeout"))
DOWNLOADS = (answer_cut, answer_cut_unseen, answer_lost, *ERRORS)
TRIES = 2  # of the library in this process; in those of tasks five
PART = 5 << 20  # the least that S3 takes

T = TypeVar("T")


@pytest.fixture(scope="module")
def server() -> Iterator[S3Server]:
    with serving() as server:
        yield server


@pytest.fixture
def proxy(server: S3Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[FaultyProxy]:
    """The way to the store for facepipe."""
    urllib.request.urlopen(urllib.request.Request(f"{server.address}/moto-api/reset", method="POST"))
    s3fs.S3FileSystem.clear_instance_cache()  # which have the addresses of other servers
    with spoiling(server.address) as proxy:
        settings = {"AWS_ENDPOINT_URL": proxy.address, "AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret"}
        settings |= {"AWS_DEFAULT_REGION": "us-east-1", "AWS_MAX_ATTEMPTS": "1", "XDG_CACHE_HOME": str(tmp_path)}
        for name, value in settings.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setattr("s3fs.core.S3FileSystem.retries", TRIES)
        yield proxy
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture
def files(server: S3Server, proxy: FaultyProxy) -> Any:
    """The store itself, with a bucket."""
    direct = fsspec.filesystem("s3", endpoint_url=server.address, use_listings_cache=False)
    direct.mkdir("show")
    return direct


def seen(files: Any, name: str) -> bytes | None:
    return bytes(files.cat_file(name)) if files.exists(name) else None


def tried(ask: Callable[[], T]) -> T | None:
    """What it gives; None where it fails in a way that may pass."""
    with contextlib.suppress(StoreError):
        return ask()
    return None


def put(path: Path, url: str) -> bool:
    return tried(lambda: (Store(url).put(path, url),)) is not None


def test_an_upload_that_is_disturbed_is_whole_or_fails(files: Any, proxy: FaultyProxy, tmp_path: Path) -> None:
    data = os.urandom(200_000)
    (tmp_path / "new").write_bytes(data)
    for spoil, times in itertools.product(UPLOADS, (1, TRIES)):
        files.pipe_file("show/face.bin", b"old")
        proxy.faults = {"PUT /show/face.bin": [spoil] * times}
        done = put(tmp_path / "new", "s3://show/face.bin")
        assert seen(files, "show/face.bin") in ((data,) if done else (data, b"old"))
        proxy.faults.clear()
        assert done or put(tmp_path / "new", "s3://show/face.bin")
        assert seen(files, "show/face.bin") == data


@pytest.mark.slow
def test_so_is_one_in_parts(files: Any, proxy: FaultyProxy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("s3fs.core.calculate_chunksize", lambda *_, **__: PART)  # 50 MiB
    data = os.urandom(1000) * (2 * PART // 1000 + 1)
    (tmp_path / "new").write_bytes(data)
    for spoil, asked in itertools.product(UPLOADS[:3], ("POST .*uploads", "PUT .*partNumber=2.*", "POST .*uploadId.*")):
        proxy.faults = {asked: [spoil] * TRIES}
        done = put(tmp_path / "new", "s3://show/face.bin")
        assert len(proxy.faults.pop(asked)) < TRIES  # it was spoilt
        assert seen(files, "show/face.bin") in ((data,) if done else (data, None))
        assert done or put(tmp_path / "new", "s3://show/face.bin")
        assert seen(files, "show/face.bin") == data
        files.rm_file("show/face.bin")


def test_a_store_that_stops_reading_is_given_up(
    files: Any, proxy: FaultyProxy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files.pipe_file("show/face.bin", bytes(10))
    (tmp_path / "new").write_bytes(bytes(40 << 20))  # more than connections hold
    proxy.faults = {"(PUT|GET) /show/face.bin": [proxy.hung] * (1 + TRIES)}
    with monkeypatch.context() as patch:  # with a store that works there is all the patience
        patch.setattr(remote, "_PATIENCE", 0.5)
        patch.setattr(remote, "_SLOWEST", 1e9)
        patch.setitem(fsspec.config.conf, "s3", {"config_kwargs": {"read_timeout": 0.5}})  # 15 seconds
        assert not put(tmp_path / "new", "s3://show/face.bin")
        with pytest.raises(StoreError):
            Store("s3://show").get("s3://show/face.bin", tmp_path / "face.bin")
    proxy.faults = {}
    assert seen(files, "show/face.bin") == bytes(10)
    assert put(tmp_path / "new", "s3://show/face.bin")


def test_a_bucket_that_is_not_there_is_a_line(proxy: FaultyProxy, tmp_path: Path) -> None:
    (tmp_path / "new").write_bytes(b"new")
    with pytest.raises(InputError, match=r"s3://none/face\.bin: can't be written: no such bucket"):
        Store("s3://none").put(tmp_path / "new", "s3://none/face.bin")


def test_a_download_that_is_disturbed_is_whole_or_fails(
    files: Any, proxy: FaultyProxy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(s3fs.S3FileSystem, "default_block_size", 50_000)  # 50 MiB: larger files come in parts
    data = os.urandom(200_000)
    files.pipe_file("show/face.bin", data)
    for number, (spoil, times) in enumerate(itertools.product(DOWNLOADS, (1, TRIES, 0))):
        wanted = (None, data) if times else (data,)
        with mirror(["s3://show"], str(tmp_path / f"local{number}"), 10**6) as copies:
            proxy.faults = {"GET /show/face.bin": [spoil] * times}
            words = tried(lambda: copies.words(["s3://show/face.bin"]))
            assert (words and Path(words[0]).read_bytes()) in wanted
        proxy.faults = {"GET /show/face.bin": [spoil] * times}
        assert tried(lambda: Store("s3://show").read("s3://show/face.bin", 10**6)) in wanted


def test_a_listing_that_is_disturbed_is_whole_or_fails(files: Any, proxy: FaultyProxy) -> None:
    for name in ("ada", "bea"):
        files.pipe_file(f"show/{name}/face.bin", b"face")
    store = Store("s3://show")
    asked: list[tuple[str, Callable[[], int], int]] = [
        ("", lambda: len(store.listed("s3://show", deep=True)), 2),
        ("bea%2F", lambda: len(store.listed("s3://show/bea")), 1),
        ("bea%2F", lambda: len(store.matching("s3://show/*/face.bin")), 2),
    ]
    for spoil, (folder, ask, count) in itertools.product(DOWNLOADS, asked):
        proxy.faults = {rf"GET /show\?.*prefix={folder}&.*": [spoil] * (TRIES + 1)}
        assert tried(ask) in (None, count)
        proxy.faults.clear()
        assert ask() == count


@pytest.mark.slow
def test_a_batch_over_a_disturbed_store_loses_nothing(
    files: Any, proxy: FaultyProxy, show: Path, run_plan: Runner
) -> None:
    run_plan(PLAN)
    expected = {one.relative_to(show).as_posix(): one.read_bytes() for one in (show / "built").rglob("*.bin")}
    for path in (*show.glob("*.bin"), *show.glob("heads/*.bin")):
        files.put_file(str(path), f"show/{path.relative_to(show).as_posix()}")
    text = re.sub(r"(?<=[\" ])(built|heads|base)", r"s3://show/\1", PLAN)
    proxy.faults = {
        "PUT /show/built/mixed/ada.bin": [body_cut] * 10,  # more than its library tries, and less than that twice
        "PUT /show/built/mixed/bea.bin": [refused(500, "InternalError")],
        "GET /show/heads/cyd.bin": [answer_cut_unseen],
        "PUT /show/built/game/cyd.bin": [refused(503, "ServiceUnavailable")] * 2,
    }
    with trusting(replace(trust(), urls=("s3://show",))):
        report = run_plan(text, failures=1)
        assert dict(report.counts) == {"made": 5, "failed": 1}, report.failures
        assert report.failures[0].startswith("s3://show/built/game/cyd.bin: OSError")
        lines = map(json.loads, (show / "state/tasks.jsonl").read_text().splitlines())
        records = {one["task"]: one for one in lines}
        done = {name: state for one in records.values() for name, (state, _) in one.get("writes", {}).items()}
        assert {f"s3://{name}": files.info(name)["size"] for name in files.find("show/built")} == {
            name: size for name, (size, _) in done.items()
        }
        lost = {"mixed/bea": 1, "mixed/cyd": 1, "game/bea": 0, "game/cyd": 2}
        assert {name: records[name]["lost"] for name in lost} == lost
        assert dict(run_plan().counts) == {"kept": 5, "made": 1}
    assert {name.removeprefix("show/"): files.cat_file(name) for name in files.find("show/built")} == expected
