"""Runs a scenario again and again, killed at each of its steps in turn; a program of its own, since it forks.

A step is a file opened for writing, a rename, a removal, a folder made, or an fsync (before it and after it).
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from facepipe.core import atomic
from facepipe.core.atomic import collect, discard_stale, replacing_folder, together, write_bytes
from facepipe.core.errors import InputError

_STEPS = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.chmod", "shutil.rmtree"}
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


def several(folder: Path) -> None:
    """A main file with one that it needs, one that describes it, a report, and a file that nothing needs any more."""
    with together(folder / "face.glb"):
        write_bytes(folder / "textures" / "b.png", b"new")
        write_bytes(folder / "face.glb", b"new")
        with replacing_folder(folder / "report") as report:
            write_bytes(report / "two", b"new")
        write_bytes(folder / "face.json", b"new")
        discard_stale(folder / "stale.bin")


def failing(folder: Path) -> None:
    """The same, whose main file can't be replaced: all is taken back."""
    rename = Path.replace

    def replace(self: Path, target: Path) -> Path:
        if target.name == "face.glb":
            raise PermissionError
        return rename(self, target)

    Path.replace = replace  # type: ignore[method-assign, assignment]
    try:
        several(folder)
    except InputError:
        pass
    finally:
        Path.replace = rename  # type: ignore[method-assign]


def single(folder: Path) -> None:
    """One file in the place of another."""
    write_bytes(folder / "face.glb", b"new")


def whole_folder(folder: Path) -> None:
    """A folder in the place of another."""
    with replacing_folder(folder / "report") as report:
        write_bytes(report / "two", b"new")


def two_renames(folder: Path) -> None:
    """The same where the system can't exchange folders."""
    atomic.exchange = lambda one, other: False  # type: ignore[assignment]
    whole_folder(folder)


def settling(folder: Path) -> None:
    """What one that was killed had left to do."""
    for one in (folder, folder / "textures"):
        collect(one)


SCENARIOS: dict[str, Callable[[Path], None]] = {
    one.__name__: one for one in (several, failing, single, whole_folder, two_renames, settling)
}


def fill(folder: Path) -> None:
    """What is there before."""
    for name in ("textures/a.png", "face.glb", "face.json", "stale.bin", "report/one"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"old")


def snapshot(folder: Path, *, hidden: bool = False) -> dict[str, str]:
    """Name -> content of all files that one sees, or also of hidden ones; of empty folders too."""
    found = {}
    for one in sorted(folder.rglob("*")):
        name = one.relative_to(folder).as_posix()
        if hidden or not any(part.startswith(".") for part in name.split("/")):
            empty = one.is_dir() and not any(one.iterdir())
            if one.is_file() or empty:
                found[name] = "empty" if empty else one.read_text()
    return found


def killed_at(number: int, scenario: Callable[[Path], None], folder: Path) -> bool:
    """Run, and kill at a step; False where there are not so many."""
    child = os.fork()
    if child == 0:
        _arm(number)
        scenario(folder)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def half_way(place: Path) -> int:
    """The step of `several` at which old files are put aside and nothing new is in place."""
    number = 0
    while True:
        folder = place / f"half-{number}"
        fill(folder)
        killed_at(number, several, folder)
        if not (folder / "face.json").exists():
            return number
        number += 1


def _arm(number: int) -> None:
    count = 0

    def step() -> None:
        nonlocal count
        if count == number:
            os.kill(os.getpid(), signal.SIGKILL)
        count += 1

    def hook(event: str, arguments: Any) -> None:
        if event in _STEPS or (event == "open" and arguments[2] & _WRITING):
            step()

    real = os.fsync

    def fsync(descriptor: int) -> None:
        step()
        real(descriptor)
        step()

    os.fsync = fsync
    sys.addaudithook(hook)


def main(name: str, place: Path) -> None:
    """Print, for each step, what is seen after the kill, after the next who comes, and after the same run again."""
    found: list[dict[str, dict[str, str]]] = []
    begun = half_way(place) if name == "settling" else None
    while True:
        folder = place / str(len(found))
        fill(folder)
        if begun is not None:
            killed_at(begun, several, folder)
        if not killed_at(len(found), SCENARIOS[name], folder):
            break
        killed = snapshot(folder)
        settling(folder)
        settled = snapshot(folder, hidden=True)
        (several if name == "failing" else SCENARIOS[name])(folder)
        found.append({"killed": killed, "settled": settled, "again": snapshot(folder, hidden=True)})
        shutil.rmtree(folder)
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
