"""Plans: steps over a table of faces, each step a line of the command line with names in braces.

    out = "built"

    [faces]
    range = { seed = [1, 500] }

    [steps.person]
    run = "sample --seed {seed} --textures 0"
    out = "people/{name}.usdc"

    [steps.game]
    run = "export {person}"
    out = "game/{name}.glb"

A name in braces is a column of the table, an earlier step (its result of the same face), or `out` (its folder).
"""

from __future__ import annotations

import itertools
import re
import shlex
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError
from facepipe.core.names import check_keys, did_you_mean
from facepipe.core.placing import relative
from facepipe.core.policy.paths import check_writable, is_url, placed
from facepipe.core.reading import read_toml
from facepipe.declare import fields_of, option
from facepipe.farm.table import Row, read_table

_MOST_BYTES = 1 << 20
_MOST_STEPS = 256
_MOST_LINKS = 20_000_000  # tasks, and tasks that these need: a line of a plan makes one for each face
_MOST_TEXT = 2_000_000_000  # characters of the lines of all tasks
_MOST_LINE = 1 << 14  # characters of a line for a face: thousands are given out at once
_MOST_OF_ALL = 1 << 26  # of a line for all faces
_FEW = 1000  # names that an unknown one is compared to
_NUMBER = re.compile(r"-\d*\.?\d*(e-?\d+)?")  # that begins as a flag does
_BRACES = re.compile(r"\{([^{}]*)\}")
_STEP = re.compile(r"[A-Za-z_][A-Za-z0-9_-]{0,60}")
# key of a step beside its line -> type of its value
_KINDS: Mapping[str, Any] = {
    "memory_mb": (int, float),
    "once": bool,
    "out": str,
    "priority": int,
    "seconds": (int, float),
}
_PRIORITIES = 1_000_000
OUT = "out"


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Limits of tasks, what is done again, and where results are kept."""

    seconds: float = option(3600.0, "limit on the time of a task; its process is ended then", 0.1, 1e7, "s")
    memory_mb: float | None = option(None, "limit on the memory of a task's process (needs psutil)", 50.0, 1e7, "MB")
    failures: int = option(3, "processes or workers that a task may lose before it counts as failed", 0, 1000)
    retry_failed: bool = option(False, "do failed tasks again, even if nothing that they read has changed")
    resume: bool = option(False, "take finished tasks as they are, whatever has changed since: ends a killed run")
    verify: bool = option(False, "compare the digests of all that is kept; what differs is done again")
    local: Path | None = option(None, "folder on each machine for copies of files at URLs (default ~/.cache/facepipe)")
    local_gb: float = option(20.0, "limit on these copies; the least recently used go first", 0.001, 1e6, "GB")
    cache: Path | None = option(None, "folder of results by content, shared by plans and runs")
    cache_gb: float = option(20.0, "limit on the cache; the least recently used go first", 0.001, 1e6, "GB")


@dataclass(frozen=True, kw_only=True)
class Step:
    """A line of the command line, run for each face, or once for all."""

    name: str
    words: tuple[str, ...]
    out: str = ""  # pattern of the result's path; empty: it writes none
    once: bool = False  # for all faces: {step} is the results of all
    priority: int = 0  # steps of a higher one first
    seconds: float | None = None  # limits of their own
    memory_mb: float | None = None
    needs: tuple[str, ...] = ()  # steps


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Steps over a table of faces."""

    where: str  # for messages
    folder: Path  # paths in its lines are relative to it
    out: str  # folder of results: an absolute path, or a URL
    rows: tuple[Row, ...]
    steps: tuple[Step, ...]  # those that others need first
    faults: Mapping[str, str] = field(default_factory=dict)  # step that can't be run -> why


def read_plan(path: Path) -> Plan:
    """:raises InputError: no plan, a table that can't be read, or no step"""
    content = read_toml(path, _MOST_BYTES)
    check_keys(path, content, ("faces", "out", "steps"))
    folder = path.absolute().parent
    out = content.get("out", "out")
    faces, steps = content.get("faces"), content.get("steps")
    if not isinstance(out, str) or not isinstance(faces, dict) or not isinstance(steps, dict) or not steps:
        raise InputError(path, 'expected out = "FOLDER", a table [faces], and a table [steps.NAME] for each step')
    out = placed(folder, out)
    if not is_url(out):
        check_writable(f"{path} -> out", Path(out, "face"), folder / "plan")
    if len(steps) > _MOST_STEPS:
        raise InputError(path, f"{len(steps)} steps, expected at most {_MOST_STEPS}")
    rows = read_table(f"{path} -> faces", folder, faces)
    return plan_of(str(path), folder, out, rows, {name: _step(path, name, one) for name, one in steps.items()})


