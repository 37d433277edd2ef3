"""Jobs are done once, whatever happens to the server meanwhile."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import httpx
import pytest
from served import Serve, Served, done, ended, kept, sent


def attempts(folder: Path) -> dict[str, list[str | None]]:
    """Job -> the outcomes of its attempts."""
    with sqlite3.connect(folder / "serve.db") as rows:
        found: dict[str, list[str | None]] = {}
        for job, outcome in rows.execute("select job, outcome from attempts order by job, attempt"):
            found.setdefault(job, []).append(outcome)
    return found


def test_events_tell_a_job_from_its_acceptance_to_its_end(client: httpx.Client, heads: list[Path]) -> None:
    job = sent(client, heads[0]).json()["job"]["id"]
    kinds, last = [], ""
    with client.stream("GET", f"/api/v1/jobs/{job}/events") as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        for line in answer.iter_lines():
            if line.startswith("event: "):
                kinds.append(line.removeprefix("event: "))
            last = line.removeprefix("data: ") if line.startswith("data: ") else last
    assert kinds[-1] == "done"
    assert set(kinds) <= {"state", "progress", "done"}
    assert '"state":"done"' in last


def test_a_job_that_is_cancelled_makes_nothing(client: httpx.Client) -> None:
    before = len(client.get("/api/v1/faces").json()["faces"])
    asked = {"action": "sample", "fields": {"seed": 5}}
    jobs = [client.post("/api/v1/jobs", json=asked).json()["id"] for _ in range(2)]
    for job in jobs:
        assert client.delete(f"/api/v1/jobs/{job}").json()["state"] == "cancelled"
    for job in jobs:
        assert ended(client, job)["state"] == "cancelled"
    assert client.delete(f"/api/v1/jobs/{jobs[0]}").json()["state"] == "cancelled"
    assert len(client.get("/api/v1/faces").json()["faces"]) == before


def test_what_a_job_can_not_do_is_said_in_one_line(client: httpx.Client, heads: list[Path]) -> None:
    face = kept(client, heads[0])
    asked = {"action": "sliders", "fields": {"face": {"face": face}, "values": {"noSuch": 1.0}}}
    job = ended(client, client.post("/api/v1/jobs", json=asked).json()["id"])
    assert job["state"] == "failed"
    assert "noSuch" in job["error"]
    assert client.get(f"/api/v1/faces/{face}").json()["version"] == 1


@pytest.mark.parametrize("how", ["kill", "stop"])
def test_no_accepted_job_is_lost_and_each_is_kept_once(
    how: str, serve: Serve, heads: list[Path], tmp_path: Path
) -> None:
    first = serve("--processes", "2", "--rate", "1000")
    jobs = [sent(first.client, heads[number % 3], name=f"Head {number}").json()["job"]["id"] for number in range(20)]
    until = time.monotonic() + 200
    while len([one for one in first.client.get("/api/v1/jobs").json()["jobs"] if one["state"] == "done"]) < 3:
        assert time.monotonic() < until
        time.sleep(0.05)
    first.kill() if how == "kill" else first.stop()
    assert not list((first.folder / "work").iterdir()) if (first.folder / "work").exists() and how == "stop" else True
    second = serve("--processes", "2", "--rate", "1000")
    assert [ended(second.client, job)["state"] for job in jobs] == ["done"] * 20
    faces = second.client.get("/api/v1/faces").json()["faces"]
    assert sorted(one["name"] for one in faces) == sorted(f"Head {number}" for number in range(20))
    assert {one["version"] for one in faces} == {1}
    outcomes = attempts(second.folder)
    assert [outcomes[job].count("done") for job in jobs] == [1] * 20
    others = {one for job in jobs for one in outcomes[job]} - {"done"}
    assert others <= {"lost" if how == "kill" else "stopped"}


def test_one_server_at_a_time_has_a_folder(serve: Serve, tmp_path: Path) -> None:
    serve()
    with pytest.raises(AssertionError, match="another process"):
        Served(tmp_path / "state")


def test_a_file_for_a_job_is_read_as_what_it_is(client: httpx.Client, heads: list[Path]) -> None:
    face = kept(client, heads[0])
    clip = "Timecode,BlendShapeCount,JawOpen\n00:00:00:00.0,1,0.0\n00:00:00:01.0,1,0.8\n"
    answer = client.post("/api/v1/files", params={"suffix": ".csv"}, content=clip.encode())
    assert answer.status_code == 201
    fields: dict[str, Any] = {"face": {"face": face}, "clip": answer.json()["artefact"]}
    job = done(client, "animate", fields, face=face)
    assert (job["face"], job["version"]) == (face, 2)
    assert client.get(f"/api/v1/faces/{face}").json()["versions"][1]["made_by"] == "animate"


@pytest.mark.skipif(not hasattr(os, "nice"), reason="Windows has priorities of its own")
@pytest.mark.parametrize(("line", "behind"), [(["take", "no.usdc", "out"], True), (["find", "no.png", "out"], False)])
def test_jobs_give_way_to_what_somebody_waits_for(line: list[str], behind: bool) -> None:
    script = """
import os, sys
from facepipe.server.program import read_line
before = os.nice(0)
for _ in range(2):
    try:
        read_line(sys.argv[1:]).run()
    except Exception as error:
        assert "no." in str(error), error
print(os.nice(0) - before)
"""
    done = subprocess.run([sys.executable, "-c", script, *line], capture_output=True, text=True, check=True)
    assert int(done.stdout) == (max(10 - os.nice(0), 0) if behind else 0)
