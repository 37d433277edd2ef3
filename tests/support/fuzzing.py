"""Runs commands over damaged files, and says what broke the rule: one line on stderr and exit 2, or success.

Cases run one after another in a process of its own, with a limit of memory: what kills the interpreter inside a library
must not take the tests along. What failed is tried again alone, in a fresh process.
"""

from __future__ import annotations

import contextlib
import io
import os
import queue
import random
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from facepipe.cli import main
from facepipe.cli.show import quiet_libraries
from facepipe.core.errors import FacepipeError

MEMORY = 3 << 30  # bytes of address space
SECONDS = 30  # of processor time: no command may take longer over files of some kilobytes
SILENCE = 300  # seconds without a word of the process: it hangs
RESTART = 5000  # cases in one process

Line = Sequence[str] | Callable[[], object]  # a command of facepipe, or a reader


@dataclass(frozen=True)
class Format:
    """Good files of a kind, and damage to them."""

    put: dict[str, Callable[[], object]]  # a name, and what writes a set of good files into the working folder
    damage: Callable[[random.Random, str], Sequence[Line]]  # in a copy of the set of this name; what to run over it
    writes: tuple[str, ...] = ("out",)  # beginnings of the names that commands may write
    keeps: tuple[str, ...] = ("nothing",)  # ... and of those that stay where the command is refused
    hidden: bool = False  # what killed processes left is hidden, and may stay
    stages: bool = False  # USD reads them: what kills USD alone is not ours


# ---- in the process of the cases


def run_cases(name: str, form: Format, seed: int, first: int, count: int, folder: Path) -> None:
    """Runs cases; prints what is begun, what broke the rule, and of each case how many lines were refused, accepted."""
    limit_memory()
    os.fsync = lambda file: None  # no machine stops here, and a disk that others use too takes most of the time
    root = folder / "deep"
    case = root / "below" / "case"  # ../.. of it is ours too
    for number in range(first, first + count):
        rng = random.Random(f"{name} {seed} {number}")
        shutil.rmtree(root, ignore_errors=True)
        part = rng.choice(sorted(form.put))
        shutil.copytree(folder / "good" / part, case)
        os.chdir(case)
        codes: Counter[bool] = Counter()
        for line in form.damage(rng, part):
            print(f"at {number} {part}: {_shown(line)}", flush=True)
            code, fault = _judged(line, root, form)
            codes[code == 2] += 1
            if fault:
                print(f"FAILED {number} {part}: {_shown(line)}: {fault}", flush=True)
        os.chdir(folder)
        print(f"done {number} {codes[True]} {codes[False]}", flush=True)


def put_good(form: Format, folder: Path) -> None:
    """The good files, a folder each set, where they are not there yet."""
    for name, put in form.put.items():
        making, target = folder / "making", folder / "good" / name
        if not target.exists():
            shutil.rmtree(making, ignore_errors=True)
            making.mkdir(parents=True)
            target.parent.mkdir(exist_ok=True)
            with contextlib.chdir(making), contextlib.redirect_stdout(io.StringIO()):
                put()
            making.rename(target)


def _judged(line: Line, root: Path, form: Format) -> tuple[int, str]:
    """Exit code, and what the line does against the rule; nothing where it keeps to it."""
    before, start = _content(root), time.process_time()
    code, err, trace = _run(line)
    took, after = time.process_time() - start, _content(root)
    changed = sorted(path for path in before.keys() | after.keys() if before.get(path) != after.get(path))
    if trace:
        return code, f"traceback: {trace}"
    warned = [one for one in err if one.startswith("facepipe: warning: ")]  # before it was refused
    if code == 2 and len(err) != len(warned) + 1:
        return code, f"not one line: {err[:4]}"
    if any(not one.startswith("facepipe") or not one.isprintable() for one in err) or code not in (0, 1, 2):
        return code, f"exit {code}, stray lines: {err[:4]}"
    allowed = tuple(f"below/case/{one}" for one in (form.keeps if code == 2 else form.writes))
    hidden = {path for path in after if re.search(r"/\.(?!\.)", path)}
    partial = [path for path in changed if not path.startswith(allowed) or (path in hidden and not form.hidden)]
    if partial:
        return code, f"partial files after exit {code}: {partial[:4]}, {err}"
    return code, f"took {took:.0f} s" if took > SECONDS else ""


def _run(line: Line) -> tuple[int, list[str], str]:
    """Exit code, lines on stderr, traceback."""
    code, trace = 0, ""
    with _stderr() as errors, contextlib.redirect_stdout(io.TextIOWrapper(io.BytesIO(), encoding="utf-8")):
        try:
            if callable(line):
                with quiet_libraries():  # as commands read
                    line()
            else:
                code = main(list(line))
        except FacepipeError as error:
            print(f"facepipe: {error}", file=sys.stderr)
            code = 2
        except SystemExit as stop:
            code = int(stop.code or 0)
        except BaseException as error:
            trace = " | ".join(" ".join(one.split()) for one in traceback.format_exception(error)[-4:])
        sys.stderr.flush()
    return code, errors, trace


