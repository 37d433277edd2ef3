"""The command line of an action, made of its declaration: flags and help, `--edit`, what is printed, the exit code."""

from __future__ import annotations

import argparse
import functools
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.actions import find_action, groups, summaries
from facepipe.cli.parser import Parser, add_field, output_or_edited
from facepipe.cli.show import emit, progress, warn
from facepipe.core.errors import InputError
from facepipe.declare import fields_of
from facepipe.kinds import A, Action, FileAction, FolderAction, InPlaceAction, Inspector, StageAction

if TYPE_CHECKING:
    from facepipe.performing import Kept

_STAGE = "override layer to write: .usda .usdc .usd .usdz; or an export of it: .glb .onnx ..."
_EDIT = (
    "make a result anew from its recipe, with the other options given here changed (--no-FLAG removes one); without -o "
    "in place (needs --force), where other edits of that file are lost"
)


class ActionLine:
    """What `facepipe VERB` takes and does; its docstring is that of the module that declares the action."""

    def __init__(self, kind: type[Action[Any]]) -> None:
        self.kind = kind
        self.__doc__: str = sys.modules[kind.__module__].__doc__ or kind.summary

    def configure(self, parser: Parser, words: Sequence[str] = ()) -> None:
        """Add the arguments."""
        kind, parser.intermixed = self.kind, True
        add, fields = parser.add_argument, fields_of(kind)
        for field in fields:
            if field.role == "source" and field.name not in kind.own_flags:
                add_field(parser, field)
        staged = issubclass(kind, StageAction)
        parser.set_defaults(edit=None, flatten=False)
        if not issubclass(kind, Inspector):
            result = kind.output if issubclass(kind, FileAction) else _STAGE
            if not any(field.stands_alone for field in fields):
                add("out", nargs="?", type=Path, metavar="OUT", help=f"{result} (or -o OUT)")
            add("-o", "--output", type=Path, metavar="OUT", help=result.replace("%", "%%"))
            edited = ", or with --edit RESULT," if staged else ""
            add("--force", action="store_true", help=f"overwrite OUT{edited} and what is written beside it")
        if staged:
            add("--edit", type=Path, metavar="RESULT", help=_EDIT)
            add("--flatten", action="store_true", help="write a standalone file")
        if staged and any(field.several and field.stands_alone for field in fields):
            text = "with --edit: another file for source N of the recipe"
            add("--replace", action="append", default=[], metavar="N=FILE", help=text)
        for field in fields:
            if field.role == "beside":
                add_field(parser, field)
        add("--json", action="store_true", help="print the report as JSON")
        kept = " (kept in the recipe; --edit changes them)" if staged else ""
        group = parser.add_argument_group(f"settings{kept}")
        kind.add_flags(group)
        for field in fields:
            if field.role == "option" and field.name not in kind.own_flags:
                add_field(group, field)

    def run(self, arguments: argparse.Namespace) -> int:
        """Do the action, print its report; the exit code."""
        from facepipe.performing import check_result, perform

        kept, action = action_of(arguments, self.kind)
        if isinstance(action, Inspector):
            action.check()
            report = action.look(progress)
            warn(report.warnings)
            emit(report, action.text(report, action.base), as_json=arguments.json)
            return 1 if action.missed(report) else 0
        warn(kept.warnings if kept else ())
        inputs = inputs_of(arguments, action)
        arguments.output = arguments.output or getattr(arguments, "out", None)
        in_place = isinstance(action, InPlaceAction) and arguments.output is None
        a_folder = isinstance(action, FolderAction) and arguments.output is not None  # which is checked with the rest
        with ExitStack() as files:
            instead = None if arguments.output or kept else _instead(action)
            if instead is not None:
                out = Path(files.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))) / "made.usdc"
            elif in_place or a_folder:
                out = action.base if in_place else arguments.output
            else:
                out = output_or_edited(arguments, inputs)
            check_result(action, out, [*inputs, *([arguments.edit] if kept else [])], overwrite=arguments.force)
            flatten = arguments.flatten or (kept is not None and kept.standalone)
            waiting = functools.partial(warn, [f"{out}: another process changes it, waiting"])
            done = perform(action, out, flatten=flatten, watch=progress, waiting=waiting)
        out = instead or out
        warn(done.report.warnings)
        if arguments.json:
            result = {"path": str(out), **done.report.to_dict(), **done.beside}
            if isinstance(action, FileAction) and not a_folder:
                result["bytes"] = out.stat().st_size
            result["warnings"] = [*(kept.warnings if kept else ()), *done.report.warnings]
            emit(result, "", as_json=True)
            return 1 if action.missed(done.report) else 0
        text = [action.text(done.report, out)]
        for one in done.beside.values():
            text.append(f"{one['path']}: {one['bytes']:,} bytes" if isinstance(one, Mapping) else str(one))
        emit({}, "\n".join(text), as_json=False)
        return 1 if action.missed(done.report) else 0


