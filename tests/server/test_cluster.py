"""Jobs done by the workers of a Dask cluster: a real scheduler, a real worker, a real server."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from farm_cluster import Farm, children, farm_in, until
from served import Serve, Served, done, ended, kept, sent

pytest.importorskip("distributed", reason="no Dask")
pytestmark = [pytest.mark.slow]


@pytest.fixture(scope="module")
def farm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Farm]:
    """A cluster of one worker."""
    with farm_in(tmp_path_factory.mktemp("cluster") / "farm", 1, made_up=False) as farm:
        yield farm


@pytest.fixture
def served(serve: Serve, farm: Farm) -> Served:
    """A server whose jobs the cluster does, with two heads of people, whose blend takes some seconds."""
    served = serve("--cluster", farm.address)
    for seed in (1, 2):
        done(served.client, "sample", {"seed": seed, "textures": 0})
    return served


def blending(client: httpx.Client) -> str:
    """A job that blends all faces."""
    sources = [{"face": one["id"]} for one in client.get("/api/v1/faces").json()["faces"]]
    return str(client.post("/api/v1/jobs", json={"action": "blend", "fields": {"sources": sources}}).json()["id"])


def test_a_job_on_a_cluster_tells_its_progress_and_is_kept(served: Served) -> None:
    job = blending(served.client)
    with served.client.stream("GET", f"/api/v1/jobs/{job}/events") as answer:
        told = [line for line in answer.iter_lines() if line.startswith("data: ")]
    assert '"state":"done"' in told[-1]
    assert any('"progress":{"text"' in line for line in told)
    face = ended(served.client, job)["face"]
    assert served.client.get(f"/api/v1/faces/{face}/versions/1/face.glb").content[:4] == b"glTF"


def test_a_job_that_is_cancelled_ends_on_its_worker(served: Served, farm: Farm, heads: list[Path]) -> None:
    """The worker goes on with the next."""
    (worker,) = farm.workers
    job = blending(served.client)
    until(lambda: served.client.get(f"/api/v1/jobs/{job}").json()["progress"])
    doing = children(worker)
    assert served.client.delete(f"/api/v1/jobs/{job}").json()["state"] == "cancelled"
    until(lambda: not doing & children(worker))
    assert ended(served.client, job)["state"] == "cancelled"
    assert kept(served.client, heads[0])
    assert len(served.client.get("/api/v1/faces").json()["faces"]) == 3


def test_a_cluster_that_goes_away_loses_no_job(serve: Serve, heads: list[Path], tmp_path: Path) -> None:
    with farm_in(tmp_path / "farm", 1, made_up=False) as farm:
        served = serve("--cluster", farm.address)
        kept(served.client, heads[0])
        farm.scheduler.kill()
        jobs = [sent(served.client, head).json()["job"]["id"] for head in heads]
        time.sleep(3.0)
        assert {served.client.get(f"/api/v1/jobs/{job}").json()["state"] for job in jobs} <= {"queued", "running"}
        farm.restart()
        farm.worker()
        assert [ended(served.client, job)["state"] for job in jobs] == ["done"] * 3
    assert len(served.client.get("/api/v1/faces").json()["faces"]) == 4