@contextlib.contextmanager
def _stderr() -> Iterator[list[str]]:
    """The lines that are written to file descriptor 2, known after the block."""
    found: list[str] = []
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield found
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        file.seek(0)
        found += file.read().decode("utf-8", "backslashreplace").splitlines()


def _content(root: Path) -> dict[str, bytes]:
    """Path below the folder -> content, of all files and folders."""
    found = {}
    for top, folders, files in os.walk(root):
        for name in [*files, *folders]:
            path = Path(top, name)
            found[path.relative_to(root).as_posix()] = path.read_bytes() if path.is_file() else b""
    return found


def _shown(line: Line) -> str:
    return ascii(line.__name__ if callable(line) else " ".join(line))[1:-1]


def limit_memory() -> None:
    """A count of billions in a damaged file ends as an error of memory, not of time."""
    with contextlib.suppress(ImportError, ValueError, OSError):  # Windows; systems without such limits
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


# ---- in the tests


@dataclass
class Outcome:
    """What became of the cases of a format."""

    counts: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    def judge(self, line: str) -> None:
        """:param line: of a case that broke the rule, run alone"""
        kinds = {
            "traceback": "traceback",
            " hangs": "hang",
            " died ": "death",
            "partial files": "partial",
            "took": "hang",
        }
        self.counts[next((kind for word, kind in kinds.items() if word in line), "line")] += 1
        self.failures.append(line)


def fuzz(name: str, seed: int, count: int, folder: Path, *, stages: bool = False) -> Outcome:
    """Runs cases 0 to `count` of a format.

    A damaged .usdc can overwrite USD's own memory (seen in usd-core 26.11: SIGSEGV in CrateFile::_UnpackValue, one in
    about a thousand), and the process may fail some files later. So what failed is read alone, in a fresh process,
    and passed over where one without our code dies of the same file.
    """
    found, first = Outcome(), 0
    while first < count:
        code, lines = _process(folder, "cases", name, seed, first, min(RESTART, count - first), folder)
        suspects = {int(line.split()[1]): line for line in lines if line.startswith("FAILED")}
        done = [line.split()[1:] for line in lines if line.startswith("done")]
        for _, refused, accepted in done:
            found.counts.update(cases=1, refused=int(refused), accepted=int(accepted))
        first = int(done[-1][0]) + 1 if done else first
        if code != 0 and first < count:
            found.counts.update(cases=1)
            suspects[first] = f"case {first}: the process {_end(code)}: {''.join(lines[-1:])}"
            first += 1
        for number, line in suspects.items():
            _again(found, name, seed, number, folder, line, stages=stages)
    return found


def _again(found: Outcome, name: str, seed: int, number: int, folder: Path, line: str, *, stages: bool) -> None:
    """One case alone."""
    code, lines = _process(folder, "cases", name, seed, number, 1, folder)
    failures = [one for one in lines if one.startswith("FAILED")]
    if code != 0:
        if stages and _usd_dies(folder):
            found.counts["killed in USD"] += 1
        else:
            found.judge(f"case {number}: the process {_end(code)}: {''.join(lines[-1:])}")
    elif failures:
        for one in failures:
            found.judge(f"{name} {seed} {one}")
    elif not stages:
        found.judge(f"{line}, but not alone")


def _end(code: int | None) -> str:
    return "hangs" if code is None else f"died with {code}"


def _usd_dies(folder: Path) -> bool:
    """Whether USD's own reader dies of a file of the last case, without any of our code.

    What overwrites USD's memory ends now in a signal, now in an exit code of the loader (127), now in nothing at all.
    """
    case = folder / "deep" / "below" / "case"
    files = [path for path in case.rglob("*") if path.suffix in (".usda", ".usdc", ".usd", ".usdz")]
    return any(_process(folder, "usd", path)[0] != 0 for path in files for _ in range(8))


def _process(folder: Path, *words: object) -> tuple[int | None, list[str]]:
    """Exit code (None: it hangs) and lines of stdout of fuzz.py."""
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-B", str(Path(__file__).with_name("fuzz.py")), *map(str, words)]
    settings = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with (
        (folder / "stderr.txt").open("wb") as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, env=settings, text=True) as process,
    ):
        lines: list[str] = []
        heard: queue.Queue[str | None] = queue.Queue()
        assert process.stdout is not None
        threading.Thread(target=_listen, args=(process.stdout, heard), daemon=True).start()
        while True:
            try:
                line = heard.get(timeout=SILENCE)
            except queue.Empty:
                process.kill()
                return None, lines
            if line is None:
                break
            lines.append(line.rstrip("\n"))
    if process.returncode and not lines and "cases" in words:
        raise AssertionError(f"{command} failed: {(folder / 'stderr.txt').read_text(errors='replace')[-2000:]}")
    return process.returncode, lines


def _listen(stream: io.TextIOBase | object, heard: queue.Queue[str | None]) -> None:
    for line in stream:  # type: ignore[attr-defined]
        heard.put(line)
    heard.put(None)
