"""Rows in PostgreSQL and files in S3: the same as in SQLite and a folder; and tables of another form."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx
import pytest
import s3_server
import sqlalchemy as sa
from postgres import Postgres
from served import Serve, Served, done, ended, kept, sent

from facepipe.core.errors import InputError
from facepipe.server import tables
from facepipe.server.jobs import Asked, Jobs
from facepipe.server.library import Library, new_id
from facepipe.server.tables import Database
from facepipe.server.tenants import tenant_named

BUCKET = "faces"


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A bucket that keeps older versions, and what asks its store directly."""
    fsspec = pytest.importorskip("fsspec")
    with s3_server.serving() as server:
        settings = {"AWS_ENDPOINT_URL": server.address, "AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret"}
        for name, value in {**settings, "AWS_DEFAULT_REGION": "us-east-1", "AWS_MAX_ATTEMPTS": "1"}.items():
            monkeypatch.setenv(name, value)
        fsspec.filesystem("s3").clear_instance_cache()
        files = fsspec.filesystem("s3")
        files.mkdir(BUCKET)
        asked: Any = {"Bucket": BUCKET, "VersioningConfiguration": {"Status": "Enabled"}}
        files.call_s3("put_bucket_versioning", **asked)
        yield files
        fsspec.filesystem("s3").clear_instance_cache()


def library_of(client: httpx.Client, heads: list[Path]) -> str:
    """The whole life of some faces; the id of one that is left."""
    first, second = (kept(client, head) for head in heads[:2])
    blend = done(client, "blend", {"sources": [{"face": first}, {"face": second}]}, name="Both \N{SNOWMAN}")["face"]
    for _ in range(2):
        asked = {"from": 1, "action": "blend", "fields": {"sources": [{"face": first}, {"face": second}]}}
        job = client.post(f"/api/v1/faces/{first}/versions", json=asked).json()["job"]["id"]
        assert ended(client, job)["state"] == "done"
    assert [one["conflict_of"] for one in client.get(f"/api/v1/faces/{first}").json()["versions"]] == [None, None, 2]
    assert client.get(f"/api/v1/faces/{blend}/versions/1/face.glb").content[:4] == b"glTF"
    assert client.get("/api/v1/faces", params={"search": "both \N{SNOWMAN}"}).json()["faces"][0]["id"] == blend
    assert client.delete(f"/api/v1/faces/{second}").status_code == 409
    assert client.delete(f"/api/v1/faces/{second}", params={"dependents": "keep"}).status_code == 204
    assert client.get(f"/api/v1/faces/{second}/versions/1/face.usdc").status_code == 404
    return blend


def test_rows_in_postgresql_are_as_those_in_sqlite(serve: Serve, heads: list[Path], postgres: Postgres) -> None:
    served = serve("--processes", "1", "--database", postgres.url)
    assert library_of(served.client, heads)
    assert not (served.folder / "serve.db").exists()
    assert served.client.delete("/api/v1/me").status_code == 204


def test_a_database_that_goes_away_loses_nothing(serve: Serve, heads: list[Path], postgres: Postgres) -> None:
    served = serve("--processes", "1", "--database", postgres.url, "--rate", "1000")
    jobs = [sent(served.client, heads[0]).json()["job"]["id"] for _ in range(6)]
    ended(served.client, jobs[0])
    postgres.stop()
    try:
        away = served.client.get("/api/v1/faces")
        assert (away.status_code, served.client.get("/ready").status_code) == (503, 503)
        assert "does not answer" in away.json()["error"]
        assert served.client.get("/health").status_code == 200
        refused = sent(served.client, heads[0])
        assert refused.status_code == 503
    finally:
        postgres.start()
    assert [ended(served.client, job)["state"] for job in jobs] == ["done"] * 6
    assert len(served.client.get("/api/v1/faces").json()["faces"]) == 6
    assert served.client.delete("/api/v1/me").status_code == 204


