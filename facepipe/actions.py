"""Actions by their verbs: those in files called ``<verb>_action.py`` among the processors, and those of plug-ins.

A plug-in has entry points in the group ``facepipe.processors``: a verb -> the class that is declared with
`facepipe.kinds.action`. Its commands, recipes and Python functions are as those of facepipe itself; the verbs of
facepipe's own commands are taken.
"""

from __future__ import annotations

import functools
import importlib
import re
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError
from facepipe.kinds import Action, StageAction
from facepipe.registry import loaded

GROUP = "facepipe.processors"
_DECLARED = re.compile(r'^@action\(\s*"([^"]+)",\s*"([^"]+)"', re.MULTILINE)


@functools.cache
def _own() -> dict[str, tuple[str, str]]:
    """Verb -> module and summary of each action in this package; nothing of them is imported."""
    root, found = Path(__file__).parent, {}
    for file in sorted((root / "processors").rglob("*_action.py")):
        module = ".".join(("facepipe", *file.relative_to(root).with_suffix("").parts))
        for verb, summary in _DECLARED.findall(file.read_text(encoding="utf-8")):
            found[verb] = (module, summary)
    return found


def summaries() -> dict[str, str]:
    """Verb -> what it does, of all actions; of a plug-in that can't be used, why."""
    own = {verb: summary for verb, (_, summary) in _own().items()}
    others = {entry.name: _summary(entry) for entry in entry_points(group=GROUP)}
    return dict(sorted({**others, **own}.items()))


def _summary(entry: EntryPoint) -> str:
    try:
        return _of_others(entry).summary
    except InputError as error:
        return f"({error})"


def groups() -> dict[str, str]:
    """First word of this package's verbs of two words -> their text of --help: the docstring of their package."""
    packages = {verb.split()[0]: module.rpartition(".")[0] for verb, (module, _) in _own().items() if " " in verb}
    return {name: importlib.import_module(one).__doc__ or name for name, one in sorted(packages.items())}


def function_name(verb: str) -> str:
    """Of the Python function of an action."""
    return re.sub("[- ]", "_", verb)


def verb_of(name: str) -> str:
    """The verb whose function `name` is; what a plug-in would call it, where none of this package has it."""
    return next((verb for verb in _own() if function_name(verb) == name), name.replace("_", "-"))


def find_action(verb: str) -> type[Action[Any]] | None:
    """The action of a verb; None where there is none.

    :raises InputError: it is that of a plug-in that can't be loaded, or that has no action of the verb
    """
    if verb in _own():
        module = importlib.import_module(_own()[verb][0])
        kinds = (one for one in vars(module).values() if isinstance(one, type) and issubclass(one, Action))
        return next(kind for kind in kinds if getattr(kind, "verb", None) == verb)
    return next((_of_others(entry) for entry in entry_points(group=GROUP, name=verb)), None)


def _of_others(entry: EntryPoint) -> type[Action[Any]]:
    """:raises InputError: it can't be loaded, or is no action of that verb"""
    found = loaded(entry)
    where = f"plug-in {entry.name} ({entry.value})"
    if not (isinstance(found, type) and issubclass(found, Action) and getattr(found, "verb", None) == entry.name):
        raise InputError(where, "is no action of that verb, expected one")
    if found.__abstractmethods__:
        raise InputError(where, f"has no {min(found.__abstractmethods__)}, expected it of such an action")
    return found


def cookable(verb: str) -> type[StageAction[Any]] | None:
    """The action that makes a face of the recipe of a verb again; None where there is none."""
    kind = find_action(verb)
    return kind if kind is not None and issubclass(kind, StageAction) else None
