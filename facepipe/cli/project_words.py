"""What a project adds to a line: defaults of options, and tables of names."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from facepipe.actions import find_action, groups, summaries
from facepipe.cli.parser import Parser, add_field, names_file
from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean
from facepipe.core.placing import relative
from facepipe.core.policy.paths import file_chosen
from facepipe.core.project import Project
from facepipe.declare import fields_of

# a project may be of others: it decides how, not where to, with what trust, or by whom
NEVER = {"help", "root", "trust-models", "force", "output", "edit", "replace"}
NEVER |= {"state", "each", "cluster", "cache", "local"}  # of batch
NEVER |= {"checkpoint", "wheels"}  # a file that training writes, and code that an add-on takes in
NEVER |= {"tls-cert", "tls-key"}
_OWN = "serve"  # a command that no project chooses an option of: who is served, and what is kept, is the caller's say


Modules = Callable[[str], Any]  # a command -> what configures it, None for no command


def with_project(project: Project, words: Sequence[str], modules: Modules, folder: Path, out: str = "") -> list[str]:
    """The words of a line with a project's defaults before those that are given, which come later and win.

    :param words: the command first
    :param modules: what configures commands that are no actions
    :param folder: that paths of the line are relative to
    :param out: its result, where the line does not name it
    :raises InputError: the project names an unknown command or option, an option that it may not choose, or a file
        outside of its folder and the roots
    """
    for command in project.defaults:
        if find_action(command) is None and (command in groups() or modules(command) is None):
            near = did_you_mean(command, summaries())
            raise InputError(f"{project.file} -> defaults", f"'{command[:40]}' is no command{near}")
        if command == _OWN:
            raise InputError(f"{project.file} -> defaults", f"has some of '{_OWN}', which no project may choose")
    count = 2 if words[0] in groups() else 1
    verb, rest = list(words[:count]), list(words[count:])
    result = ["-o", out] if out else []
    put = [] if "--edit" in words else list(_flags(project, " ".join(verb), modules, [*rest, *result], folder))
    line, named = [*put, *rest], []  # with tables of names as their files
    for number, word in enumerate(line):
        flag, equals, value = word.partition("=")
        after = number > 0 and line[number - 1] == "--rename"
        name = value if flag == "--rename" and equals else word if after else ""
        if name in project.names:
            file = _seen(project, f"{project.file} -> names.{name}", project.names[name], folder)
            word = f"--rename={file}" if equals and not after else file
        named.append(word)
    return [*verb, *named]


def _flags(project: Project, command: str, modules: Modules, words: Sequence[str], folder: Path) -> Iterator[str]:
    """A project's defaults for a command, those that the format of the line's output has."""
    defaults = project.defaults.get(command, {})
    known = _known(command, modules, ["--help"]) if defaults else {}
    # with the project's own flags: some commands add flags only to a line that may have them
    chosen = [f"--{name}" for name in (one.replace("_", "-") for one in defaults) if name in known]
    here = _known(command, modules, [*words, *chosen]) if defaults else {}
    for name, value in defaults.items():
        where, name = f"{project.file} -> defaults.{command}", name.replace("_", "-")
        if name not in known:
            near = did_you_mean(name, known) or f", expected some of {', '.join(sorted(known))}"
            raise InputError(where, f"'{name[:40]}' is no option that a project can choose{near}")
        for item in value if isinstance(value, list) else [value]:
            if not isinstance(item, str | int | float):
                raise InputError(f"{where}.{name}", f"{str(item)[:40]}, expected a text, a number, or true or false")
            if isinstance(item, str) and names_file(known[name], item) and item not in project.names:
                item = _seen(project, f"{where}.{name}", item, folder)
            flag = (f"--{name}" if item else f"--no-{name}") if isinstance(item, bool) else f"--{name}={item}"
            if flag.partition("=")[0].removeprefix("--") in here:
                yield flag


def _known(command: str, modules: Modules, words: Sequence[str]) -> Mapping[str, argparse.Action]:
    """The options of a command that a project may choose, of the format that `words` write, or of all (--help)."""
    parser = Parser(add_help=False, common=False)
    kind = find_action(command)
    if kind is None:
        modules(command).configure(parser, [*words])
    else:
        kind.add_flags(parser)
        for field in fields_of(kind):
            if field.role == "option" and field.name not in kind.own_flags:
                add_field(parser, field)
    found = {flag.removeprefix("--"): one for flag, one in parser._option_string_actions.items()}
    return {name: one for name, one in found.items() if not name.startswith("-") and name not in NEVER}


def _seen(project: Project, where: str, name: str, folder: Path) -> str:
    """A file that the project names, as seen from where the line is run."""
    return relative(file_chosen(where, name, project.file, project.folders), folder)
