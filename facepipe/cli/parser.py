"""Arguments: one-line usage errors with the nearest right word, flags from option dataclasses, output files."""

from __future__ import annotations

import argparse
import dataclasses
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean
from facepipe.declare import Field, fields_of


class Parser(argparse.ArgumentParser):
    """argparse with errors of one line, texts kept as written, and the flags that every command has.

    :param common: with those flags: how much is printed, and what files of others may do
    """

    def __init__(self, *, common: bool = True, **settings: Any) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, **settings)
        # a word that begins as a number below 0 does is a value: -0.5,1.5 too
        self._negative_number_matcher = re.compile(r"-\.?\d")
        self.intermixed = False  # whether words without a flag may stand between flags; else they stand in one run
        if common:
            group = self.add_argument_group("what is printed").add_mutually_exclusive_group()
            given: Any = {"action": "store_const", "dest": "loudness", "default": argparse.SUPPRESS}
            group.add_argument(
                "-v", "--verbose", const="verbose", help="also debug lines with times, on stderr", **given
            )
            quiet = (
                "nothing on stderr but errors: no progress, no notes, no warnings (they are in the report of --json)"
            )
            group.add_argument("-q", "--quiet", const="quiet", help=quiet, **given)
            # nothing where none is given: an action's parser would hide what stands before the action
            given = {"default": argparse.SUPPRESS}
            others = self.add_argument_group("files of others")
            roots = (
                "folder that files may be written to and copied from; may be given again (default FACEPIPE_ROOTS, else "
                "the nearest folder with a facepipe.toml, else the folder of the file); for batch also "
                "s3://BUCKET/FOLDER"
            )
            others.add_argument("--root", action="append", metavar="DIR", help=roots, **given)
            models = "load models that can run code (.pt2)"
            others.add_argument("--trust-models", action="store_true", help=models, **given)

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse does; of a word that no command knows the error has the nearest flag."""
        parsed, others = self.parse_known_args(args, namespace)
        if others:
            flags = [other.partition("=")[0] for other in others if other.startswith("-")]
            groups = [action for action in self._actions if isinstance(action, argparse._SubParsersAction)]
            below = [parser for group in groups for parser in group.choices.values()]
            known = [flag for parser in (self, *below) for flag in parser._option_string_actions]
            near = did_you_mean(flags[0], [flag for flag in known if flag.startswith("--")]) if flags else ""
            self.error(f"unrecognized arguments: {' '.join(others)}{near}")
        return parsed

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """:raises argparse.ArgumentError: `value` is no choice of the action; with the nearest one"""
        if action.choices is not None and value not in action.choices:
            choices = [str(choice) for choice in action.choices]
            near = did_you_mean(str(value), choices) or f" (choose from {', '.join(choices)})"
            raise argparse.ArgumentError(action, f"invalid choice: {value!r}{near}")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse does, and words of parsers that are `intermixed` in any place."""
        if not self.intermixed:
            return super().parse_known_args(args, namespace)
        self.intermixed = False  # what follows calls this again
        try:
            return self.parse_known_intermixed_args(args, namespace)
        finally:
            self.intermixed = True

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with 2."""
        print(f"{self.prog}: {message} (`{self.prog} --help` shows how)", file=sys.stderr)
        raise SystemExit(2)


def add_options(
    parser: argparse.ArgumentParser | argparse._ArgumentGroup,
    options: type,
    title: str | None = None,
    *,
    prefix: str = "",
    sparse: bool = False,
) -> None:
    """A flag for every field of a frozen option dataclass; flags already there are shared.

    :param prefix: before the name of each
    :param sparse: arguments hold only the flags that were given, and what is on can be turned off
    """
    group = parser.add_argument_group(title) if title else parser
    for field in fields_of(options):
        name = prefix + field.name
        flag = f"--{name.replace('_', '-')}" if prefix else field.shown
        if flag in parser._option_string_actions:
            continue
        settings = _settings(field)
        if field.several and field.parse is None:
            settings |= _again(field, settings)
        if sparse:
            settings["default"] = argparse.SUPPRESS
            if settings.get("action") == "store_true":
                settings["action"] = argparse.BooleanOptionalAction
        group.add_argument(flag, dest=name, **settings)


def add_field(parser: argparse.ArgumentParser | argparse._ArgumentGroup, field: Field) -> None:
    """The argument of an action's field: it is there only where it is given; what is on can be turned off."""
    absent: dict[str, Any] = {"dest": field.name, "default": argparse.SUPPRESS}
    if field.stands_alone:
        place: dict[str, Any] = {"nargs": "*", "default": ()} if field.several else {"nargs": "?"}
        kind = Path if Path in field.kinds else field.word_kind
        parser.add_argument(field.name, type=kind, metavar=field.shown, help=field.help.replace("%", "%%"), **place)
        return
    settings = {**_settings(field), **absent}
    if settings.get("action") == "store_true":
        settings["action"] = argparse.BooleanOptionalAction
    if field.is_read:
        settings["type"] = Path
    if field.alone is not None:
        settings |= {"nargs": "?", "const": field.alone}
    if field.words > 1:
        settings |= {"nargs": field.words, "metavar": tuple(field.metavar.split())}
    elif field.several:
        settings |= _again(field, settings)
        settings |= {"nargs": "+"} if field.words else {}
    parser.add_argument(field.shown, **settings)
    if field.default in (None, (), {}) and field.kept and not isinstance(field.default, bool):
        nothing = f"--no-{field.shown.removeprefix('--')}"
        hidden: dict[str, Any] = {**absent, "help": argparse.SUPPRESS}
        parser.add_argument(nothing, action="store_const", const=field.default, **hidden)


