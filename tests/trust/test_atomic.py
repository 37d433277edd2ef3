"""Files and folders that appear whole or not at all: kills, failures, links, modes, what hostile folders bring."""

from __future__ import annotations

import errno
import json
import os
import secrets
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from places import SUPPORT, names

from facepipe.core import atomic, locks, placing
from facepipe.core.atomic import apart, collect, hidden_folder, replacing, replacing_folder, together, write_bytes
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import Trust, trusting

POSIX = pytest.mark.skipif(sys.platform == "win32", reason="no such calls there")
KEY = "0123456789abcdef"


def content(folder: Path) -> dict[str, str]:
    return {name: (folder / name).read_text() for name in names(folder) if (folder / name).is_file()}


def several(folder: Path) -> None:
    """Three new files and a new folder in the place of old ones, together."""
    with together(folder / "main"):
        for name in ("fresh", "main", "beside"):
            write_bytes(folder / name, b"new")
        with replacing_folder(folder / "report") as report:
            write_bytes(report / "two", b"new")


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A folder with what `several` replaces."""
    folder = tmp_path / "work"
    (folder / "report").mkdir(parents=True)
    for name in ("main", "beside", "report/one"):
        (folder / name).write_text("old")
    return folder


OLD = {"main": "old", "beside": "old", "report/one": "old"}
NEW = {"fresh": "new", "main": "new", "beside": "new", "report/two": "new"}


@POSIX
@pytest.mark.parametrize(
    "scenario",
    [
        "single",
        "several",
        "whole_folder",
        "two_renames",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("failing", "settling")),
    ],
)
def test_a_kill_at_any_step_leaves_old_or_new_and_the_next_run_is_clean(tmp_path: Path, scenario: str) -> None:
    script = SUPPORT / "kill_points.py"
    traced = subprocess.run([sys.executable, script, scenario, tmp_path], stdout=subprocess.PIPE, check=True)
    steps = json.loads(traced.stdout)
    assert (
        len(steps)
        > {"single": 8, "several": 50, "whole_folder": 12, "two_renames": 20, "settling": 20, "failing": 50}[scenario]
    )
    new = steps[0]["again"]
    before = {"face.glb", "face.json", "report/one", "stale.bin", "textures/a.png"}
    assert [step["settled"] for step in steps if step["settled"] != new] == [dict.fromkeys(before, "old")] * sum(
        step["settled"] != new for step in steps
    )
    assert all(step["again"] == new for step in steps)
    assert (steps[-1]["settled"] == new) == (scenario != "failing")
    for step in steps if scenario in ("several", "settling", "failing") else ():
        seen = step["killed"]
        told_of = {seen[name] for name in seen if name.startswith(("face", "report"))}
        assert len(told_of) == 1, f"old and new together: {seen}"
        assert "face.glb" in seen
        assert seen["face.glb"] == "old" or "textures/b.png" in seen
        assert seen["face.glb"] == "new" or "stale.bin" in seen
    if scenario == "whole_folder" and sys.platform == "linux":
        assert all(("report/one" in step["killed"]) != ("report/two" in step["killed"]) for step in steps)


def test_a_file_is_flushed_then_renamed_then_its_folder_flushed_once(
    old: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []
    flush, rename = os.fsync, Path.replace

    def fsync(descriptor: int) -> None:
        found = os.fstat(descriptor).st_ino
        seen.append("folder" if found == old.stat().st_ino else "file")
        flush(descriptor)

    def replace(self: Path, target: Path) -> Path:
        seen.append("rename")
        return rename(self, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(Path, "replace", replace)
    write_bytes(old / "main", b"new")
    assert seen == (["file", "rename"] if sys.platform == "win32" else ["file", "rename", "folder"])


@POSIX
def test_all_is_on_the_disk_before_the_first_of_several_changes(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flushed: set[int] = set()
    flush, place = os.fsync, placing.place
    before: dict[str, bool] = {}

    def fsync(descriptor: int) -> None:
        flushed.add(os.fstat(descriptor).st_ino)
        flush(descriptor)

    def placed(moves: list[placing.Move]) -> None:
        (hidden,) = {move.hidden for move in moves}
        for path in (old, hidden, *(one for one in hidden.rglob("*") if one.name != ".facepipe-lock")):
            before[path.name] = path.stat().st_ino in flushed
        flushed.clear()
        place(moves)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(atomic, "place", placed)
    several(old)
    assert all(before.values()), before
    assert {"main", "beside", "fresh", "report", "two", ".facepipe-journal"} <= set(before)
    assert flushed == {old.stat().st_ino}


@pytest.mark.parametrize("name", ["fresh", "main", "beside", "report"])
def test_a_place_that_cant_be_taken_leaves_all_as_it_was(old: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """All goes back where the main file is the old one still, else the next run completes what is new."""
    rename = Path.replace

    def replace(self: Path, target: Path) -> Path:
        if target == old / name:
            raise OSError(errno.EIO, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(Path, "replace", replace)
    with pytest.raises(InputError, match=r"main: can't be written: Input/output error"):
        several(old)
    monkeypatch.undo()
    if name in ("fresh", "main"):
        assert content(old) == OLD
    else:
        collect(old)
        assert content(old) == NEW


def test_a_folder_that_cant_be_moved_in_leaves_the_old_one(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rename = Path.replace

    def replace(self: Path, target: Path) -> Path:
        if target == old / "report":
            raise OSError(errno.EIO, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(atomic, "exchange", lambda one, other: False)
    monkeypatch.setattr(Path, "replace", replace)
    with pytest.raises(InputError, match="can't be written"), replacing_folder(old / "report") as folder:
        write_bytes(folder / "two", b"new")
    assert content(old) == OLD


@pytest.mark.parametrize("error", [ValueError("within"), KeyboardInterrupt()])
def test_an_error_within_leaves_all_as_it_was(old: Path, error: BaseException) -> None:
    def together_and_fail() -> None:
        with together(old / "main"):
            several(old)
            assert content(old).items() >= OLD.items()
            raise error

    def half_a_folder() -> None:
        with replacing_folder(old / "report") as folder:
            (folder / "half").write_text("half")
            raise error

    for fail in (together_and_fail, half_a_folder):
        with pytest.raises(type(error)):
            fail()
        assert content(old) == OLD


def _half(path: Path) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(b"half")
        raise ValueError("within")


def test_a_file_that_fails_and_is_given_up_is_no_part_of_the_rest(old: Path) -> None:
    with together(old / "main"):
        write_bytes(old / "main", b"new")
        with pytest.raises(ValueError, match="within"):
            _half(old / "beside")
    assert content(old) == OLD | {"main": "new"}


def test_apart_is_in_place_at_once(old: Path) -> None:
    def fail_late() -> None:
        with together(old / "main"):
            write_bytes(old / "main", b"new")
            with apart():
                write_bytes(old / "stage", b"new")
            _half(old / "beside")

    with pytest.raises(ValueError, match="within"):
        fail_late()
    assert content(old) == OLD | {"stage": "new"}


def test_a_folder_that_another_fills_meanwhile_is_not_lost(old: Path) -> None:
    with pytest.raises(InputError, match="was changed meanwhile"), replacing_folder(old / "report"):
        (old / "report" / "another").write_text("another")
    assert content(old) == OLD | {"report/another": "another"}


@POSIX
def test_a_file_keeps_its_mode_and_a_new_one_gets_the_usual(old: Path) -> None:
    (old / "main").chmod(0o640)
    (old / "beside").chmod(0o444)
    (old / "report").chmod(0o750)
    before = os.umask(0o027)
    try:
        several(old)
    finally:
        os.umask(before)
    modes = {name: (old / name).stat().st_mode & 0o7777 for name in ("main", "beside", "report", "fresh")}
    assert modes == {"main": 0o640, "beside": 0o444, "report": 0o750, "fresh": 0o640}


@POSIX
def test_a_link_stays_and_what_it_points_at_is_replaced(tmp_path: Path, old: Path) -> None:
    store = old / "store"
    store.mkdir()
    for name in ("main", "report"):
        (old / name).rename(store / name)
        (old / name).symlink_to(f"store/{name}")
    several(old)
    assert (old / "main").is_symlink()
    assert (old / "report").is_symlink()
    assert content(store) == {"main": "new", "report/two": "new"}
    assert not [name for name in names(old) if ".facepipe" in name]


@POSIX
def test_links_out_of_the_roots_and_to_nothing_are_refused(tmp_path: Path, old: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "file").write_text("theirs")
    (old / "out").symlink_to(outside / "file")
    (old / "folder").symlink_to(outside)
    (old / "nothing").symlink_to(outside / "nothing")
    for name, message in (("out", "outside the roots"), ("nothing", "is a link to nothing")):
        with pytest.raises(InputError, match=message):
            write_bytes(old / name, b"new")
    with pytest.raises(InputError, match="outside the roots"), replacing_folder(old / "folder"):
        pass
    assert content(outside) == {"file": "theirs"}
    with trusting(Trust(roots=(tmp_path,))):
        write_bytes(old / "out", b"new")
    assert content(outside) == {"file": "new"}


@POSIX
def test_nothing_is_made_in_a_linked_folder_of_the_working_folder(
    tmp_path: Path, old: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not even for a moment: no hidden folder, no lock, and no remains of a killed run are settled."""
    (tmp_path / "outside/.facepipe-0123456789abcdef").mkdir(parents=True)
    (old / "lib").symlink_to("../outside")
    monkeypatch.chdir(old)
    for make in (
        hidden_folder(Path("lib")),
        locks.locked(Path("lib/x")),
        replacing(Path("lib/x")),
        together(Path("lib/x")),
    ):
        with pytest.raises(InputError, match="outside the roots"), make:
            pass
    assert names(tmp_path / "outside") == [".facepipe-0123456789abcdef"]


