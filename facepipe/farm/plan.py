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

A name in braces is a column of the table, an earlier step (its result of the same face), or `out` (its folder). The
table is of a glob, a CSV file, rows in TOML, or a range of numbers.
"""

from __future__ import annotations

import csv
import fnmatch
import io
import itertools
import os
import re
import shlex
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any, NamedTuple

from facepipe.core.errors import InputError
from facepipe.core.names import check_keys, did_you_mean, file_name
from facepipe.core.placing import relative
from facepipe.core.policy.paths import check_copied, check_writable, checked, is_url, placed, trust
from facepipe.core.reading import read_bytes, read_toml
from facepipe.declare import fields_of, option
from facepipe.tasks.remote import Store

_MOST_CSV = 1 << 27  # of a CSV file
_MOST_ROWS = 1_000_000
_MOST_COLUMNS = 4096
_MOST_VALUES = 3_000_000  # of a CSV file: a byte of it can become an object of a hundred
_MOST_ENTRIES = 1_000_000  # of folders that a glob looks at
_MOST_PATTERN = 4096  # characters
_TABLES = ("glob", "csv", "rows", "range")
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


class Row(NamedTuple):
    """A face of the table."""

    name: str
    values: Mapping[str, str]  # column -> what braces are replaced by


def read_table(where: str, folder: Path, table: Mapping[str, Any], *, typed: bool = False) -> tuple[Row, ...]:
    """The rows of one of ``glob = "heads/*.glb"`` (column face), ``csv = "faces.csv"`` (columns as its header says),
    ``rows = [{ name = "ada", seed = 7 }]``, ``range = { seed = [1, 500] }`` (both ends are in it).

    A row's `name` is its column of that name, else of its file (with folders where two are called alike), else its
    number.

    :param typed: the caller has typed the glob, which may lie anywhere; else what is read lies below the roots
    :raises InputError: none or two of these, one that can't be read, no row, or two rows of one name
    """
    kinds = [kind for kind in _TABLES if kind in table]
    check_keys(where, table, _TABLES)
    if len(kinds) != 1:
        raise InputError(where, f"expected one of {', '.join(_KINDS)}")
    kind, said = kinds[0], table[kinds[0]]
    place = f"{where}.{kind}"
    if kind == "glob":
        columns: Iterable[dict[str, str]] = _of_glob(place, folder, said, typed=typed)
    elif kind == "csv":
        columns = _of_csv(place, folder, said)
    elif kind == "rows":
        fine = isinstance(said, list) and all(isinstance(one, dict) and one.keys() == said[0].keys() for one in said)
        if not fine or not all(isinstance(value, str | int | float) for one in said for value in one.values()):
            raise InputError(place, "expected a list of rows with the same columns, texts and numbers")
        columns = ({str(key): str(value) for key, value in one.items()} for one in said)
    else:
        ends = next(iter(said.values())) if isinstance(said, dict) and len(said) == 1 else None
        if not isinstance(ends, list) or len(ends) != 2 or not all(type(end) is int for end in ends):
            raise InputError(place, "expected a column with its first and last number, like { seed = [1, 500] }")
        first, last = ends
        if not 0 <= last - first < _MOST_ROWS:
            what = f"from {first} to {last}, expected at least one and at most {_MOST_ROWS:,} numbers"
            raise InputError(place, what)
        (column,) = said
        columns = ({column: str(number)} for number in range(first, last + 1))
    rows = []
    for number, values in enumerate(columns, 1):
        own = values.get("name") or (Path(values["face"]).stem if "face" in values else "")
        name = file_name(own) if own else str(number)
        rows.append(Row(name, {**values, "name": name}))
    if not rows:
        raise InputError(where, "no face, expected at least one")
    return tuple(rows)


def _of_glob(where: str, folder: Path, pattern: Any, *, typed: bool) -> list[dict[str, str]]:
    if not isinstance(pattern, str):
        raise InputError(where, f"{str(pattern)[:40]}, expected a pattern like heads/*.glb")
    if is_url(pattern):
        checked(re.split(r"[*?[]", pattern)[0].rpartition("/")[0], trust().urls)
        files = [checked(one, trust().urls) for one in Store(pattern).matching(pattern)]
    else:
        files = sorted({*_matching(where, folder, pattern, typed=typed)})
    if len(files) > _MOST_ROWS:  # of a store
        raise InputError(where, f"more than {_MOST_ROWS:,} files are called like {pattern[:80]}")
    if not files:
        raise InputError(where, f"no file is called like {pattern[:80]}")
    faces = [Path(one.rpartition("://")[2]) for one in files]
    stems = Counter(face.stem for face in faces)
    alone = [face.stem if stems[face.stem] == 1 else "_".join(face.with_suffix("").parts) for face in faces]
    return [{"face": one.replace(os.sep, "/"), "name": name} for one, name in zip(files, alone, strict=True)]


def _matching(where: str, folder: Path, pattern: str, *, typed: bool) -> Iterator[str]:
    """The files that are called like a pattern, relative to a folder as it is.

    ``**`` is any folders; hidden names need a dot in the pattern. Links to folders are not followed below the first
    wildcard: four of them to their own folder would never end.

    :param typed: by the caller; else all must lie below the roots of a plan in the folder
    """
    if len(pattern) > _MOST_PATTERN:
        raise InputError(where, f"{pattern[:40]}... is {len(pattern):,} characters long")
    parts = pattern.replace(os.sep, "/").split("/")
    wild = next((number for number, part in enumerate(parts) if re.search(r"[*?\[]", part)), len(parts) - 1)
    start, rest = "/".join(parts[:wild]), [one for one in parts[wild:] if one not in ("", ".")]
    if ".." in rest:
        raise InputError(where, f"{pattern[:80]} has .. behind a wildcard, expected it before")
    if pattern.startswith("/") or start.endswith(":"):  # a drive of Windows
        start = f"{start}/"
    if not typed:
        check_copied(where, folder / start, folder / "plan")
    for number, (name, matches) in enumerate(_below(folder, start, rest)):
        if number == _MOST_ENTRIES:
            raise InputError(where, f"{pattern[:80]} looks at more than {_MOST_ENTRIES:,} files and folders")
        if matches:
            yield name


def _below(folder: Path, start: str, parts: Sequence[str]) -> Iterator[tuple[str, bool]]:
    """What lies below a folder as far as parts of a pattern lead, and whether it matches them all.

    Each folder is looked at once, for all places in the pattern that it is reached at: with a ``**`` after another,
    ways through the pattern are more than folders by far.
    """
    parts = [*parts, "*"] if parts[-1:] == ["**"] else parts or [""]
    fits = [re.compile(fnmatch.translate(os.path.normcase(part))).match for part in parts]
    todo = [(start, {0})]
    while todo:
        place, at = todo.pop()
        for number in sorted(at):
            while parts[number] == "**":  # no folder at all
                number += 1
                at.add(number)
        try:
            with os.scandir(folder / place) as entries:
                found = [(one.name, one.is_dir(follow_symlinks=False)) for one in entries]
        except (OSError, ValueError):  # a folder that others took away, or may not be seen
            continue
        for name, is_folder in found:
            own = f"{place}/{name}".replace("//", "/") if place else name
            plain, hidden, deeper, matches = os.path.normcase(name), name.startswith("."), set(), False
            for number in at:
                if hidden and not parts[number].startswith("."):
                    continue
                if parts[number] == "**":
                    deeper.add(number)
                elif fits[number](plain):
                    matches |= number + 1 == len(parts)
                    deeper |= {number + 1} - {len(parts)}
            yield own, matches
            if is_folder and deeper:
                todo.append((own, deeper))


def _of_csv(where: str, folder: Path, name: Any) -> Iterable[dict[str, str]]:
    if not isinstance(name, str):
        raise InputError(where, f"{str(name)[:40]}, expected a file like faces.csv")
    path = placed(folder, name)
    if is_url(path):
        address = checked(path, trust().urls)
        data = Store(address).read(address, _MOST_CSV)
    else:
        check_copied(where, Path(path), folder / "plan")
        data = read_bytes(Path(path), _MOST_CSV)
    ends = data.count(b"\n")
    if ends > _MOST_ROWS + 1 or data.count(b",") + ends > _MOST_VALUES:
        raise InputError(path, f"expected at most {_MOST_ROWS:,} faces and {_MOST_VALUES:,} values")
    return _cells(path, data)


def _cells(path: str, data: bytes) -> Iterator[dict[str, str]]:
    try:
        lines = io.TextIOWrapper(io.BytesIO(data), "utf-8-sig", newline="\n")  # a StringIO takes four bytes for each
        reader = csv.reader(lines, strict=True)
        header = [one.strip() for one in next(reader, [])]
        if len(header) > _MOST_COLUMNS:
            raise InputError(path, f"{len(header)} columns, expected at most {_MOST_COLUMNS}")
        if not header or len({*header}) != len(header) or "" in header:
            raise InputError(path, "expected a first line with a name for each column, each once")
        for line in reader:
            cells = [one.strip() for one in line]
            if not any(cells):
                continue
            if len(cells) != len(header):
                raise InputError(f"{path} -> line {reader.line_num}", f"{len(cells)} values, expected {len(header)}")
            yield dict(zip(header, cells, strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, f"is no CSV file: {error}") from None


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