def _instead(action: Action[Any]) -> Path | None:
    """The file that is asked for where no result is."""
    asked = (getattr(action, field.name) for field in fields_of(type(action)) if field.instead)
    return next((path for path in asked if path is not None), None)


class ActionGroup:
    """What `facepipe NAME ACTION` takes and does: the actions whose verbs are NAME and another word."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.__doc__ = groups()[name]  # the text of --help

    def configure(self, parser: Parser, words: Sequence[str] = ()) -> None:
        """Add the actions, and the arguments of the one that `words` name."""
        actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=Parser)
        for verb, summary in summaries(f"{self.name} ").items():
            name = verb.partition(" ")[2]
            line = self.line(name) if name in words else None
            help = summary.replace("%", "%%")
            own = actions.add_parser(name, help=help, description=line.__doc__ if line else None)
            if line:
                line.configure(own)

    def run(self, arguments: argparse.Namespace) -> int:
        """Do the action, print its report; the exit code."""
        return self.line(arguments.action).run(arguments)

    def line(self, action: str) -> ActionLine:
        """That of an action."""
        kind = find_action(f"{self.name} {action}")
        assert kind is not None
        return ActionLine(kind)


def inputs_of(arguments: argparse.Namespace, action: Action[Any]) -> list[Path]:
    """The files that an action reads, and those that the line gives for values of its fields."""
    from facepipe.performing import files_of

    read = [getattr(arguments, field.name, None) for field in fields_of(type(action)) if field.is_read]
    return [*files_of(action), *(path for path in read if path is not None)]


def action_of(arguments: argparse.Namespace, kind: type[A]) -> tuple[Kept | None, A]:
    """The action that a line asks for, and the recipe that it edits.

    :raises InputError: what is needed is not given, or a recipe that can't be used
    """
    from facepipe.performing import read_kept

    fields = fields_of(kind)
    given = {one.name: getattr(arguments, one.name) for one in fields if hasattr(arguments, one.name)}
    unsaid = {one.name for one in fields if one.stands_alone and not given.get(one.name)}
    given = {name: value for name, value in given.items() if name not in {*unsaid, *kind.own_flags}}
    own_replace = any(one.name == "replace" for one in fields)  # a flag of the action's own, not of its sources
    words = () if own_replace else getattr(arguments, "replace", ())
    instead: dict[int, Path] = {}
    for word in words:
        number, equals, path = word.partition("=")
        if not (equals and path and number.isascii() and number.isdecimal() and len(number) < 7):
            raise InputError(f"--replace {word}", "expected N=FILE, N the number of a source from 1")
        if int(number) in instead:
            raise InputError(f"--replace {int(number)}=...", "given twice, expected it once")
        instead[int(number)] = Path(path)
    if instead and arguments.edit is None:
        raise InputError("--replace", "given without --edit, expected both or neither")
    for field in fields:
        if arguments.edit is not None and field.several and field.stands_alone and field.name in given:
            what = "given with --edit, expected the sources of its recipe (--replace N=FILE takes another)"
            raise InputError(given[field.name][0], what)
    left, kept = set[str](), None
    if arguments.edit is not None and issubclass(kind, StageAction):
        left = set(kind.replaced(arguments))
        kept = read_kept(arguments.edit, kind, {*given, *left}, instead)
    values = {name: value for name, value in kept.values.items() if name not in left} if kept else {}
    for field in fields:
        if field.name in given:
            value = given[field.name]
            if field.is_read and field.parse and value:
                value = field.parse(value)
            old = values.get(field.name)
            if isinstance(old, Mapping) and isinstance(value, Mapping) and value:
                value = {**old, **value}  # a mapping adds to the old one; any other value replaces it
            values[field.name] = tuple(value) if isinstance(value, list) else value
    values = kind.line_values(arguments, values)
    for field in fields:
        if field.needed and field.name not in values:
            edit = " (or --edit RESULT)" if issubclass(kind, StageAction) else ""
            raise InputError(field.shown, f"none given, expected {field.help.split(';')[0]}{edit}")
    return kept, kind(**values)
