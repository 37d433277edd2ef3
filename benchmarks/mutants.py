"""Whether the tests notice faults: small ones are put into the code one at a time, and the tests that reach them run.

Which tests reach which line is recorded once (`pip install pytest-cov`); then each fault gets a run of these tests
alone, the fastest first, up to the first failure, in a copy of the checkout. A fault is noticed only if the test that
failed, or all of them where the run took too long, pass without it (else it is unclear, which counts as survived).

    python benchmarks/mutants.py --record reached            the default test run under coverage, half an hour
    python benchmarks/mutants.py --reached reached --mutants 300 --json out.json
    python benchmarks/mutants.py --reached reached --rooms facepipe/rig facepipe/stage --mutants 20

A fault that no test reaches counts as survived. Exit code 1 where fewer than 92 % are killed; survivors are listed, to
get a test or a reason (some change nothing that can be observed).
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import accumulate
from pathlib import Path
from queue import SimpleQueue
from xml.etree import ElementTree

from arguments import positive
from mutant_edits import Edit, edits
from tables import aligned

REPOSITORY = Path(__file__).resolve().parents[1]
ROOMS = (
    *("facepipe/rig", "facepipe/stage", "facepipe/geometry", "facepipe/verbs", "exporters"),
    *("facepipe/photo", "facepipe/scanning", "facepipe/neural"),
)
SECONDS = 120  # of a run that a fault may take: beyond, it hangs, and that is noticed
TESTS_SECONDS = 40.0  # of the tests that a fault meets, as recorded: a run without a fault stays far below `SECONDS`
AIM = 0.92
OUTCOMES = ("killed", "hung", "survived", "not reached", "unclear")

Reached = Mapping[int, Sequence[str]]  # line -> tests, the fastest first


@dataclass(frozen=True)
class Verdict:
    """What became of a fault."""

    path: str
    line: int
    kind: str
    before: str
    after: str
    tests: int  # that reach it
    outcome: str  # one of `OUTCOMES`
    seconds: float


def main() -> int:
    """Record, or put faults in and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--record", type=Path, metavar="FOLDER", help="run the tests and keep what they reach here")
    parser.add_argument("--reached", type=Path, metavar="FOLDER", help="what --record kept")
    parser.add_argument("--rooms", nargs="+", default=ROOMS, help=f"folders of the code (default {' '.join(ROOMS)})")
    parser.add_argument("--mutants", type=positive, default=300, help="faults, spread over all lines (default 300)")
    parser.add_argument("--seed", type=int, default=0, help="of which faults (default 0)")
    parser.add_argument("--processes", type=positive, default=2, help="copies that run at once (default 2)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every verdict")
    arguments = parser.parse_args()
    if (arguments.record is None) == (arguments.reached is None):
        parser.error("expected --record FOLDER or --reached FOLDER")
    if arguments.record:
        return record(arguments.record)
    sample = draw(arguments.rooms, arguments.mutants, arguments.seed)
    verdicts = judge(sample, Tests.read(arguments.reached), arguments.processes)
    print("\n".join(table(verdicts)))
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(verdict) for verdict in verdicts], indent=1), encoding="utf-8")
    return 0 if share_killed(verdicts) >= AIM else 1


def record(folder: Path) -> int:
    """Run the default tests; what they reach is in the folder then."""
    folder.mkdir(parents=True, exist_ok=True)
    rooms = [f"--cov={room}" for room in ROOMS]
    words = ["-q", "-n", "auto", *rooms, "--cov-context=test", "--cov-report=", f"--junitxml={folder / 'times.xml'}"]
    environment = {**os.environ, "COVERAGE_FILE": str((folder / "coverage").resolve())}
    return subprocess.run(
        [sys.executable, "-m", "pytest", *words], cwd=REPOSITORY, env=environment, check=False
    ).returncode


class Tests:
    """Which tests reach a line, and how long each takes."""

    def __init__(self, reached: Mapping[str, Mapping[int, set[str]]], seconds: Mapping[str, float]) -> None:
        self._reached, self._seconds = reached, seconds

    @classmethod
    def read(cls, folder: Path) -> Tests:
        """What `record` kept."""
        from coverage import CoverageData

        data = CoverageData(str(folder / "coverage"))
        data.read()
        reached: dict[str, dict[int, set[str]]] = {}
        for file in data.measured_files():
            lines = data.contexts_by_lineno(file)
            named = {
                line: {context.rpartition("|")[0] for context in contexts} - {""} for line, contexts in lines.items()
            }
            reached[Path(file).relative_to(REPOSITORY).as_posix()] = named
        cases = ElementTree.parse(folder / "times.xml").iter("testcase")
        seconds: defaultdict[str, float] = defaultdict(float)
        for case in cases:
            seconds[f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name')}"] += float(
                case.get("time", 0)
            )
        return cls(reached, seconds)

    def of_line(self, path: str, line: int) -> list[str]:
        """Those that reach a line, the fastest first, as many as take `TESTS_SECONDS`."""
        reaching = self._reached.get(path, {}).get(line, ())
        tests = sorted(reaching, key=lambda test: (self._seconds.get(test, 1.0), test))
        ends = accumulate(self._seconds.get(test, 1.0) for test in tests)
        return tests[: max(1, sum(end <= TESTS_SECONDS for end in ends))] if tests else []