@POSIX
def test_what_is_no_file_is_refused(old: Path) -> None:
    os.mkfifo(old / "pipe")
    for name, message in (("pipe", "is no regular file"), ("report", "is a folder"), (".facepipe-x", "names of")):
        with pytest.raises(InputError, match=message):
            write_bytes(old / name, b"new")


@POSIX
def test_hidden_folders_of_living_makers_stay(old: Path) -> None:
    with replacing(old / "main") as temporary:
        temporary.write_bytes(b"new")
        collect(old)
        write_bytes(old / "beside", b"new")
        assert temporary.exists()
    assert content(old) == OLD | {"main": "new", "beside": "new"}


@POSIX
def test_on_storage_without_locks_only_old_hidden_folders_go(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(descriptor: int) -> bool:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(locks, "_lock", none)
    for age in (60, 2 * 86400):
        left = old / f".facepipe-{secrets.token_hex(8)}"
        left.mkdir()
        (left / ".facepipe-lock").touch()
        then = left.stat().st_mtime - age
        os.utime(left / ".facepipe-lock", (then, then))
        several(old)
        assert left.exists() == (age == 60)


def test_a_hidden_folder_is_for_files_that_nobody_sees(old: Path) -> None:
    with hidden_folder(old) as inner:
        assert not list(inner.iterdir())
        several(inner)
        assert content(inner).items() >= NEW.items()
        assert content(old).items() >= OLD.items()
    assert content(old) == OLD


def journaled(folder: Path, moves: object, *, folders: object = (".",), key: str = KEY) -> Path:
    """A hidden folder as a killed process may leave it, or somebody may send it."""
    hidden = folder / f".facepipe-{key}"
    hidden.mkdir()
    (hidden / ".facepipe-lock").touch()
    (hidden / ".facepipe-journal").write_text(json.dumps({"folders": folders, "moves": moves}))
    return hidden


@pytest.mark.parametrize("disturbed", [False, True])
def test_a_journal_goes_on_only_over_what_its_writer_saw(old: Path, disturbed: bool) -> None:
    """Killed with `beside` put aside. Where another has written `main` since, that stays, and `beside` is back."""
    known = [[0, name, placing.identity(old / name), role] for name, role in (("main", "main"), ("beside", "beside"))]
    hidden = journaled(old, known)
    for name in ("main", "beside"):
        (hidden / name).write_text("new")
    (hidden / ".facepipe-former").mkdir()
    (old / "beside").rename(hidden / ".facepipe-former" / "beside")
    if disturbed:
        (old / "main").write_text("another")
    collect(old)
    assert content(old) == OLD | ({"main": "another"} if disturbed else {"main": "new", "beside": "new"})


def test_a_journal_is_gone_before_its_lock_is(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else another process would go on with what is half removed."""
    path, seen, close = journaled(old, []), [], os.close
    held = placing.claim(path)

    def closed(descriptor: int) -> None:
        seen.append((path / ".facepipe-journal").exists())
        close(descriptor)

    monkeypatch.setattr(os, "close", closed)
    assert held is not None
    placing.remove(held)
    assert seen[0] is False
    assert not path.exists()


HOSTILE: dict[str, Callable[[Path, Path], object]] = {
    "a name with folders": lambda old, outside: journaled(old, [[0, "../outside/file", None, "main"]]),
    "an absolute name": lambda old, outside: journaled(old, [[0, str(outside / "file"), None, "main"]]),
    "a dot": lambda old, outside: journaled(old, [[0, "..", None, "main"]]),
    "no name": lambda old, outside: journaled(old, [[0, "", None, "main"]]),
    "a name of ours": lambda old, outside: journaled(old, [[0, ".facepipe-lock", None, "main"]]),
    "a hole": lambda old, outside: journaled(old, [[0, "a\0b", None, "main"]]),
    "another folder": lambda old, outside: journaled(old, [[1, "main", None, "main"]], folders=[".", str(outside)]),
    "no such folder": lambda old, outside: journaled(old, [[7, "main", None, "main"]]),
    "another role": lambda old, outside: journaled(old, [[0, "main", None, "worse"]]),
    "a file that it can't know": lambda old, outside: journaled(old, [[0, "main", [1, 2, 3], "stale"]]),
    "a former that is none": lambda old, outside: journaled(old, [[0, "main", {"a": 1}, "main"]]),
    "a name that no file has": lambda old, outside: journaled(old, [[0, "\ud800", None, "main"]]),
    "a folder that is none": lambda old, outside: journaled(old, [[0, "main", None, "main"]], folders=[7]),
    "a folder with a hole": lambda old, outside: journaled(old, [[0, "main", None, "main"]], folders=["a\0b"]),
    "a folder that none is": lambda old, outside: journaled(old, [[0, "main", None, "main"]], folders=["\ud800"]),
    "folders of a text": lambda old, outside: journaled(old, [[0, "main", None, "main"]], folders="\0"),
    "joined to a hole": lambda old, outside: (hidden_only(old) / ".facepipe-joined").write_text("a\0b"),
    "no object": lambda old, outside: journaled(old, 7),
    "deep": lambda old, outside: (journaled(old, 0) / ".facepipe-journal").write_text("[" * 100_000),
    "no text": lambda old, outside: (journaled(old, 0) / ".facepipe-journal").write_bytes(b"\xff\xfe\0"),
    "joined to another": lambda old, outside: (hidden_only(old) / ".facepipe-joined").write_text(str(outside)),
    "joined to a machine": lambda old, outside: (hidden_only(old) / ".facepipe-joined").write_text("//host/share"),
    "joined to itself": lambda old, outside: (hidden_only(old) / ".facepipe-joined").write_text("."),
}


def hidden_only(folder: Path) -> Path:
    """A hidden folder without a journal."""
    hidden = journaled(folder, [])
    (hidden / ".facepipe-journal").unlink()
    return hidden


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_hidden_folders_change_nothing(tmp_path: Path, old: Path, kind: str) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "file").write_text("theirs")
    HOSTILE[kind](old, outside)
    (old / f".facepipe-{KEY}" / "main").write_text("hostile")
    (old / f".facepipe-{KEY}" / "file").write_text("hostile")
    write_bytes(old / "other", b"new")
    assert content(tmp_path) == {f"work/{name}": text for name, text in OLD.items()} | {
        "work/other": "new",
        "outside/file": "theirs",
    }


@POSIX
def test_links_in_hidden_folders_lead_nowhere(tmp_path: Path, old: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "fresh").write_text("theirs")
    (outside / ".facepipe-lock").touch()
    hidden = journaled(old, [[0, "fresh", None, "main"], [0, "main", placing.identity(old / "main"), "beside"]])
    (hidden / "fresh").symlink_to(outside / "fresh")
    (hidden / ".facepipe-former").symlink_to(outside)
    (old / ".facepipe-fedcba9876543210").symlink_to(outside)
    write_bytes(old / "other", b"new")
    assert content(outside) == {"fresh": "theirs", ".facepipe-lock": ""}
    (old / ".facepipe-fedcba9876543210").unlink()
    assert content(old) == OLD | {"other": "new"}
    pipe = hidden_only(old)
    (pipe / ".facepipe-lock").unlink()
    os.mkfifo(pipe / ".facepipe-lock")
    os.mkfifo(pipe / ".facepipe-joined")
    write_bytes(old / "other", b"newer")
    assert not pipe.exists()


@POSIX
def test_sigterm_ends_as_ctrl_c_does(tmp_path: Path) -> None:
    """Sent while a file is written: nothing of it is left, one line, 128 + 15."""
    script = (
        "import os, signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # what a shell's background ignores
        "from facepipe.cli import main\n"
        "os.fsync = lambda file: os.kill(os.getpid(), getattr(signal, sys.argv[1]))\n"
        "sys.exit(main(['sample', 'head.usda', '--textures', '0']))\n"
    )
    for name, code, word in (("SIGTERM", 143, "terminated"), ("SIGINT", 130, "interrupted")):
        command = [sys.executable, "-c", script, name]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (code, f"facepipe: {word}\n")
        assert not list(tmp_path.iterdir())
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert not placing._live
