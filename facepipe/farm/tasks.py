"""The tasks of a plan: a step of a face each, in the order in which they can be done."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.farm.plan import OUT, Plan, Step, filled
from facepipe.farm.remote import is_url, placed
from facepipe.farm.table import Row

_NUMBER = re.compile(r"-\d*\.?\d*(e-?\d+)?")
_WHOLE = re.compile(r"\{([^{}]*)\}")


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
    return [name for one in task.step.needs for name in tasks_named(plan, task, one)]


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
    for name in _WHOLE.findall(task.step.out):
        value = values.get(name, "")
        if Path(value).is_absolute() or is_url(value) or ".." in re.split(r"[/\\]", value) or "\0" in value:
            raise InputError(task.name, f"{{{name}}} is {value[:80]}, which leads out of the folder of results")
    return _from(plan, placed(plan.out, filled(task.step.out, {**values, OUT: "."})))


def line_of(plan: Plan, task: Task, results: Mapping[str, Sequence[str]]) -> list[str]:
    """The words to run, with its result.

    :param results: step that it needs -> the paths of its results
    :raises InputError: a value that would be read as a flag
    """
    values: dict[str, str] = {} if task.row is None else dict(task.row.values)
    values[OUT] = _from(plan, plan.out)
    values |= {name: " ".join(paths) for name, paths in results.items()}
    words: list[str] = []
    for word in task.step.words:
        named = _WHOLE.fullmatch(word)
        many = results.get(named[1], ()) if named else ()
        put = list(many) if len(many) > 1 else [filled(word, values)]
        for one in put:
            if one.startswith("-") and not word.startswith("-") and not _NUMBER.fullmatch(one):
                raise InputError(task.name, f"{word} is {one[:40]}, which reads as a flag, expected another value")
        words += put
    out = result_of(plan, task)
    return [*words, "-o", out] if out else words


def _from(plan: Plan, path: str) -> str:
    """A path from the plan's folder, so that what is written is the same wherever that is; a URL as it is."""
    try:
        return path if is_url(path) else Path(os.path.relpath(path, plan.folder)).as_posix()
    except ValueError:  # another drive
        return Path(path).as_posix()