def draw(rooms: Sequence[str], count: int, seed: int) -> list[tuple[str, Edit]]:
    """Faults drawn at random among all that can be made in the rooms' functions, one a line at most."""
    paths = sorted(
        path for room in rooms for path in (REPOSITORY / room).rglob("*.py") if "node_modules" not in path.parts
    )
    lines: dict[tuple[str, int], list[Edit]] = defaultdict(list)
    for path in paths:
        for edit in edits(path.read_bytes()):
            lines[path.relative_to(REPOSITORY).as_posix(), edit.line].append(edit)
    choice = random.Random(seed)
    return [(key[0], choice.choice(lines[key])) for key in choice.sample(sorted(lines), min(count, len(lines)))]


def judge(sample: Sequence[tuple[str, Edit]], tests: Tests, processes: int) -> list[Verdict]:
    """The verdict on each fault, in copies of the checkout."""
    copies: SimpleQueue[Path] = SimpleQueue()
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(processes) as pool:
        for number in range(processes):
            copies.put(copy_of_checkout(Path(temporary) / str(number)))

        def verdict(fault: tuple[str, Edit]) -> Verdict:
            copy = copies.get()
            try:
                return judged(copy, *fault, tests.of_line(fault[0], fault[1].line))
            finally:
                copies.put(copy)

        verdicts = []
        for number, done in enumerate(pool.map(verdict, sample), 1):
            verdicts.append(done)
            print(f"{number} of {len(sample)}: {done.path}:{done.line} {done.outcome}", file=sys.stderr)
    return verdicts


def copy_of_checkout(folder: Path) -> Path:
    """The tracked files, with the data and what was built beside them where a checkout has it."""
    checkout = folder / "checkout"
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    for name in listed.stdout.split("\0"):
        if name and (REPOSITORY / name).is_file():
            (checkout / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(REPOSITORY / name, checkout / name)
    built = REPOSITORY / "exporters/facepipe_web/dist"
    for source, link in (
        (REPOSITORY.parent / "shared", folder / "shared"),
        (built, checkout / built.relative_to(REPOSITORY)),
    ):
        if source.exists():
            link.symlink_to(source)
    return checkout


def judged(checkout: Path, path: str, edit: Edit, tests: Sequence[str]) -> Verdict:
    """Run the tests over the fault."""
    start = time.perf_counter()
    outcome = "not reached"
    if tests:
        source = (checkout / path).read_bytes()
        (checkout / path).write_bytes(edit.apply(source))
        try:
            code, failed = run(checkout, tests)
        finally:
            (checkout / path).write_bytes(source)
        outcome = "hung" if code is None else "killed" if code else "survived"
        if code != 0 and not passes(checkout, failed or tests):
            outcome = "unclear"
    seconds = round(time.perf_counter() - start, 1)
    return Verdict(path, edit.line, edit.kind, edit.before, edit.after, len(tests), outcome, seconds)


def run(checkout: Path, tests: Sequence[str]) -> tuple[int | None, tuple[str, ...]]:
    """pytest's exit code, None where it takes too long, and the test that failed."""
    paths = os.pathsep.join(str(checkout / room) for room in ("", "exporters", "schemas"))
    environment = {**os.environ, "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=no", "-rfE", "-p", "no:cov", *tests]
    try:
        done = subprocess.run(
            command, cwd=checkout, env=environment, timeout=SECONDS, check=False, capture_output=True, text=True
        )
    except subprocess.TimeoutExpired:
        return None, ()
    listed = re.findall(r"^(?:FAILED|ERROR) (.*?\.py::.*?)(?: - .*)?$", done.stdout, re.MULTILINE)
    return done.returncode, tuple(listed[:1])


_passing: dict[tuple[str, ...], bool] = {}


def passes(checkout: Path, tests: Sequence[str]) -> bool:
    """Whether tests pass in the checkout as it is."""
    key = tuple(tests)
    if key not in _passing:
        _passing[key] = run(checkout, tests)[0] == 0
    return _passing[key]


def share_killed(verdicts: Sequence[Verdict]) -> float:
    """Of all faults."""
    return sum(verdict.outcome in ("killed", "hung") for verdict in verdicts) / len(verdicts)


def table(verdicts: Sequence[Verdict]) -> list[str]:
    """Counts by room, and every survivor."""
    rooms: dict[str, Counter[str]] = defaultdict(Counter)
    for verdict in verdicts:
        rooms["/".join(verdict.path.split("/")[:2])][verdict.outcome] += 1
    rows: list[tuple[str, ...]] = [("room", "mutants", *OUTCOMES)]
    rows += [
        (room, str(count.total()), *(str(count[key]) for key in OUTCOMES)) for room, count in sorted(rooms.items())
    ]
    lines = [*aligned(rows), f"killed: {share_killed(verdicts):.1%} (aim {AIM:.0%})"]
    for verdict in verdicts:
        if verdict.outcome in OUTCOMES[2:]:
            where = f"{verdict.path}:{verdict.line}: {verdict.outcome}"
            lines.append(f"{where}: {' '.join(verdict.before.split())} -> {verdict.after}")
    return lines


if __name__ == "__main__":
    sys.exit(main())