def test_two_servers_on_one_database_do_each_job_once(
    serve: Serve, heads: list[Path], postgres: Postgres, tmp_path: Path
) -> None:
    places = {"--database": postgres.url, "--artefacts": str(tmp_path / "artefacts"), "--processes": "1"}
    words = [word for pair in places.items() for word in pair]
    servers = [serve(*words, folder=tmp_path / name) for name in ("a", "b")]
    jobs = [sent(servers[number % 2].client, heads[0]).json()["job"]["id"] for number in range(8)]
    first, second = (str(ended(servers[1].client, job)["face"]) for job in jobs[:2])
    blends = [_blend(servers[number % 2], first, second) for number in range(6)]
    states = [ended(servers[0].client, job)["state"] for job in (*jobs, *blends)]
    assert states == ["done"] * 14
    assert len(servers[1].client.get("/api/v1/faces").json()["faces"]) == 14
    assert {one["attempt"] for one in servers[0].client.get("/api/v1/jobs").json()["jobs"]} == {1}
    assert servers[0].client.delete("/api/v1/me").status_code == 204


def _blend(served: Served, first: str, second: str) -> str:
    asked = {"action": "blend", "fields": {"sources": [{"face": first}, {"face": second}]}}
    return str(served.client.post("/api/v1/jobs", json=asked).json()["id"])


def test_files_in_s3_are_as_those_in_a_folder_and_leave_no_version(
    serve: Serve, heads: list[Path], bucket: Any
) -> None:
    served = serve("--processes", "1", "--artefacts", f"s3://{BUCKET}/of/server")
    blend = library_of(served.client, heads)
    assert not (served.folder / "artefacts").exists()

    def listed() -> dict[str, Any]:
        found: dict[str, Any] = bucket.call_s3("list_object_versions", Bucket=BUCKET)
        return found

    before = {one["Key"] for one in listed()["Versions"]}
    assert any(blend in key for key in before)
    assert served.client.delete(f"/api/v1/faces/{blend}").status_code == 204
    left = listed()
    assert not [one for one in (*left["Versions"], *left.get("DeleteMarkers", ())) if blend in one["Key"]]
    assert served.client.delete("/api/v1/me").status_code == 204
    left = listed()
    assert not left.get("Versions")
    assert not left.get("DeleteMarkers")


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """A database, without tables of an earlier test."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'serve.db'}"
    found: str = request.getfixturevalue("postgres").url
    engine = sa.create_engine(found)
    with engine.begin() as rows:
        tables.TABLES.drop_all(rows)
    engine.dispose()
    return found


def test_tables_go_from_each_version_to_the_latest_and_keep_their_rows(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(Database(url)) as database:
        tenant = tenant_named(database, "ada")
    step = sa.text("alter table tenants add column note varchar(20) default 'new'")
    steps = (*tables.STEPS, lambda rows: rows.execute(step))
    monkeypatch.setattr(tables, "STEPS", steps)
    monkeypatch.setattr(tables, "LATEST", 1 + len(steps))
    for _ in range(2):  # the second finds nothing to do
        with closing(Database(url)) as database, database.read() as rows:
            assert rows.execute(sa.text("select id, note from tenants")).all() == [(tenant, "new")]
            assert rows.scalar(sa.select(tables.VERSION.c.version)) == tables.LATEST
    monkeypatch.undo()
    with pytest.raises(InputError, match="of a newer facepipe"):
        Database(url)


def test_of_many_who_claim_each_job_has_one(url: str, tmp_path: Path) -> None:
    from concurrent.futures import ThreadPoolExecutor

    from facepipe.server.artefacts import Artefacts

    with closing(Database(url)) as database:
        library = Library(database, Artefacts(str(tmp_path / "artefacts")), 10**9)
        tenant = tenant_named(database, "ada")
        servers = [Jobs(library, new_id()) for _ in range(4)]
        for _ in range(40):
            servers[0].add(tenant, Asked(action="sample", fields={}, face=new_id(), base=None))

        def claimed(number: int) -> list[str]:
            found = []
            while (job := servers[number].claim()) is not None:
                found.append(job.id)
            return found

        with ThreadPoolExecutor(4) as pool:
            all_of_them = [job for found in pool.map(claimed, range(4)) for job in found]
    assert len(all_of_them) == len(set(all_of_them)) == 40


def test_a_database_that_is_none_is_said_in_a_line() -> None:
    for wrong, what in {"mysqlite:///x": "is no URL", "nothing": "is no URL"}.items():
        with pytest.raises(InputError, match=what):
            Database(wrong)
