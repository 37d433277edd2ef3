"""Kills every command that writes, at every step of its writing, and looks at what is left.

A program of its own, for Linux: each command runs in a fork of this process that has all modules already, in a folder
of its own, and is killed by SIGKILL at its Nth step (a file opened for writing, made, renamed or removed, a call of
fsync begun or ended), or at a random moment. Then each output must be as it was or as the command makes it, files that
belong together all old, all new, or some of one of them; and the same command, run again, must succeed and leave
nothing but what it leaves when nobody kills it.

    python tests/support/kills.py                     every step of every command
    python tests/support/kills.py --random 200        and 200 random moments of each
    python tests/support/kills.py --signals           SIGTERM at every step against SIGINT
    python tests/support/kills.py --brief             some of each, for continuous integration
    python tests/support/kills.py blend "export onnx" these commands alone
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib
import json
import os
import random
import re
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from kill_lines import LINES, Line, make_material, quicken

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "PXR_WORK_THREAD_LIMIT"), "1")
_PATHS = {  # audit event -> how many of its arguments are paths
    "open": 1, "os.rename": 2, "os.remove": 1, "os.mkdir": 1, "os.rmdir": 1, "os.truncate": 1, "os.link": 2,
    "os.symlink": 2, "os.chmod": 1,
}  # fmt: skip
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_KEY = re.compile(r"[0-9a-f]{8,}|(?<=[._-])[a-z0-9_]{8}(?=[._/]|$)")  # random parts of names
_PAUSE = 0.1  # seconds without a step after which a run branches
_FEW = 3
_COLUMNS = ("steps", "kills", "random", "again", "left", "faults", "s")
_MINE = ("seconds", "reused")  # fields of reports that another run has otherwise
State = dict[str, str]  # path -> digest; a folder's is "folder"


# What a folder holds


def state(folder: Path) -> State:
    """Everything below a folder, hidden files too."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        found[name] = f"link {path.readlink()}" if path.is_symlink() else _digest(path)
    return found


def _digest(path: Path) -> str:
    if path.is_dir():
        return "folder"
    data = path.read_bytes()
    if path.suffix == ".json":
        with contextlib.suppress(ValueError):
            data = json.dumps(_timeless(json.loads(data)), sort_keys=True).encode()
    return hashlib.sha256(data).hexdigest()


def _timeless(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _timeless(one) for key, one in content.items() if key not in _MINE}
    return [_timeless(one) for one in content] if isinstance(content, list) else content


def is_hidden(name: str) -> bool:
    return any(part.startswith(".") for part in name.split("/"))


def _named(content: State) -> list[tuple[str, str]]:
    """Names without what is random in those of hidden files, and the names."""
    return [(_KEY.sub("*", one) if is_hidden(one) else one, one) for one in content]


def _plain(content: State) -> list[tuple[str, str]]:
    """What a folder holds but for contents and random names of hidden files."""
    return sorted({(one, "" if is_hidden(one) else content[key]) for one, key in _named(content)})


# A run of a command


