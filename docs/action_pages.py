"""Writes actions.md of what actions declare: `python docs/action_pages.py`."""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import inspect
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import facepipe
from facepipe.actions import find_action, function_name, summaries
from facepipe.declare import Field, fields_of
from facepipe.kinds import Action, FileAction
from facepipe.registry import manifest

PAGE = Path(__file__).resolve().parent / "actions.md"
INTRO = """# Actions: sources, options, files

Sources and options of `facepipe VERB` and of the Python function `facepipe.verb`. `python docs/action_pages.py` makes
this page from what actions declare; `facepipe VERB --help` has examples, and editors have the signatures
(`facepipe/__init__.pyi`).

- An action that makes a face writes `-o OUT` (`out`): a stage with a recipe, over one of its sources, or an export of
  it. It takes `--force` (`overwrite`), `--flatten` (`flatten`: a standalone file), `--json` (the report, which the
  function returns) and `--edit RESULT`: a result is made anew from its recipe, with the other given options changed.
- An action that makes another file names it. It has no recipe, and so no `--edit` and no `--flatten`.
- An action that works in place changes its first file, unless it has OUT.
- An action without OUT only prints.
- `Report` has the fields of what the function returns; `--json` prints them, with the path of what was written.

Every command takes `-q` (`--quiet`: nothing on stderr but errors; warnings are in the report of `--json`) and `-v`
(`--verbose`: debug lines with times too, of Python's logger `facepipe`).
"""
_ON = {True: "on", False: "off"}
_TYPES = {bool: "on or off", float: "number", int: "whole number", str: "text", Path: "file"}


def page(verbs: Iterable[str]) -> str:
    """The page of actions."""
    return "\n".join([INTRO, *map(section, verbs)])


def section(verb: str) -> str:
    """What one action takes."""
    kind = find_action(verb)
    if kind is None:
        raise SystemExit(f"{verb}: no action")
    fields = fields_of(kind)
    by_role = {role: [field for field in fields if field.role == role] for role in ("source", "option", "beside")}
    result = f" OUT: {kind.output}." if issubclass(kind, FileAction) else ""
    parts = [f"## {verb}", f"{kind.summary[0].upper()}{kind.summary[1:]}.{_call(verb)}{result}"]
    if by_role["source"]:
        parts.append(_table(("source", "Python", "type", "what"), (_source(one) for one in by_role["source"])))
    options = [_option(one) for one in by_role["option"] if one.name not in kind.own_flags] + list(_own_flags(kind))
    if options:
        parts.append(_table(("option", "Python", "type", "default", "range", "what"), options))
    if by_role["beside"]:
        rows = ((_code(one.shown), _code(one.name), one.suffix or "folder", one.help) for one in by_role["beside"])
        parts.append(_table(("beside", "Python", "type", "what"), rows))
    parts.append(f"Report: {', '.join(map(_code, _report_fields(kind)))}.")
    return "\n\n".join(parts) + "\n"


def _report_fields(kind: type[Action[Any]]) -> list[str]:
    """Names of what its report has in JSON, `warnings` last."""
    module, _, name = manifest()["actions"][kind.verb]["report"].partition(":")
    report = getattr(importlib.import_module(module), name)
    names = [field.name for field in dataclasses.fields(report) if field.metadata.get("said", True)]
    return sorted(names, key=lambda name: name == "warnings")


def _call(verb: str) -> str:
    """The Python line with what must be given."""
    name = function_name(verb)
    function = getattr(facepipe, name)
    needed = [
        parameter
        for parameter in inspect.signature(function).parameters.values()
        if parameter.default is parameter.empty
    ]
    words = [one.name if one.kind is one.POSITIONAL_OR_KEYWORD else f"{one.name}=..." for one in needed]
    return f" In Python: `facepipe.{name}({', '.join(words)})`."


def _source(one: Field) -> tuple[str, ...]:
    needed = "" if one.needed else " (may be left out)"
    return _code(one.shown), _code(one.name), type_of(one), f"{one.help}{needed}"


def _option(one: Field) -> tuple[str, ...]:
    span = "" if one.low is None or one.high is None else f"{one.low:g} to {one.high:g}"
    unsaid = one.default in (None, "", (), {})
    default = _ON[one.default] if isinstance(one.default, bool) else "" if unsaid else _code(str(one.default))
    return _code(one.shown), _code(one.name), type_of(one), default, f"{span} {one.unit}".strip(), one.help


def _own_flags(kind: type[Action[Any]]) -> Iterator[tuple[str, ...]]:
    """Flags that are not a field each."""
    parser = argparse.ArgumentParser(add_help=False)
    kind.add_flags(parser)
    names = ", ".join(map(_code, kind.own_flags))
    for action in parser._actions:
        for flag in action.option_strings:
            yield _code(flag), names, _code(str(action.metavar)), "", "", str(action.help)


def type_of(one: Field) -> str:
    """In words, as people give it."""
    if one.choices:
        return ", ".join(_code(str(choice)) for choice in one.choices)
    if one.value is not None:
        return "JSON"
    return " or ".join(_kind(kind) for kind in one.kinds if kind is not types.NoneType)


def _kind(kind: Any) -> str:
    if typing.get_origin(kind) is tuple:
        return f"{_kind(typing.get_args(kind)[0])}s"
    if typing.get_origin(kind) is Mapping:
        return f"{_kind(typing.get_args(kind)[1])}s by name"
    return _TYPES[kind]


def _code(text: str) -> str:
    return f"`{text}`"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = (f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in rows)
    return "\n".join([f"| {' | '.join(head)} |", "|---" * len(head) + "|", *lines])


if __name__ == "__main__":
    PAGE.write_text(page(summaries()), encoding="utf-8")
