"""Actions by their verbs: those that the manifest (actions.json) lists, and those of plug-ins.

The manifest is made of what our actions declare: `python schemas/generate.py`.
A plug-in has entry points in the group ``facepipe.processors``: a verb -> the class that is declared with
`facepipe.kinds.action`. Its commands, recipes and Python functions are as those of facepipe itself; the verbs of
facepipe's own commands and groups are taken. A verb of two words is a command of a group: ``studio lift``.
"""

from __future__ import annotations

import contextlib
import re
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.declare import fields_of
from facepipe.kinds import Action, FileAction, InPlaceAction, StageAction
from facepipe.registry import entries, loaded, manifest, own_action

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "facepipe.processors"
# flags that commands have, and arguments of functions, beside those of fields
_TAKEN = {"edit", "flatten", "force", "help", "json", "out", "output", "overwrite", "quiet", "replace", "root"}
_TAKEN |= {"loudness", "trust-models", "verbose"}


def _own() -> dict[str, dict[str, Any]]:
    own: dict[str, dict[str, Any]] = manifest()["actions"]
    return own


def _others() -> dict[str, EntryPoint]:
    """Verb -> entry point of each action of a plug-in."""
    taken = {*_own(), *manifest()["groups"]}
    return {entry.name: entry for entry in entries(GROUP) if entry.name not in taken}


def summaries(group: str = "") -> dict[str, str]:
    """Verb -> what it does, for all actions, or those of a group; for a plug-in that can't be used, the reason."""
    found = {verb: one["summary"] for verb, one in _own().items() if verb.startswith(group)}
    for verb, entry in _others().items():
        if verb.startswith(group):
            try:
                found[verb] = _of_others(entry).summary
            except InputError as error:
                found[verb] = f"({error})"
    return dict(sorted(found.items()))


def groups() -> dict[str, str]:
    """First word of verbs of two words -> their text of --help."""
    others = {verb.split()[0]: "Actions of plug-ins." for verb in _others() if " " in verb}
    return dict(sorted({**others, **manifest()["groups"]}.items()))


def function_name(verb: str) -> str:
    """Of the Python function of an action."""
    return re.sub("[- ]", "_", verb)


def verb_of(name: str) -> str | None:
    """The verb whose function `name` is; None where there is none."""
    return next((verb for verb in (*_own(), *_others()) if function_name(verb) == name), None)


def find_action(verb: str) -> type[Action[Any]] | None:
    """The action of a verb; None where there is none.

    :raises InputError: it is that of a plug-in that can't be loaded, or that has no action of the verb
    """
    if verb in _own():
        kind: type[Action[Any]] = own_action(verb)
        return kind
    entry = _others().get(verb)
    return None if entry is None else _of_others(entry)


def _of_others(entry: EntryPoint) -> type[Action[Any]]:
    """:raises InputError: it can't be loaded, or is no action of that verb"""
    action = loaded(entry)
    where = f"plug-in {entry.name} ({entry.value})"
    if not (isinstance(action, type) and issubclass(action, Action) and getattr(action, "verb", None) == entry.name):
        raise InputError(where, "is no action of that verb, expected one")
    if action.__abstractmethods__:
        raise InputError(where, f"has no {min(action.__abstractmethods__)}, expected it of such an action")
    try:
        fields = fields_of(action)
    except (TypeError, NameError, AttributeError) as error:
        raise InputError(where, f"has fields that can't be read, expected a dataclass: {error}") from None
    for one in fields:
        if _TAKEN & {one.name.replace("_", "-"), one.shown.removeprefix("--")}:
            raise InputError(f"{where} -> {one.name}", "has the name of what every command has, expected another")
    made_of_nothing = issubclass(action, FileAction) and not issubclass(action, InPlaceAction)
    if not made_of_nothing and all(field.role != "source" for field in fields):
        raise InputError(where, "has no source, expected one")
    return action


def cookable(verb: str) -> type[StageAction[Any]] | None:
    """The action that makes a face of the recipe of a verb again; None where there is none."""
    kind = find_action(verb)
    return kind if kind is not None and issubclass(kind, StageAction) else None


def cookables() -> tuple[str, ...]:
    """The verbs whose faces can be made again; those of plug-ins that can't be used are left out."""
    verbs = [verb for verb, one in _own().items() if one["has_recipe"]]
    for verb in _others():
        with contextlib.suppress(InputError):
            verbs += [verb] if cookable(verb) else []
    return tuple(sorted(verbs))