def plan_of(where: str, folder: Path, out: str, rows: Sequence[Row], steps: Mapping[str, Step]) -> Plan:
    """A plan with its steps in the order of their needs, and what is wrong with any of them.

    :raises InputError: more work than a run can hold
    """
    columns = set(rows[0].values) if rows else set()
    faults = {name: line for name, one in steps.items() for line in itertools.islice(_faults(one, columns, steps), 1)}
    clear = {name: one for name, one in steps.items() if name not in columns}
    known = {
        name: replace(one, needs=tuple(dict.fromkeys(name for name in braces(one) if name in clear)))
        for name, one in steps.items()
    }
    links = len(rows) * sum(1 + len(one.needs) for one in known.values())
    text = len(rows) * sum(len(word) for one in known.values() for word in (*one.words, one.out))
    if links > _MOST_LINKS or text > _MOST_TEXT:
        raise InputError(where, f"{len(rows):,} faces are too many for {len(steps)} steps, expected fewer of either")
    faults |= _circles({name: one for name, one in known.items() if name not in faults})
    ordered: dict[str, Step] = {}  # after those that they need, else as written; those in circles last
    while len(ordered) < len(known):
        ready = [one for one in known.values() if one.name not in ordered and set(one.needs) <= ordered.keys()]
        ordered |= {one.name: one for one in ready or known.values() if one.name not in ordered}
    steps_in_order = tuple(ordered.values())
    return Plan(where=where, folder=folder, out=out, rows=tuple(rows), steps=steps_in_order, faults=faults)


def _step(path: Path, name: str, table: Any) -> Step:
    where = f"{path} -> steps.{name}"
    if name == OUT:
        raise InputError(where, f"{{{OUT}}} is the folder of results, expected another name for the step")
    if not _STEP.fullmatch(name):
        raise InputError(where, "expected a name of letters, digits, - and _")
    if not isinstance(table, dict):
        raise InputError(where, f'{str(table)[:40]}, expected a table with run = "ACTION ..."')
    check_keys(where, table, sorted(("run", *_KINDS)))
    run = table.get("run")
    if not isinstance(run, str | list) or not all(isinstance(one, str) for one in run):
        raise InputError(where, 'no line to run, expected run = "ACTION ..."')
    ranges = {one.name: (one.low, one.high) for one in fields_of(RunOptions) if one.low is not None}
    ranges["priority"] = (-_PRIORITIES, _PRIORITIES)
    for key, kind in _KINDS.items():
        if key in table and (not isinstance(table[key], kind) or (kind is not bool and isinstance(table[key], bool))):
            raise InputError(f"{where} -> {key}", f"{str(table[key])[:40]}, expected another kind of value")
        if key in ranges and key in table and not ranges[key][0] <= table[key] <= ranges[key][1]:
            low, high = ranges[key]
            raise InputError(f"{where} -> {key}", f"{str(table[key])[:40]}, expected a number from {low:g} to {high:g}")
    return Step(name=name, words=words_of(where, run), **{key: table[key] for key in _KINDS if key in table})


def words_of(where: object, run: str | Sequence[str]) -> tuple[str, ...]:
    """The words of a line, split as a shell does.

    :raises InputError: no word, or a quote that never ends
    """
    try:
        words = shlex.split(run) if isinstance(run, str) else list(run)
    except ValueError as error:
        raise InputError(where, f"run can't be split into words: {error}") from None
    words = words[1:] if words[:1] == ["facepipe"] else words
    if not words:
        raise InputError(where, "no line to run, expected one like `export {face}`")
    return tuple(words)


def each(pattern: str, words: Sequence[str], out: str) -> Plan:
    """A plan of one line for each file; paths are relative to the working folder.

    :param pattern: of the files, like ``heads/*.glb``
    :param out: pattern of the result's path; empty: the line writes none
    :raises InputError: no such file, no line, or one that names no {face}
    """
    folder, line = Path.cwd(), words_of("--each", words)
    step = Step(name=f"{line[0]}{Path(out).suffix}", words=line, out=out)  # differs between formats
    if not {"face", "name"} & {*braces(step)}:
        raise InputError("--each", "the line names no {face}, expected one like `-- export {face}`")
    return plan_of(
        f"--each {pattern}",
        folder,
        str(folder),
        read_table("--each", folder, {"glob": pattern}, typed=True),
        {step.name: step},
    )


def braces(step: Step) -> Iterator[str]:
    """The names in braces, of its words first."""
    for word in (*step.words, step.out):
        yield from _BRACES.findall(word)