def _again(field: Field, settings: dict[str, Any]) -> dict[str, Any]:
    """Settings of a flag that is given again."""
    told = f"{settings['help']}; may be given again"
    return {"action": _Several, "type": field.word_kind, "field": field, "help": told}


class _Several(argparse.Action):
    """Words of a flag that is given again, as the field has them."""

    def __init__(self, *, field: Field, **settings: Any) -> None:
        super().__init__(**settings)
        self._field, self._words = field, list[Any]()

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option: str | None = None) -> None:
        if not getattr(namespace, self.dest, None):  # none so far, or taken away
            self._words = []
        self._words += values if isinstance(values, list) else [values]
        try:
            setattr(namespace, self.dest, (self._field.parse or tuple)(self._words))
        except InputError as error:
            raise InputError(f"{option} {error.where}", error.what) from None


def _settings(field: Field) -> dict[str, Any]:
    unsaid = field.needed or field.value is not None or isinstance(field.default, bool)
    unsaid = unsaid or field.default in (None, "", (), {})
    shown = "" if unsaid else f" (default {field.default})"
    settings: dict[str, Any] = {"default": field.default, "help": f"{field.help_text}{shown}".replace("%", "%%")}
    if field.kinds == (bool,) or field.kinds == (bool, type(None)):
        return {"action": argparse.BooleanOptionalAction if field.default is not False else "store_true", **settings}
    if field.choices:
        settings["choices"] = field.choices
    else:
        settings["metavar"] = field.metavar or field.name.upper()
    plain: type = next((kind for kind in field.kinds if kind in (int, float, Path)), str)
    kind: Any = field.parse or (type(field.choices[0]) if field.choices else plain)

    # `kind` as argparse calls it: errors of ours keep their words
    def read(text: str) -> Any:
        try:
            return kind(text)
        except InputError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    read.__name__ = getattr(kind, "__name__", "value")
    return {"type": read, **settings}


def options_from(arguments: argparse.Namespace, options: type) -> Any:
    """An instance of the option dataclass from parsed flags; of flags that are not there the default."""
    names = [field.name for field in dataclasses.fields(options)]
    return options(**{name: getattr(arguments, name) for name in names if hasattr(arguments, name)})


def add_output(parser: argparse.ArgumentParser, help: str, *, positional: bool = False) -> None:
    """`-o OUT` and `--force`; with `positional` OUT may also stand alone."""
    if positional:
        parser.add_argument("out", nargs="?", type=Path, metavar="OUT", help=help)
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", required=not positional, help=help)
    parser.add_argument("--force", action="store_true", help="overwrite OUT where it exists")


def output_of(arguments: argparse.Namespace, inputs: Sequence[Path] = ()) -> Path:
    """The output path, checked before any work; leftovers of a killed run beside it are cleaned up first.

    :raises InputError: none given, an existing file without --force, a missing folder, or an input
    """
    from facepipe.stage.files import check_output

    path = arguments.output or getattr(arguments, "out", None)
    if path is None:
        raise InputError("OUT", "no output file, expected one as OUT or -o OUT")
    check_output(Path(path), inputs, overwrite=arguments.force)
    return Path(path)


def output_or_edited(arguments: argparse.Namespace, inputs: Sequence[Path]) -> Path:
    """The output path, else the result that `--edit` names; checked before any work.

    :raises InputError: as `output_of`
    """
    edited: Path | None = arguments.edit
    if edited is None and arguments.output is None:
        raise InputError("OUT", "no output file, expected -o OUT")
    if edited is None or arguments.output is not None:
        return output_of(arguments, [*inputs, *([edited] if edited else [])])
    if not arguments.force:
        raise InputError(edited, "would be written again, expected --force (or -o OUT)")
    return output_of(argparse.Namespace(output=edited, force=True), inputs)


def name_or_file(text: str) -> str:
    """The type of an argument that names something, or with a suffix a file."""
    return text


def holds_paths(argument: argparse.Action) -> bool:
    """Whether values of an argument are paths, or can be."""
    return getattr(argument.type, "__name__", "") in (Path.__name__, name_or_file.__name__)


def names_file(argument: argparse.Action, value: str) -> bool:
    """Whether a value of an argument is a path."""
    plain = getattr(argument.type, "__name__", "") == name_or_file.__name__ and not Path(value).suffix
    return holds_paths(argument) and not plain


def add_rename(parser: argparse.ArgumentParser, words: Sequence[str]) -> None:
    """`--rename NAMES|FILE`; the list of conventions is loaded for --help alone."""
    kinds = ""
    if {"-h", "--help"} & {*words}:
        from facepipe.rig.conventions import CONVENTIONS

        kinds = " ".join(CONVENTIONS)
    parser.add_argument(
        "--rename",
        type=name_or_file,
        metavar="NAMES",
        help=f"other names of shapes, in clips and sliders too: {kinds}; or a table of shapes and joints, a .json "
        "({old: new}) or .csv (old,new)",
    )