class Steps:
    """The steps of writing of this process.

    :param at: called at each with its number, from 1
    """

    def __init__(self, folder: Path, at: Callable[[int], object] = lambda number: None) -> None:
        self.folder, self.at = folder, at
        self.seen: list[tuple[str, float, bool]] = []  # name, moment, whether no file in the folder is open
        self._busy = False

    def install(self) -> None:
        """From now on; for good."""
        from pxr import Sdf, UsdUtils

        from facepipe.core import atomic

        sys.addaudithook(self._audit)
        # what raises no event: what goes to the disk, what the system does for us, what USD writes
        unseen = ((os, "fsync"), (atomic, "exchange"), (Sdf.Layer, "Export"), (UsdUtils, "CreateNewUsdzPackage"))
        for owner, name in unseen:
            setattr(owner, name, self._watched(name, getattr(owner, name)))

    def _watched(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def watched(*arguments: Any, **settings: Any) -> Any:
            self._step(f"before {name}")
            found = call(*arguments, **settings)
            self._step(f"after {name}")
            return found

        return watched

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event in _PATHS and not self._busy:
            if event == "open" and not _is_write(arguments[1], arguments[2]):
                return
            if any(self._is_inside(argument) for argument in arguments[: _PATHS[event]]):
                self._step(f"{event} {Path(os.fsdecode(arguments[0])).name}")

    def _is_inside(self, path: Any) -> bool:
        if not isinstance(path, str | bytes | os.PathLike):
            return False
        return self.folder in (Path.cwd() / os.fsdecode(path)).parents

    def _step(self, name: str) -> None:
        if self._busy:
            return
        self.seen.append((name, time.monotonic(), not self._holds()))
        self.call(len(self.seen))

    def _holds(self) -> bool:
        """Whether a file in the folder is open here; so where that can't be known."""
        try:
            return any(self.folder in one.readlink().parents for one in Path("/proc/self/fd").iterdir())
        except OSError:
            return True

    def call(self, number: int) -> None:
        """`at`, whose own steps don't count."""
        self._busy = True
        try:
            self.at(number)
        finally:
            self._busy = False


def _is_write(mode: str | None, flags: int) -> bool:
    return bool(flags & _WRITES) if flags else mode is not None and not set(mode).isdisjoint("wax+")


@dataclass(frozen=True)
class Ended:
    """How a run ended."""

    code: int  # below 0: by that signal
    text: str  # stdout and stderr
    seconds: float = 0.0
    steps: Sequence[tuple[str, float, bool]] = ()  # and when, from the start; whether no file was open
    modules: Sequence[str] = ()


@dataclass(frozen=True)
class Blow:
    """A signal to a run: at a step, or so long after the step that its branch begins at."""

    number: int = signal.SIGKILL
    step: int = 0
    delay: float = -1.0

    def at(self, step: int) -> None:
        """Strike this process where it is at the step."""
        if step == self.step:
            os.kill(os.getpid(), self.number)


@dataclass(frozen=True)
class Struck:
    """What a blow left."""

    blow: Blow
    code: int
    now: State
    kept: str  # where the folder's content is put away, of the first of its kind


class Workshop:
    """A folder that runs are made in, one after another.

    :param folder: holds nothing
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.material, self.place = folder, folder / "material", folder / "place"
        self._noted, self._text, self._passing = folder / "noted.json", folder / "text", folder / "passing"
        self.material.mkdir()
        self._passing.mkdir()
        ended = self._forked(lambda: make_material(self.material))
        assert ended.code == 0, ended.text
        quicken()
        self._digests = state(self.material)

    def check(self) -> None:
        """No run has touched what it took."""
        assert state(self.material) == self._digests

    def lay(self, line: Line) -> None:
        """What the command takes, and nothing else."""
        self._empty()
        for pattern in line.uses:
            for one in self.material.glob(pattern):
                (shutil.copytree if one.is_dir() else shutil.copy)(one, self.place / one.name)

    def restore(self, kept: Path) -> None:
        """The folder as it was once."""
        self._empty()
        shutil.copytree(kept, self.place, symlinks=True, dirs_exist_ok=True)

    def keep(self, name: str) -> Path:
        """A copy of the folder."""
        kept = self.folder / name
        shutil.rmtree(kept, ignore_errors=True)
        shutil.copytree(self.place, kept, symlinks=True)
        return kept

    def put_away(self, name: str) -> None:
        """All that the folder holds, itself: journals know files again by inode and time."""
        (self.folder / name).mkdir()
        for one in self.place.iterdir():
            one.rename(self.folder / name / one.name)

    def take_back(self, name: str) -> None:
        """What was put away."""
        self._empty()
        for one in (self.folder / name).iterdir():
            one.rename(self.place / one.name)

    def _empty(self) -> None:
        """The folder stays the same one: the runs that are held stand in it."""
        self._passing.mkdir(exist_ok=True)
        self.place.mkdir(exist_ok=True)
        for one in self.place.iterdir():
            shutil.rmtree(one) if one.is_dir() and not one.is_symlink() else one.unlink()

    def run(self, line: Line, blow: Blow | None = None) -> Ended:
        """Run the command; strike it."""
        return self._forked(lambda: self._work(line, blow=blow))

    def strike(self, line: Line, blows: dict[int, list[Blow]]) -> list[Struck]:
        """Run the command, and from steps of it branches that are struck.

        :param blows: step that they branch off at -> them
        """
        found = self.folder / "struck.jsonl"
        found.write_text("")
        ended = self._forked(lambda: self._work(line, blows))
        assert ended.code in (0, line.code), ended.text
        return [Struck(Blow(*blow), *rest) for blow, *rest in map(json.loads, found.read_text().splitlines())]

    def _work(self, line: Line, blows: dict[int, list[Blow]] | None = None, blow: Blow | None = None) -> int:
        os.chdir(self.place)
        line.stub()
        steps = Steps(self.place)
        blows = dict(blows or {})
        steps.at = blow.at if blow else lambda number: self._branches(steps, number, blows)
        steps.install()
        start = time.monotonic()
        steps.call(0)
        code = line.run()
        steps.call = lambda number: None
        if self._noted.parent == self.folder:
            seen = [(name, moment - start, free) for name, moment, free in steps.seen]
            noted = {"steps": seen, "modules": sorted(sys.modules), "seconds": time.monotonic() - start}
            self._noted.write_text(json.dumps(noted))
        return code

    def _branches(self, steps: Steps, number: int, blows: dict[int, list[Blow]]) -> None:
        """Fork this run for each blow of a step, from the folder as it is; after the last of all it ends."""
        own = blows.pop(number, [])
        if not own:
            return
        kept = self.keep("held")
        for blow in own:
            child = os.fork()
            if child == 0:
                self._noted = Path(os.devnull)
                steps.at = blow.at
                blow.at(number)
                return
            if blow.delay >= 0:
                select.select([os.pidfd_open(child)], [], [], blow.delay)  # so long, unless it ends before
                os.kill(child, blow.number)
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            now = state(self.place)
            name = f"after {hashlib.sha256(repr(_plain(now)).encode()).hexdigest()[:16]}"
            if not (self.folder / name).exists():
                self.put_away(name)
            with (self.folder / "struck.jsonl").open("a") as file:
                file.write(json.dumps([[blow.number, blow.step, blow.delay], code, now, name]) + "\n")
            self.restore(kept)
        if not blows:
            os._exit(0)

    def _forked(self, work: Callable[[], int | None]) -> Ended:
        self._noted.unlink(missing_ok=True)
        child = os.fork()
        if child == 0:
            self._child(work)
        _, status = os.waitpid(child, 0)
        noted = json.loads(self._noted.read_text()) if self._noted.exists() else {}
        return Ended(os.waitstatus_to_exitcode(status), self._text.read_text(errors="replace"), **noted)

    def _child(self, work: Callable[[], int | None]) -> None:
        """Run `work` and end the process, with its exit code."""
        code = 70
        try:
            tempfile.tempdir = str(self._passing)  # what a killed process leaves there is the system's
            text = os.open(self._text, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(text, 1)
            os.dup2(text, 2)
            code = work() or 0
        except BaseException:
            traceback.print_exc()
        finally:
            with contextlib.suppress(Exception):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code)


# What a kill leaves


@dataclass(frozen=True)
class Case:
    """A command over older outputs or over none: the folder before it, and after it where nobody kills it."""

    title: str
    line: Line
    laid: Path  # a copy of the folder before
    before: State
    after: State
    clean: Ended

    def faults(self, now: State) -> list[str]:
        """What is wrong with a folder that a killed run left."""
        found, sides = [], set()
        changed = [one for one in {**self.before, **self.after} if self.before.get(one) != self.after.get(one)]
        together = [one for one in changed if not self._is_single(one) and self.before.get(one) != "folder"]
        together = [one for one in together if self.after.get(one) != "folder"]
        for name in {**self.before, **self.after, **now}:
            old, new, held = self.before.get(name), self.after.get(name), now.get(name)
            if held in (old, new):
                sides |= {_side(held, old, new)} if name in together else set()
            elif held is not None and (old or new or not (is_hidden(name) or self._is_single(name))):
                found.append(f"{name} is neither old nor new")
            elif held is None and any(one.startswith(f"{name}/") for one in together):
                pass  # a folder that is replaced whole with what is in it
            elif held is None and (old == new or name not in together or len(together) == 1):
                found.append(f"{name} is gone")
        if {"old", "new"} <= sides:
            held = [f"{one} {_side(now.get(one), *self.both(one))}" for one in together]
            found.append(f"mixed: {', '.join(held)}")
        return found

    def kind(self, now: State) -> tuple[str, ...]:
        """What there is, but for random names and contents of hidden files."""
        seen = {one if is_hidden(one) else f"{one} {_side(now[key], *self.both(key))}" for one, key in _named(now)}
        return tuple(sorted(seen))

    def both(self, name: str) -> tuple[str | None, str | None]:
        """Its digests before and after."""
        return self.before.get(name), self.after.get(name)

    def _is_single(self, name: str) -> bool:
        return any(Path(name).match(pattern) for pattern in self.line.each)


def _side(held: str | None, old: str | None, new: str | None) -> str:
    if held is None:
        return "missing"
    return "same" if old == new == held else "old" if held == old else "new" if held == new else "other"


@dataclass
class Tally:
    """What came of the kills of one command."""

    steps: int = 0
    kills: int = 0
    random: int = 0
    ended: int = 0  # before the kill
    again: int = 0  # runs after a kill
    left: int = 0  # kills that left a hidden file until then
    seconds: float = 0.0
    faults: list[str] = field(default_factory=list)

    def __iadd__(self, other: Tally) -> Tally:
        for name in ("steps", "kills", "random", "ended", "again", "left", "seconds", "faults"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        return self


class Killing:
    """The kills of one command."""

    def __init__(self, shop: Workshop, name: str, generator: random.Random, *, twice: bool) -> None:
        self.shop, self.line, self.generator, self.twice = shop, LINES[name], generator, twice
        self.tally = Tally()
        self._known: set[tuple[str, ...]] = set()  # kinds of folders from which the command was run again

    def cases(self, *, brief: bool) -> Iterator[Case]:
        """Over none and, where the command writes over something, over older outputs; `brief`: one of them."""
        for old in ((True,) if brief else (False, True)) if self.line.outputs else (False,):
            self.shop.lay(self.line)
            if old:
                self._put_old()
            before, laid = state(self.shop.place), self.shop.keep("laid")
            clean = self.shop.run(self.line)
            for module in clean.modules:
                with contextlib.suppress(Exception):
                    importlib.import_module(module)
            if not brief:  # once more, for how long it takes
                self.shop.restore(laid)
                clean = self.shop.run(self.line)
            assert clean.code == 0, clean.text
            self._known.clear()
            title = "over older" if old else "in place" if not self.line.outputs else "over none"
            yield Case(title, self.line, laid, before, state(self.shop.place), clean)

    def kills(self, case: Case, share: int, moments: int) -> None:
        """Kill at all steps, or some at random, and at random moments."""
        blows = {start: [Blow(step=step) for step in steps] for start, steps in self._branches(case, share)}
        for start, more in self._moments(case, moments).items():
            blows.setdefault(start, []).extend(more)
        struck = self._strike(case, blows)
        self.tally.kills += sum(one.blow.delay < 0 for one in struck)
        self.tally.random += sum(one.blow.delay >= 0 for one in struck)
        self._judge(case, struck)

    def _moments(self, case: Case, count: int) -> dict[int, list[Blow]]:
        """Random moments of the time of writing, one in twenty of the whole run."""
        moments = [0.0, *(step[1] for step in case.clean.steps)]
        spans = [(steps[0], moments[steps[-1]] - moments[steps[0]]) for _, steps in self._branches(case)]
        weights = [span + 0.02 for _, span in spans]
        blows: dict[int, list[Blow]] = {}
        for number in range(count):
            whole = number % 20 == 0
            start, span = (0, case.clean.seconds) if whole else self.generator.choices(spans, weights)[0]
            delay = self.generator.uniform(0.0, 1.3 * span + 0.02)  # a branch is slower
            blows.setdefault(start, []).append(Blow(delay=delay))
        return blows

    def signals(self, case: Case, share: int = 0) -> None:
        """SIGTERM at a step leaves what SIGINT leaves."""
        both = (signal.SIGINT, signal.SIGTERM)
        blows = {
            start: [Blow(number, step) for step in steps for number in both]
            for start, steps in self._branches(case, share)
        }
        struck = self._strike(case, blows)
        self.tally.kills += len(struck)
        self._judge(case, struck)
        for first, second in zip(struck[::2], struck[1::2], strict=True):
            one, other = case.kind(first.now), case.kind(second.now)
            if one != other:
                text = f"SIGTERM leaves {_less(other, one)}, SIGINT {_less(one, other)}"
                self._fault(f"{self._where(case, first)}: {text}")

    def _branches(self, case: Case, share: int = 0) -> list[tuple[int, list[int]]]:
        """Steps from 1, in runs between which the command computes: where the branch begins, and its steps."""
        found: list[tuple[int, list[int]]] = []
        last = 0.0
        for step, (_, moment, free) in enumerate(case.clean.steps, 1):
            if not found or (free and not self.line.early and moment - last >= _PAUSE):
                found.append((0 if self.line.early else step, []))
            found[-1][1].append(step)
            last = moment
        if share and share < len(case.clean.steps):
            chosen = set(self.generator.sample(range(1, len(case.clean.steps) + 1), share))
            found = [(start, [one for one in steps if one in chosen]) for start, steps in found]
        return [one for one in found if one[1]]

    def _strike(self, case: Case, blows: dict[int, list[Blow]]) -> list[Struck]:
        self.shop.restore(case.laid)
        return self.shop.strike(self.line, blows)

    def _put_old(self) -> None:
        """Older outputs in the place of those that the command will write."""
        for words in self.line.old:
            ended = self.shop.run(Line(words=words, uses=()))
            assert ended.code == 0, ended.text
        if not self.line.old:
            for one in self.line.outputs:
                (self.shop.place / one).parent.mkdir(parents=True, exist_ok=True)
                (self.shop.place / one).write_text(f"older {one}")

    def _judge(self, case: Case, struck: list[Struck]) -> None:
        for one in struck:
            self.tally.ended += one.code >= 0
            self.tally.left += any(is_hidden(name) for name in one.now)
            for fault in case.faults(one.now):
                self._fault(f"{self._where(case, one)}: {fault}")
            if case.kind(one.now) not in self._known:
                self._known.add(case.kind(one.now))
                self.shop.take_back(one.kept)
                self._again(case, self._where(case, one))

    def _where(self, case: Case, one: Struck) -> str:
        if one.blow.delay >= 0:
            return f"{case.title}, after {one.blow.delay:.4f} s"
        if one.blow.step > len(case.clean.steps):
            return f"{case.title}, at step {one.blow.step}"
        return f"{case.title}, at step {one.blow.step} ({_KEY.sub('*', case.clean.steps[one.blow.step - 1][0])})"

    def _again(self, case: Case, where: str) -> None:
        """Run the command again, killed once more and then to its end: all must be as if nobody had killed it."""
        if self.twice:
            blow = Blow(step=self.generator.randint(1, len(case.clean.steps)))
            self.tally.kills += self.shop.run(self.line, blow).code < 0
            where = f"{where}, and again at step {blow.step}"
            for fault in case.faults(state(self.shop.place)):
                self._fault(f"{where}: {fault}")
        done = {one: held for one, held in state(self.shop.place).items() if not is_hidden(one)} == case.after
        ended = self.shop.run(self.line)
        self.tally.again += 1
        if ended.code != 0 and not (done and ended.code == self.line.code):
            self._fault(f"{where}: run again, it ends with {ended.code}: {ended.text.strip()[-300:]}")
        now = state(self.shop.place)
        for name in {**case.after, **now}:
            if now.get(name) != case.after.get(name):
                side = _side(now.get(name), *case.both(name))
                self._fault(
                    f"{where}: run again, {_KEY.sub('*', name)} is {'left behind' if side == 'other' else side}"
                )

    def _fault(self, text: str) -> None:
        self.tally.faults.append(text)


def _less(first: Sequence[str], second: Sequence[str]) -> str:
    return ", ".join(sorted(set(first) - set(second))) or "nothing more"


def kill(shop: Workshop, name: str, given: argparse.Namespace) -> Tally:
    """Kill one command."""
    start = time.monotonic()
    killing = Killing(shop, name, random.Random(f"{given.seed} {name}"), twice=not (given.brief or given.signals))
    cases = 2 if killing.line.outputs and not given.brief else 1
    share, moments = (_FEW, _FEW) if given.brief else (0, given.random // cases)
    for case in killing.cases(brief=given.brief):
        killing.tally.steps += len(case.clean.steps)
        if given.signals:
            killing.signals(case, share)
        else:
            killing.kills(case, share, moments)
        for one in shop.folder.glob("after *"):
            shutil.rmtree(one)
    killing.tally.seconds = time.monotonic() - start
    return killing.tally


def main() -> int:
    """The exit code: 1 where something was wrong."""
    parser = argparse.ArgumentParser(description="Kill the commands that write.")
    parser.add_argument("names", nargs="*", metavar="COMMAND", help=f"of: {', '.join(LINES)}")
    parser.add_argument("--random", type=int, default=0, metavar="COUNT", help="random moments of each, too")
    parser.add_argument("--brief", action="store_true", help=f"{_FEW} steps and {_FEW} moments of each")
    parser.add_argument("--signals", action="store_true", help="SIGTERM against SIGINT, in the place of SIGKILL")
    parser.add_argument("--seed", type=int, default=0, help="of random moments")
    parser.add_argument("--list", type=int, default=6, metavar="COUNT", help="faults shown of each")
    given = parser.parse_args()
    if not _ONE_THREAD.items() <= os.environ.items():  # a process with threads can't fork
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | _ONE_THREAD)
    total = Tally()
    with tempfile.TemporaryDirectory(prefix="kills-") as name:
        shop = Workshop(Path(name).resolve())
        print(
            f"{'command':24}{'steps':>7}{'kills':>7}{'random':>8}{'again':>7}{'left':>6}{'faults':>8}{'s':>8}",
            flush=True,
        )
        for one in given.names or LINES:
            try:
                found = kill(shop, one, given)
            except AssertionError as error:
                found = Tally(faults=[f"{one}: {error}"])
            total += found
            print(_row(one, found), *found.faults[: given.list], sep="\n    ", flush=True)
        shop.check()
        print(_row("all", total), flush=True)
    return 1 if total.faults else 0


def _row(name: str, one: Tally) -> str:
    counts = (one.steps, one.kills, one.random, one.again, one.left, len(one.faults), round(one.seconds))
    return _columns(name, *map(str, counts))


def _columns(name: str, *texts: str) -> str:
    return "".join([f"{name:24}", *(f"{one:>8}" for one in texts)])


if __name__ == "__main__":
    sys.exit(main())