def _faults(step: Step, columns: Collection[str], steps: Collection[str]) -> Iterator[str]:
    known = {OUT, *steps, *(() if step.once else columns)}
    if step.name in columns:
        yield "is the name of a column too, expected another"
    for name in braces(step):
        if name not in known:
            near = did_you_mean(name, known) if len(known) <= _FEW else ""
            near = near or f", expected one of {', '.join(sorted(known)[:_FEW])}"
            yield f"{{{name[:40]}}} is no column of the table and no step{near}"
    for name in _BRACES.findall(step.out):
        if name in steps:
            yield f"out names the step {{{name}}}, expected columns of the table"


def _circles(steps: Mapping[str, Step]) -> dict[str, str]:
    """Steps that need themselves -> how."""
    faults: dict[str, str] = {}
    while True:
        left = {
            name: [need for need in step.needs if need in steps] for name, step in steps.items() if name not in faults
        }
        try:
            TopologicalSorter(left).prepare()
        except CycleError as error:
            circle = error.args[1]
            faults |= dict.fromkeys(circle, f"needs itself: {' -> '.join(reversed(circle))}")
        else:
            return faults


def filled(pattern: str, values: Mapping[str, str], most: int = _MOST_LINE) -> str:
    """`pattern` with names in braces replaced.

    :raises InputError: it gets longer than that: a value costs nothing to name again
    """
    if len(pattern) + sum(len(values[name]) for name in _BRACES.findall(pattern)) > most:
        raise InputError(pattern[:40], f"more than {most:,} characters with its values")
    return _BRACES.sub(lambda found: values[found[1]], pattern)


@dataclass(frozen=True, slots=True)
class Task:
    """A step of a face, or of all."""

    name: str  # "game/ada"; of a step once for all its name
    step: Step
    row: Row | None
    number: int  # of the row

    @property
    def order(self) -> tuple[int, int]:
        """Steps of a higher priority first, then faces as the table has them."""
        return -self.step.priority, self.number


def tasks_of(plan: Plan) -> Iterator[Task]:
    """Those of a face after those that it needs."""
    for number, row in enumerate(plan.rows):
        for step in plan.steps:
            if not step.once:
                yield Task(f"{step.name}/{row.name}", step, row, number)
    for step in plan.steps:
        if step.once:
            yield Task(step.name, step, None, len(plan.rows))


def needed(plan: Plan, task: Task) -> list[str]:
    """The names of the tasks that one needs."""
    return [name for need in task.step.needs for name in tasks_named(plan, task, need)]


def tasks_named(plan: Plan, task: Task, step: str) -> list[str]:
    """The names of the tasks of a step that one needs: of its face, or of all."""
    once = next(one.once for one in plan.steps if one.name == step)
    if once:
        return [step]
    return [f"{step}/{row.name}" for row in ([task.row] if task.row else plan.rows)]


def result_of(plan: Plan, task: Task) -> str:
    """The path of its result as lines name it, from the plan's folder where it can be; empty where it has none.

    :raises InputError: a value that leads elsewhere, or whose path starts like a flag
    """
    if not task.step.out:
        return ""
    values = {} if task.row is None else task.row.values
    for name in dict.fromkeys(_BRACES.findall(task.step.out)):
        value = values.get(name, "")
        if Path(value).is_absolute() or is_url(value) or ".." in re.split(r"[/\\]", value) or "\0" in value:
            raise InputError(task.name, f"{{{name}}} is {value[:80]}, which leads out of the folder of results")
    return _from(plan, placed(plan.out, filled(task.step.out, {**values, OUT: "."})))


def line_of(plan: Plan, task: Task, results: Mapping[str, Sequence[str]]) -> list[str]:
    """The words to run, with its result.

    :param results: step that it needs -> the paths of its results
    :raises InputError: a value that would be read as a flag, or more text than a line has
    """
    most = _MOST_OF_ALL if task.row is None else _MOST_LINE
    values: dict[str, str] = {} if task.row is None else dict(task.row.values)
    values[OUT] = _from(plan, plan.out)
    values |= {name: " ".join(paths) for name, paths in results.items()}
    words: list[str] = []
    for word in task.step.words:
        named = _BRACES.fullmatch(word)
        many = results.get(named[1], ()) if named else ()
        put = list(many) if len(many) > 1 else [filled(word, values, most)]
        for one in put:
            if one.startswith("-") and not word.startswith("-") and not _NUMBER.fullmatch(one):
                raise InputError(task.name, f"{word} is {one[:40]}, which reads as a flag, expected another value")
        words += put
        most -= sum(map(len, put))
    out = result_of(plan, task)
    return [*words, "-o", out] if out else words


def _from(plan: Plan, path: str) -> str:
    """A path from the plan's folder, so that what is written is the same wherever that is; a URL as it is."""
    return path if is_url(path) else relative(path, plan.folder)
