"""Writes paths.md, of every option and every field of a file that holds a path or URL: `python docs/path_pages.py`."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from facepipe.actions import find_action, summaries
from facepipe.cli import COMMANDS, command_module
from facepipe.cli.action_line import ActionLine
from facepipe.cli.parser import Parser, holds_paths
from facepipe.cli.project_words import NEVER
from facepipe.core.policy.fields import FIELDS
from facepipe.declare import Field, fields_of
from facepipe.kinds import StageAction

PAGE = Path(__file__).resolve().parent / "paths.md"
INTRO = """# Paths and URLs, and the checks they pass

`python docs/path_pages.py` makes this page from the declarations of commands and actions, and from
`facepipe/core/policy/fields.py`. The checks are in `facepipe/core/policy/` and `facepipe/core/reading.py`; what they
protect is in [security](../SECURITY.md).

## Options

What is typed is the caller's own choice: `check_input` refuses pipes and devices, and what lies outside the roots where
reads are confined; of words that can be something else than a path the reader asks `check_regular`. `check_written`
refuses links in the roots that lead out of them. What a project file chooses for an option passes `file_chosen`, and
what a recipe holds passes `named_source` when it is cooked or edited.
"""
FILES = """
## What files say, and what is looked for beside them

"""
_TYPED, _WRITTEN, _PROJECT, _RECIPE = "check_input", "check_written", "file_chosen", "named_source"
_REGULAR = "check_regular"  # by the reader: of words that can be something else than a path
_WORDS = ("x.usda", "x.fpb", "x.json")  # of which one is a path where a word can be
_TEXTS = {  # options whose words are texts, of which some are paths or URLs -> their checks
    ("*", "--replace"): "check_model",
    ("batch", "words"): _REGULAR,
    ("batch", "--each"): "checked",
    ("batch", "-o"): "is_writable",
}
_NO_PATHS = {  # options whose help speaks of files, and that hold none
    *("--name", "--names", "--scheme", "--neutral", "--prim", "--skeleton", "--bone", "--license-url", "--cluster"),
}
_OPENED = {"checkpoint": _WRITTEN, "state": f"{_TYPED} {_WRITTEN}", "folder": _WRITTEN}
_OPENED |= dict.fromkeys(("local", "cache"), _TYPED)  # of batch: folders of the caller's
_OPENED |= {"output": _WRITTEN, "out": _WRITTEN, "edit": f"{_TYPED} {_WRITTEN}"}
_OPENED |= dict.fromkeys(("face", "other", "onnx", "files", "source", "stages"), _TYPED)  # of commands
_OPENED |= dict.fromkeys(("neural", "identity", "meta", "weights", "limits", "wheels"), _TYPED) | {"rename": _REGULAR}
_SPEAKS_OF_FILES = re.compile(
    r"\b(files?|folders?|URLs?|DIR|FILE|GLOB|ADDRESS|OUT|PLAN|path)\b|\.(json|csv|toml|usd|npz)|http"
)


class Row(NamedTuple):
    """An option that holds paths."""

    command: str
    option: str
    checks: tuple[str, ...]


def rows() -> Iterator[Row]:
    """Every option that holds paths.

    :raises ValueError: one that nobody has said the check of
    """
    for command in [*COMMANDS, *(verb for verb in summaries() if verb not in COMMANDS)]:
        for argument in _arguments(command):
            name = next(iter(argument.option_strings), argument.dest)
            checks = _checks(command, name, argument)
            if checks:
                yield Row(command, name, checks)


def _arguments(command: str) -> list[argparse.Action]:
    """Those of a command and of the action of its name."""
    kind = find_action(command)
    modules = [ActionLine(kind)] if kind else []
    modules += [command_module(command)] if command in COMMANDS else []
    found: dict[str, argparse.Action] = {}
    for module in modules:
        parser = Parser(add_help=False, common=False)
        module.configure(parser, ["--help"])
        for argument in parser._actions:
            if argument.nargs != 0 and not argument.choices:
                found.setdefault(argument.dest, argument)
    return list(found.values())


def _checks(command: str, name: str, argument: argparse.Action) -> tuple[str, ...]:
    """The checks that an argument passes; none where it holds no path."""
    kind = find_action(command)
    field = next((one for one in fields_of(kind) if one.name == argument.dest), None) if kind else None
    text = _TEXTS.get((command, name)) or _TEXTS.get(("*", name))
    if text:
        return (text,)
    if not holds_paths(argument) and not (field and field.split and any(field.split(one)[0] for one in _WORDS)):
        said = f"{argument.help} {argument.metavar}"
        if argument.type in (None, str) and _SPEAKS_OF_FILES.search(said) and name not in _NO_PATHS:
            raise ValueError(
                f"{command} {name}: '{said}' speaks of files: does it hold a path? expected it in {__file__}"
            )
        return ()
    checks = _of_role(field) or _OPENED.get(argument.dest, "").split()
    if not checks:
        raise ValueError(f"{command} {name}: holds a path, expected its check in {__file__}")
    if name.startswith("--") and name.removeprefix("--") not in NEVER and (field is None or field.role == "option"):
        checks = [*checks, _PROJECT]
    own = kind is not None and not argument.option_strings and argument.dest not in ("out", "output")
    if kind and issubclass(kind, StageAction) and (field.role == "source" and field.kept if field else own):
        checks = [*checks, _RECIPE]
    return tuple(checks)


def _of_role(field: Field | None) -> list[str]:
    roles = {"source": [_REGULAR if field and field.split else _TYPED], "beside": [_WRITTEN], "option": []}
    return [] if field is None else roles[field.role]


def page() -> str:
    """The page."""
    options = _table(("command", "option", "checks"), [(f"`{a}`", f"`{b}`", ", ".join(c)) for a, b, c in rows()])
    fields = [(one.file, one.field, one.check or "-", one.rule, f"`{one.reader}`") for one in FIELDS]
    return f"{INTRO}\n{options}\n{FILES}{_table(('file', 'what', 'check', 'it may lie', 'where'), fields)}\n"


def _table(head: tuple[str, ...], lines: list[tuple[str, ...]]) -> str:
    rule = tuple("---" for _ in head)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, rule, *lines))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8", newline="\n")
    sys.stdout.write(f"{PAGE}\n")
