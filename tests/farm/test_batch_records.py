"""What a state folder and a cache say of tasks counts only where it is whole, below the roots, and of what is there."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import Capsys, failed
from conftest import PLAN, Runner
from trespass import trespassing

from facepipe.core.errors import InputError
from facepipe.core.policy.paths import Reach, Trust, private_folder, trusting, typed_roots
from facepipe.farm.batch import batch
from facepipe.farm.plan import read_plan
from facepipe.tasks.contents import Contents
from facepipe.tasks.ledger import FILE, is_outcome, is_record, ledger_in, parsed
from facepipe.tasks.mirror import mirror

RECORD: dict[str, Any] = {
    "task": "game/a", "status": "made", "version": "0", "key": "k", "seconds": 0.5, "verb": "export", "missed": False,
    "words": ["export", "a\n"], "reads": {"a": [1, 2], "s3://b/c": [3, "tag"]}, "writes": {"b": [[1, 2], "sha256:0"]},
    "report": {"error_mm": 0.1}, "attribution": ["CC0"], "peak_mb": None, "lost": 0, "passing": False,
}  # fmt: skip
DAMAGE: dict[str, tuple[Any, ...]] = {
    "task": (None, 3, "a\nb", "\x1b[2J"),
    "status": ("done", None),
    "words": ("export", [1], None),
    "key": (None,),
    "seconds": ("x", None, -1.0, float("nan"), float("inf"), True),
    "peak_mb": ("x", float("nan")),
    "reads": (None, [], {"a": None}, {"a": [1]}, {"a": ["x", 2]}, {"a": [1, [2]]}, {"\ud800": [1, 2]}),
    "writes": (
        None, [], {"b": None}, {"b": [[1, 2], "s", "more"]}, {"b": ["x", "s"]}, {"b": [[1, 2], 3]},
        {"b": [[1, 2], "s"], "\ud800.png": [[1, 2], "s"]},
    ),
    "report": (None, "text", [], {"x_mm": 10**400}, {"x_mm": {"mean": float("inf")}}),
    "attribution": (None, "CC0", [["CC0"]], ["a\nb"]),
    "missed": ("yes", 1),
    "error": (None, ["x"], "two\nlines"),
}  # fmt: skip


def lines_of(state: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (state / FILE).read_text().splitlines()]


def change(state: Path, task: str, **said: Any) -> None:
    """What the ledger says of a task."""
    records = [{**one, **(said if one["task"] == task else {})} for one in lines_of(state)]
    (state / FILE).write_text("".join(f"{json.dumps(one)}\n" for one in records))


def test_a_whole_record_counts() -> None:
    assert is_record(RECORD)
    assert is_record({"task": "a", "status": "failed", "error": "why"})
    assert not is_record({"task": "a", "status": "made"})
    assert not is_record({"task": "a", "status": "failed"})  # it doesn't say why


def test_numbers_that_no_report_has_are_no_json() -> None:
    assert parsed(b'{"x_mm": 1e300, "seed": 18446744073709551615}') == {"x_mm": 1e300, "seed": 2**64 - 1}
    for text in (
        b'{"x_mm": 1e400}',
        b'{"x_mm": -1e999}',
        b'{"x": 1' + b"0" * 400 + b"}",
        b"[" + b"[]," * 1_500_000 + b"[]]",
    ):
        assert parsed(text) is None


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in DAMAGE.items() for value in values])
def test_a_damaged_record_does_not(key: str, value: object) -> None:
    damaged = parsed(json.dumps({**RECORD, key: value}).encode())
    assert damaged is None or not is_record(damaged)
    assert damaged is None or not is_outcome(damaged) or key in ("task", "status")


def test_records_of_others_end_no_run(show: Path, run_plan: Runner) -> None:
    run_plan(PLAN)
    damaged = [{**one, key: value} for one in lines_of(show / "state") for key in DAMAGE for value in DAMAGE[key]]
    texts = ["null", "3", '"text"', "[" * 100_000, "{" * 100_000, '{"task": "mixed/ada"', "\0" * 3_000_000]
    (show / "state" / FILE).write_text("\n".join([*texts, *map(json.dumps, damaged), ""]))
    assert dict(run_plan().counts) == {"made": 6}


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize(
    "writes",
    [
        {},
        {"heads/ada.bin": [[3, 0], "sha256:0"]},
        {"../outside.bin": [[3, 0], "sha256:0"]},
        {"http://h/a": [[3, "t"], ""]},
    ],
)
def test_a_record_without_its_result_counts_for_nothing(
    show: Path, run_plan: Runner, writes: dict[str, Any], resume: bool
) -> None:
    run_plan(PLAN)
    change(show / "state", "mixed/ada", writes=writes)
    report = run_plan(resume=resume)
    assert report.counts["made"] + report.counts["kept"] == 6
    assert (
        "built/mixed/ada.bin"
        in next(one for one in lines_of(show / "state")[::-1] if one["task"] == "mixed/ada")["writes"]
    )


def test_a_failure_that_says_no_reason_is_none(show: Path, run_plan: Runner) -> None:
    run_plan(PLAN)
    change(show / "state", "mixed/ada", status="failed")
    assert dict(run_plan().counts) == {"kept": 5, "made": 1}


def test_a_step_without_results_stands_on_what_it_read(show: Path, run_plan: Runner) -> None:
    text = PLAN + '[steps.check]\nrun = "copy-none {face}"\n'
    assert run_plan(text).counts["failed"] == 3  # there is no such line
    for name in ("ada", "bea", "cyd"):
        said = {"status": "made", "key": "k", "seconds": 1.0, "reads": {}, "writes": {}}
        change(show / "state", f"check/{name}", **said)
    assert run_plan(resume=True).counts["failed"] == 3


@pytest.mark.skipif(sys.platform == "win32", reason="pipes are others there")
def test_a_result_that_is_no_file_is_made_again(show: Path, run_plan: Runner) -> None:
    run_plan(PLAN)
    os.mkfifo(show / "built/pipe")
    good = next(one for one in lines_of(show / "state") if one["task"] == "mixed/ada")["writes"]
    change(show / "state", "mixed/ada", writes={**good, "built/pipe": [[0, 1], "sha256:0"]})
    assert dict(run_plan().counts) == {"kept": 5, "made": 1}


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_a_ledger_that_is_another_file_too_leaves_that_alone(show: Path, run_plan: Runner, tmp_path: Path) -> None:
    (tmp_path / "own").write_text("mine\n")
    (show / "state").mkdir()
    os.link(tmp_path / "own", show / "state" / FILE)
    assert dict(run_plan(PLAN).counts) == {"made": 6}
    assert (tmp_path / "own").read_text() == "mine\n"


def test_a_step_over_very_many_faces_is_kept_too(tmp_path: Path) -> None:
    reads = {f"built/game/{number:06}.bin": [9, 1795849685357904853] for number in range(25_000)}
    with ledger_in(tmp_path) as ledger:
        ledger.add({**RECORD, "task": "all", "reads": reads})
    with ledger_in(tmp_path) as ledger:
        assert ledger.records["all"]["reads"] == reads


def test_a_task_looks_at_nothing_outside_the_roots(tmp_path: Path) -> None:
    """Neither into a folder, which could be the whole disk, nor for files that are named beside what it reads."""
    sent, private = tmp_path / "sent", tmp_path / "private"
    sent.mkdir(), (private / "deep").mkdir(parents=True)
    (private / "notes.mtl").write_text("map_Kd deep/a.png\n")
    (sent / "face.obj").write_text("mtllib ../private/notes.mtl\nv 0 0 0\n")
    (sent / "face2.obj").write_text("mtllib ../private/none.mtl\nv 0 0 0\n")
    for name in (private, sent / "face.obj", sent / "face2.obj"):
        with trusting(Trust(roots=(sent,), confined=True)), trespassing(private) as done:
            with pytest.raises(InputError, match="is outside the roots"):
                Contents().content_of(name)
            assert done == []


def test_a_record_of_others_that_lacks_what_none_needs_is_kept(show: Path, run_plan: Runner) -> None:
    run_plan(PLAN)
    records = [
        {key: one[key] for key in one if key not in ("attribution", "report", "peak_mb")}
        for one in lines_of(show / "state")
    ]
    (show / "state" / FILE).write_text("".join(f"{json.dumps(one)}\n" for one in records))
    assert dict(run_plan(verify=True).counts) == {"kept": 6}


def test_resume_wants_the_results_to_be_there(show: Path, run_plan: Runner) -> None:
    run_plan(PLAN)
    (show / "built/mixed/ada.bin").unlink()
    assert dict(run_plan(resume=True).counts) == {"kept": 5, "made": 1}


def test_verify_finds_results_that_others_changed_unseen(show: Path, run_plan: Runner) -> None:
    run_plan(PLAN)
    result = show / "built/mixed/ada.bin"
    good, state = result.read_bytes(), result.stat()
    result.write_bytes(b"x" * len(good))
    os.utime(result, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert dict(run_plan().counts) == {"kept": 6}
    assert result.read_bytes() != good
    assert run_plan(verify=True).counts["made"] >= 1
    assert result.read_bytes() == good
    assert dict(run_plan(verify=True).counts) == {"kept": 6}


def _entry(cache: Path) -> Path:
    return next(one for one in cache.iterdir() if "mixed/ada" in (one / "record.json").read_text())


def _renamed(entry: Path) -> None:
    text = (entry / "record.json").read_text()
    (entry / "record.json").write_text(text.replace("built/mixed/ada.bin", "base.bin"))


def _as_link(entry: Path) -> None:
    (entry / "0").rename(entry / "00")
    (entry / "0").symlink_to(entry / "00")


@pytest.mark.skipif(sys.platform == "win32", reason="links and pipes need rights there")
@pytest.mark.parametrize(
    "damage",
    [
        _renamed,  # a source would be written over
        _as_link,
        lambda entry: (entry / "record.json").write_text('{"writes": []}'),
        lambda entry: (entry / "record.json").write_text('{"writes": {}}'),
        lambda entry: (entry / "record.json").write_text("null"),
        lambda entry: ((entry / "record.json").unlink(), os.mkfifo(entry / "record.json")),
        lambda entry: (shutil.rmtree(entry), os.mkfifo(entry)),
        lambda entry: (entry.rename(entry.parent.parent / "there"), entry.symlink_to(entry.parent.parent / "there")),
    ],
)
def test_a_cache_of_others_gives_the_result_of_the_task_or_nothing(
    show: Path, run_plan: Runner, tmp_path: Path, damage: Callable[[Path], object]
) -> None:
    cache = tmp_path / "cache"
    run_plan(PLAN, cache=cache)
    damage(_entry(cache))
    (show / "built/mixed/ada.bin").unlink()
    (show / "state" / FILE).unlink()
    counts = run_plan(cache=cache).counts
    assert counts["made"] == 1, counts
    assert (show / "base.bin").read_text() == "base"
    assert (show / "built/mixed/ada.bin").read_bytes() == b"adabase"


def test_what_else_is_in_a_cache_stays(show: Path, run_plan: Runner, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    (cache / "holiday").mkdir(parents=True)
    (cache / "holiday/photo.bin").write_bytes(bytes(3_000_000))
    run_plan(PLAN, cache=cache, cache_gb=0.001)
    assert (cache / "holiday/photo.bin").exists()
    assert len(list(cache.iterdir())) == 7


def test_an_entry_that_is_larger_than_its_cache_is_not_read(show: Path, run_plan: Runner, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    run_plan(PLAN, cache=cache)
    entry = _entry(cache)
    os.truncate(entry / "0", 3_000_000)
    own = hashlib.sha256((entry / "0").read_bytes()).hexdigest()
    said = {"writes": {"built/mixed/ada.bin": [None, f"sha256:{own}"]}}
    (entry / "record.json").write_text(json.dumps({**json.loads((entry / "record.json").read_text()), **said}))
    (show / "built/mixed/ada.bin").unlink()
    run_plan(cache=cache, cache_gb=0.001)
    assert (show / "built/mixed/ada.bin").read_bytes() == b"adabase"


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_copies_go_to_no_link_in_their_folder(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir(), (tmp_path / "local").mkdir()
    (tmp_path / "local/copies").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="local/copies: is a link"), mirror(["s3://b"], str(tmp_path / "local"), 1):
        pass


def test_a_cache_in_the_working_folder_is_none_of_the_users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home, work = tmp_path / "home", tmp_path / "work"
    home.mkdir(), work.mkdir()
    monkeypatch.chdir(work)
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("USERPROFILE", str(home))
    for said in ("cache", ".", ""):
        monkeypatch.setenv("XDG_CACHE_HOME", said)
        with mirror(["s3://b"], None, 1):
            assert list((home / ".cache/facepipe").iterdir())
    assert not list(work.iterdir())


def test_processes_are_at_most_four_a_core(show: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    (show / "plan.toml").write_text(PLAN)
    monkeypatch.chdir(show)
    assert "expected 1 to " in failed(capsys, "batch", "plan.toml", "--processes", "1000000", folder=show)
    with pytest.raises(InputError, match="expected 1 to 1024"):
        batch(read_plan(show / "plan.toml"), show / "state", processes=1025, cluster="tcp://127.0.0.1:9")


def test_typed_urls_allow_their_folder() -> None:
    words = ("s3://b/heads/*.glb", "gs://c/{name}/x.glb", "http://h/x", "plain", "s3://b/heads/a.usda", "s3://d/f.usda")
    assert typed_roots(words) == ("s3://b/heads", "gs://c", "s3://d")


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_names_in_records_reach_what_lies_below_the_roots(tmp_path: Path) -> None:
    inside, outside = tmp_path / "in", tmp_path / "out"
    inside.mkdir(), outside.mkdir()
    (inside / "lib").symlink_to(outside)
    (inside / "a").symlink_to(outside / "a")
    (inside / "b").symlink_to(inside / "c")
    (inside / "deep").mkdir()
    (inside / "deep/lib").symlink_to(outside)
    reach = Reach(inside, (inside,), ("s3://b/f",))
    assert all(map(reach, ("x", "deep/x", "b", str(inside / "x"), "../in/x", "s3://b/f/x")))
    assert all(map(Reach(tmp_path, (inside,), ()), ("in/x", "in/none/y/x", "in/deep/x")))
    around = Reach(tmp_path, (inside,), ())
    assert not any(map(around, ("x", "out/x", "in/lib/x", "in/deep/../../x", "in/deep/lib/y/x")))
    assert not any(map(reach, ("deep/lib/x", "deep/lib/y/x", "deep/../../out/y/x", "a\0/x")))
    assert not any(map(reach, ("../out/x", "lib/x", "a", "..", "/etc/passwd", "s3://b/x", "http://h/f", "a\0b")))


@pytest.mark.skipif(sys.platform == "win32", reason="modes are others there")
def test_copies_in_the_folder_of_a_user_are_of_that_user_alone(tmp_path: Path) -> None:
    place = tmp_path / "cache/facepipe"
    place.parent.mkdir()
    place.mkdir(mode=0o755)
    assert stat.S_IMODE(private_folder(place).stat().st_mode) == 0o700
    (tmp_path / "link").symlink_to(place)
    with pytest.raises(InputError, match="is a link"):
        private_folder(tmp_path / "link")


@pytest.mark.skipif(sys.platform == "win32" or os.geteuid() != 0, reason="only root can give a folder away")
def test_a_folder_of_another_user_is_refused(tmp_path: Path) -> None:
    place = tmp_path / "facepipe"
    place.mkdir(mode=0o777)
    os.chown(place, 65534, 65534)
    with pytest.raises(InputError, match="belongs to another user"):
        private_folder(place)
    assert place.stat().st_uid == 65534
