"""A plan run: what is done, what is kept, what is done again, and what goes wrong without stopping the rest."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

import pytest
from conftest import PLAN, Runner

from facepipe.core.errors import InputError
from facepipe.farm.batch import batch
from facepipe.farm.plan import RunOptions, each, read_plan, read_table


def log(show: Path) -> list[str]:
    """The results that were made since the last call."""
    path = show / "log"
    lines = path.read_text().split() if path.exists() else []
    path.unlink(missing_ok=True)
    return sorted(lines)


def test_each_step_of_each_face_is_done_after_what_it_needs(show: Path, run_plan: Runner) -> None:
    report = run_plan(PLAN, processes=2)
    assert (report.faces, report.tasks, dict(report.counts), report.missed) == (3, 6, {"made": 6}, False)
    assert (show / "built/game/bea.bin").read_text() == "beabase"


def test_what_is_done_is_not_done_again(show: Path, run_plan: Runner) -> None:
    run_plan(PLAN)
    log(show)
    assert dict(run_plan().counts) == {"kept": 6}
    assert log(show) == []


def test_a_changed_source_is_followed_and_nothing_else(show: Path, run_plan: Runner) -> None:
    run_plan(PLAN)
    log(show)
    (show / "heads/bea.bin").write_text("Bea")
    assert dict(run_plan().counts) == {"kept": 4, "made": 2}
    assert log(show) == ["built/game/bea.bin", "built/mixed/bea.bin"]
    assert (show / "built/game/bea.bin").read_text() == "Beabase"


def test_a_source_that_is_written_again_with_the_same_bytes_makes_no_work(show: Path, run_plan: Runner) -> None:
    run_plan(PLAN)
    log(show)
    os.utime(show / "base.bin", ns=(1, 1))
    assert dict(run_plan().counts) == {"kept": 6}
    assert log(show) == []


def test_a_result_that_was_changed_or_lost_is_made_again(show: Path, run_plan: Runner) -> None:
    run_plan(PLAN)
    log(show)
    (show / "built/mixed/ada.bin").write_text("by hand")
    (show / "built/game/cyd.bin").unlink()
    run_plan()
    assert log(show) == ["built/game/cyd.bin", "built/mixed/ada.bin"]
    assert (show / "built/mixed/ada.bin").read_text() == "adabase"


def test_a_changed_line_is_followed(show: Path, run_plan: Runner) -> None:
    run_plan(PLAN)
    log(show)
    run_plan(PLAN.replace('"copy {mixed}"', '"copy {mixed} {mixed}"'))
    assert log(show) == ["built/game/ada.bin", "built/game/bea.bin", "built/game/cyd.bin"]


def test_a_step_once_has_the_results_of_all_faces(show: Path, run_plan: Runner) -> None:
    run_plan(PLAN + '[steps.all]\nonce = true\nrun = "copy {game}"\nout = "all.bin"\n')
    assert (show / "built/all.bin").read_text() == "adabasebeabasecydbase"


def test_one_bad_face_never_stops_the_rest(show: Path, run_plan: Runner) -> None:
    text = PLAN.replace('glob = "heads/*.bin"', 'csv = "faces.csv"')
    (show / "faces.csv").write_text("name,face\nada,heads/ada.bin\nlost,heads/lost.bin\ncyd,heads/cyd.bin\n")
    report = run_plan(text)
    assert dict(report.counts) == {"made": 4, "failed": 1, "skipped": 1}
    assert report.failures == ("heads/lost.bin: no such file",)
    assert report.missed
    assert (show / "built/game/cyd.bin").is_file()


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (("{face} base", "{fase} base"), "{fase} is no column of the table and no step, did you mean 'face'?"),
        (("copy {face}", "copy {game}"), "needs itself: "),
        (("steps.game", "steps.face"), "steps.face: is the name of a column too, expected another"),
        (("mixed/{name}", "mixed/one"), "out is built/mixed/one.bin, that of mixed/ada too, expected another"),
    ],
)
def test_a_fault_of_a_step_is_a_line(show: Path, run_plan: Runner, change: tuple[str, str], fault: str) -> None:
    more = '[steps.other]\nrun = "copy {face}"\nout = "other/{name}.bin"\n'
    report = run_plan(PLAN.replace(*change) + more)
    assert fault in report.failures[0]
    assert len(report.failures) <= 2  # not one for each face and each step that follows
    assert sorted(one.name for one in (show / "built/other").iterdir()) == ["ada.bin", "bea.bin", "cyd.bin"]


def test_a_process_that_dies_is_another_the_next_time(show: Path, run_plan: Runner) -> None:
    report = run_plan(PLAN.replace("copy {mixed}", "die-once {name}"))
    assert dict(report.counts) == {"made": 6}


def test_a_face_that_kills_its_process_fails_alone(show: Path, run_plan: Runner) -> None:
    report = run_plan(PLAN + '[steps.bad]\nonce = true\nrun = "die"\n', failures=1)
    assert dict(report.counts) == {"made": 6, "failed": 1}
    assert report.failures == ("bad: its process ended (signal 9)",)


def test_a_task_that_hangs_is_ended(show: Path, run_plan: Runner) -> None:
    more = '[steps.bad]\nonce = true\nrun = "hang"\nseconds = 0.5\n'
    assert run_plan(PLAN + more, failures=0).failures == ("bad: took more than 0.5 seconds",)


def test_a_task_that_takes_too_much_memory_is_ended(show: Path, run_plan: Runner) -> None:
    more = '[steps.bad]\nonce = true\nrun = "eat 900"\nmemory_mb = 600\n'
    assert "MB, expected at most 600" in run_plan(PLAN + more, failures=0).failures[0]


@pytest.mark.skipif(sys.platform != "linux", reason="what a process has is known on Linux alone")
def test_a_process_that_loses_memory_is_replaced_and_no_task_is_lost(show: Path, run_plan: Runner) -> None:
    rows = "range = { seed = [1, 7] }"
    report = run_plan(PLAN.replace('glob = "heads/*.bin"', rows).replace("copy {face} base.bin", "keep {name}"))
    assert dict(report.counts) == {"made": 14}
    assert len({one.read_text() for one in (show / "built/mixed").iterdir()}) > 1
    records = json.loads((show / "state/report.json").read_text())["records"]
    assert {record["lost"] for record in records} == {0}


def test_a_full_disk_is_tried_again_and_then_told(show: Path, run_plan: Runner) -> None:
    report = run_plan(PLAN + '[steps.bad]\nonce = true\nrun = "fill"\nout = "x.bin"\n', failures=2)
    assert report.failures == ("OSError: [Errno 28] No space left on device",)
    state = json.loads((show / "state/report.json").read_text())
    assert next(one for one in state["records"] if one["task"] == "bad")["lost"] == 3
    assert not (show / "built/x.bin").exists()


def test_what_failed_is_done_again_where_it_is_asked_for_or_its_source_has_changed(
    show: Path, run_plan: Runner
) -> None:
    text = PLAN.replace("copy {mixed}", "export {mixed}").replace("game/{name}.bin", "game/{name}.glb")
    assert len(run_plan(text).failures) == 3
    before = (show / "state/tasks.jsonl").stat().st_size
    assert len(run_plan().failures) == 3
    assert (show / "state/tasks.jsonl").stat().st_size == before  # nothing was tried
    assert len(run_plan(retry_failed=True).failures) == 3
    assert (show / "state/tasks.jsonl").stat().st_size > before


def test_resume_takes_what_is_done_as_it_is(show: Path, run_plan: Runner) -> None:
    run_plan(PLAN)
    log(show)
    (show / "base.bin").write_text("other")
    assert dict(run_plan(resume=True).counts) == {"kept": 6}
    assert log(show) == []


def test_a_line_of_the_ledger_that_was_cut_off_is_as_if_never_written(show: Path, run_plan: Runner) -> None:
    run_plan(PLAN)
    ledger = show / "state/tasks.jsonl"
    ledger.write_bytes(ledger.read_bytes()[:-40])
    log(show)
    assert dict(run_plan().counts) == {"kept": 5, "made": 1}
    assert dict(run_plan().counts) == {"kept": 6}


def test_results_come_from_the_cache_and_it_stays_within_its_size(show: Path, run_plan: Runner, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    run_plan(PLAN, cache=cache)
    for one in (show / "built").rglob("*.bin"):
        one.unlink()
    log(show)
    assert dict(run_plan(cache=cache).counts) == {"cached": 6}
    assert log(show) == []
    assert (show / "built/game/ada.bin").read_text() == "adabase"
    damaged = next(cache.iterdir()) / "0"
    damaged.write_text("damaged")
    for one in (show / "built").rglob("*.bin"):
        one.unlink()
    assert dict(run_plan(cache=cache).counts) == {"cached": 5, "made": 1}
    (show / "base.bin").write_bytes(bytes(3_000_000))
    run_plan(cache=cache, cache_gb=0.01)
    assert sum(one.stat().st_size for one in cache.rglob("*")) <= 1e7


def test_a_cache_in_a_folder_of_other_things_removes_its_own_alone(
    show: Path, run_plan: Runner, tmp_path: Path
) -> None:
    (tmp_path / "mine/photos").mkdir(parents=True)
    (tmp_path / "mine/photos/large.bin").write_bytes(b"0" * 2_000_000)
    run_plan(PLAN, cache=tmp_path / "mine", cache_gb=0.001)
    assert (tmp_path / "mine/photos/large.bin").stat().st_size == 2_000_000


def test_no_step_is_called_as_the_folder_of_results(run_plan: Runner) -> None:
    with pytest.raises(InputError, match=r"steps\.out: \{out\} is the folder of results, expected another name"):
        run_plan(PLAN.replace("steps.game", "steps.out"))


@pytest.mark.parametrize("name", ["../out", "/tmp/out", "a/../../b"])
def test_values_never_lead_out_of_the_folder_of_results(show: Path, run_plan: Runner, name: str) -> None:
    (show / "faces.csv").write_text(f"name,face,shot\nada,heads/ada.bin,{name}\n")
    text = PLAN.replace('glob = "heads/*.bin"', 'csv = "faces.csv"').replace("mixed/{name}", "mixed/{shot}")
    assert "which leads out of the folder of results" in run_plan(text).failures[0]


def test_reads_and_writes_stay_below_the_roots(show: Path, run_plan: Runner, tmp_path: Path) -> None:
    (tmp_path / "secret.usda").write_text("#usda 1.0\n")
    text = PLAN.replace("copy {face} base.bin", "export {face} ../secret.usda")
    rows = 'rows = [{ name = "x", face = "../secret.usda" }]'
    text = PLAN.replace('glob = "heads/*.bin"', rows).replace("copy {face} base.bin", "export {face}")
    assert "is outside the roots" in run_plan(text.replace("mixed/{name}.bin", "mixed/{name}.glb")).failures[0]
    with pytest.raises(InputError, match=r"out: .*elsewhere/face is outside the roots"):
        run_plan(PLAN.replace('"built"', '"../elsewhere"'))
    outward = PLAN.replace('out = "mixed/{name}.bin"', 'out = "../../elsewhere/{name}.bin"')
    assert "is outside the roots" in run_plan(outward).failures[0]
    assert not (tmp_path / "elsewhere").exists()


def test_a_value_is_never_a_flag(show: Path, run_plan: Runner) -> None:
    rows = 'rows = [{ name = "x", face = "--trust-models" }]'
    report = run_plan(PLAN.replace('glob = "heads/*.bin"', rows))
    assert "reads as a flag" in report.failures[0]


@pytest.mark.parametrize(
    "line", ["view {face}", "batch plan.toml", "export {face} --root /", "export {face} --trust-models"]
)
def test_a_line_can_do_what_steps_can_alone(show: Path, run_plan: Runner, line: str) -> None:
    text = PLAN.replace("copy {face} base.bin", line).replace("mixed/{name}.bin", "mixed/{name}.glb")
    assert run_plan(text).counts["failed"] == 3
    assert not (show / "built/mixed").exists() or not any((show / "built/mixed").iterdir())


def test_a_state_is_of_one_run_at_a_time(show: Path, run_plan: Runner) -> None:
    from facepipe.core.locks import locked

    (show / "state").mkdir()
    with locked(show / "state/tasks.jsonl"), pytest.raises(InputError, match="by another process"):
        run_plan(PLAN)


def test_the_page_shows_what_there_is(show: Path, run_plan: Runner) -> None:
    (show / "heads/<b>.bin").write_text("x")
    run_plan(PLAN + '[steps.bad]\nrun = "export {face}"\nout = "{name}.glb"\n')
    page = (show / "state/report.html").read_text()
    assert "<b>ada</b>" in page
    assert "off 0.25 mm" in page
    assert "heads/ada.bin" in page
    assert "<b>.bin" not in page


@pytest.mark.parametrize(
    "line",
    [
        "7",
        "[]",
        '{"task": 7}',
        '{"task": "mixed/ada", "status": "made"}',
        '{"task": "mixed/ada", "status": "made", "key": 1, "reads": {"a": 1}, "writes": {}}',
        '{"task": "mixed/ada", "status": "made", "key": "x", "reads": {}, "writes": {"a": ["b"]}}',
        '{"task": "mixed/ada", "status": "made", "key": "x", "reads": {}, "writes": {"/etc/passwd": [[1, 2], "y"]}}',
        '{"task": "mixed/ada", "status": "failed", "reads": 3}',
        "[" * 100_000,
    ],
)
def test_a_ledger_of_others_is_data(show: Path, run_plan: Runner, line: str) -> None:
    (show / "state").mkdir()
    (show / "state/tasks.jsonl").write_text(f"{line}\n")
    assert dict(run_plan(PLAN).counts) == {"made": 6}


def test_a_ledger_that_is_a_link_is_refused(show: Path, run_plan: Runner, tmp_path: Path) -> None:
    (show / "state").mkdir()
    (tmp_path / "own").write_text("mine")
    (show / "state/tasks.jsonl").symlink_to(tmp_path / "own")
    with pytest.raises(InputError, match="is a link"):
        run_plan(PLAN)
    assert (tmp_path / "own").read_text() == "mine"


def test_a_cache_of_others_writes_within_the_roots_alone(show: Path, run_plan: Runner, tmp_path: Path) -> None:
    cache, target = tmp_path / "cache", tmp_path / "target"
    run_plan(PLAN, cache=cache)
    for entry in cache.iterdir():
        text = (entry / "record.json").read_text()
        (entry / "record.json").write_text(re.sub(r'"built/[^"]*"', json.dumps(str(target)), text))
    for one in (show / "built").rglob("*.bin"):
        one.unlink()
    assert dict(run_plan(cache=cache).counts) == {"made": 6}
    assert not target.exists()


def test_a_table_lies_below_the_roots(show: Path, run_plan: Runner, tmp_path: Path) -> None:
    (tmp_path / "faces.csv").write_text("name,face\nada,heads/ada.bin\n")
    with pytest.raises(InputError, match="outside the roots"):
        run_plan(PLAN.replace('glob = "heads/*.bin"', 'csv = "../faces.csv"'))


def test_a_line_for_each_file_is_a_plan_of_one_step(show: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(show)
    lines = (("copy", "{face}"), "a/{name}.one"), (("copy", "{face}", "base.bin"), "a/{name}.two")
    for _ in range(2):
        for words, out in lines:
            report = batch(each("heads/*.bin", words, out), processes=1)
    assert dict(report.counts) == {"kept": 3}  # lines of other formats leave each other alone
    assert (show / "a/cyd.two").read_text() == "cydbase"
    with pytest.raises(InputError, match="names no"):
        each("heads/*.bin", ("copy", "base.bin"), "x")


def test_faces_of_one_name_are_called_after_their_folders_too(show: Path) -> None:
    (show / "heads/old").mkdir()
    (show / "heads/old/ada.bin").write_text("old")
    rows = read_table("faces", show, {"glob": "heads/**/*.bin"})
    assert sorted(row.name for row in rows) == ["bea", "cyd", "heads_ada", "heads_old_ada"]


def test_what_a_worker_that_was_lost_left_beside_results_is_gone_in_the_end(show: Path) -> None:
    (show / "plan.toml").write_text(PLAN)
    left = show / "built/game/.facepipe-0123456789abcdef"

    def leave(*_: object) -> None:
        left.mkdir(parents=True, exist_ok=True)
        (left / ".facepipe-lock").touch()
        (left / "ada.bin").touch()

    batch(read_plan(show / "plan.toml"), show / "state", processes=1, options=RunOptions(), on_task=lambda _: leave)
    assert sorted(path.name for path in left.parent.iterdir()) == ["ada.bin", "bea.bin", "cyd.bin"]
