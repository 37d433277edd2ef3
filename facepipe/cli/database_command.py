"""Databases of faces on one topology: what people's faces and expressions differ in.

create makes a database of two or more face stages; add puts more into it, in place and whole or not at all (-o writes
another file); remove takes faces out of it by their names; info tells what is in one. Changes of one database wait for
each other. It holds a model of neutrals (principal components) and one of expressions (a multilinear model) of the
blendshapes that all faces have that have any; others are listed as left out.

add refuses a rebuilt face whose measures, in its recipe or in a report given by --quality, miss the limits below. A
report is a JSON object, alone or under "quality": {"surface_mean_mm": 0.1, "surface_p95_mm": 0.4, "coverage": 0.9,
"flipped_triangles": 0}.

examples:
  facepipe database create faces/*.usda -o faces.fpdb
  facepipe database add faces.fpdb actor.usda
  facepipe database add faces.fpdb actor.usda --quality report.json -o more.fpdb
  facepipe database remove faces.fpdb actor
  facepipe database info faces.fpdb --json
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.cli.database_text import as_json, as_text
from facepipe.cli.parser import Parser, add_options, add_output, options_from, output_of
from facepipe.cli.show import emit, progress, warn
from facepipe.core.errors import InputError
from facepipe.core.locks import locked

if TYPE_CHECKING:
    from facepipe.processors.database import AddOptions, FaceDatabase, Quality
    from facepipe.processors.database.stage_sources import StageSource

_MOST_REPORT = 1 << 26  # bytes of a report


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments of each action."""
    from facepipe.processors.database import AddOptions, DatabaseOptions

    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=Parser)
    create = actions.add_parser("create", help="make a database of face stages", epilog=_example("create"))
    _add_faces(create)
    add_output(create, "database to write: .fpdb")
    add_options(create, DatabaseOptions)
    add = actions.add_parser("add", help="put more faces into a database", epilog=_example("add"))
    _add_database(add)
    _add_faces(add)
    text = "measures of a face: a JSON report, with several faces NAME=REPORT, once for each"
    add.add_argument("--quality", action="append", default=[], metavar="REPORT", help=text)
    add_options(add, AddOptions, "quality gate")
    remove = actions.add_parser("remove", help="take faces out of a database", epilog=_example("remove"))
    _add_database(remove)
    remove.add_argument("names", nargs="+", metavar="NAME", help="names of faces, as info tells them")
    info = actions.add_parser("info", help="tell what is in a database", epilog=_example("info"))
    info.add_argument("database", type=Path, metavar="DATABASE", help="database: .fpdb")
    for one in (create, add, remove, info):
        one.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Do the action."""
    actions: dict[str, Callable[[argparse.Namespace], int]] = {
        "create": _create,
        "add": _add,
        "remove": _remove,
        "info": _info,
    }
    return actions[arguments.action](arguments)


def _example(action: str) -> str:
    lines = [line.strip() for line in (__doc__ or "").splitlines() if f"facepipe database {action}" in line]
    return f"example: {lines[0]}"


def _add_database(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("database", type=Path, metavar="DATABASE", help="database: .fpdb")
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help="write another file (default: in place)")
    parser.add_argument("--force", action="store_true", help="overwrite OUT where it exists")


def _add_faces(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("faces", nargs="+", type=Path, metavar="FACE", help="face stages of one topology")
    parser.add_argument("--names", metavar="A,B,...", help="names of the faces (default: those of their files)")


def _create(arguments: argparse.Namespace) -> int:
    from facepipe.processors.database import DatabaseOptions, check_suffix, create_database, save_database

    out = check_suffix(output_of(arguments, arguments.faces))
    sources = _sources(arguments, None)
    with _progress("create", sources) as bar:
        made = create_database(sources, options_from(arguments, DatabaseOptions), done=bar.update)
    with _alone(out):
        save_database(made.database, out)
    return _told(out, made.database, made.warnings, arguments)


def _add(arguments: argparse.Namespace) -> int:
    from facepipe.processors.database import AddOptions, add_faces, check_suffix, load_database, save_database

    out = check_suffix(_output(arguments))
    with _alone(out):  # from reading on: what another adds meanwhile would be lost
        database = load_database(arguments.database)
        sources = _sources(arguments, database)
        options = options_from(arguments, AddOptions)
        qualities = _qualities(arguments, sources, options)
        with _progress("add", sources) as bar:
            made = add_faces(database, sources, options, qualities=qualities, done=bar.update)
        save_database(made.database, out)
    return _told(out, made.database, made.warnings, arguments)


def _remove(arguments: argparse.Namespace) -> int:
    from facepipe.processors.database import check_suffix, load_database, remove_faces, save_database

    out = check_suffix(_output(arguments))
    with _alone(out):
        made = remove_faces(load_database(arguments.database), arguments.names, str(arguments.database))
        save_database(made.database, out)
    return _told(out, made.database, made.warnings, arguments)


def _info(arguments: argparse.Namespace) -> int:
    from facepipe.processors.database import load_database

    return _told(arguments.database, load_database(arguments.database), (), arguments)


def _output(arguments: argparse.Namespace) -> Path:
    """Where to write: in place, unless said otherwise."""
    from facepipe.core.atomic import collect

    if arguments.output is None:
        collect(arguments.database.parent)
        return Path(arguments.database)
    return output_of(arguments, [arguments.database, *getattr(arguments, "faces", [])])


def _alone(path: Path) -> AbstractContextManager[None]:
    """Nobody else changes the file; waits for who does."""
    return locked(path, waiting=lambda: warn([f"{path}: another process changes it, waiting"]))


def _sources(arguments: argparse.Namespace, database: FaceDatabase | None) -> list[StageSource]:
    from facepipe.processors.database.stage_sources import stage_sources

    names = [name.strip() for name in arguments.names.split(",")] if arguments.names else []
    return stage_sources(arguments.faces, names, database, str(getattr(arguments, "database", "")))


def _qualities(
    arguments: argparse.Namespace, sources: Sequence[StageSource], options: AddOptions
) -> dict[str, Quality]:
    """Face name -> its measures, from reports and recipes."""
    from facepipe.core.reading import read_json
    from facepipe.processors.database import quality_from

    found: dict[str, Quality] = {}
    for word in arguments.quality:
        name, equals, path = word.partition("=")
        if not equals and len(sources) != 1:
            raise InputError(f"--quality {word}", f"{len(sources)} faces, expected NAME=REPORT")
        name, path = (name, path) if equals else (sources[0].name, word)
        if name in found:
            raise InputError(f"--quality {word}", f"a report of '{name}' twice, expected one")
        found[name] = quality_from(read_json(Path(path), _MOST_REPORT), path)
    for source in sources:
        if source.name not in found:
            try:
                own = source.quality()
            except InputError:
                if not options.ignore_quality:
                    raise
                own = None
            found |= {} if own is None else {source.name: own}
    return found


def _progress(label: str, sources: Sequence[StageSource]) -> AbstractContextManager[Any]:
    return progress(label, 2 * len(sources))


def _told(path: Path, database: FaceDatabase, warnings: Sequence[str], arguments: argparse.Namespace) -> int:
    warn(warnings)
    result = {**as_json(path, database), "warnings": list(warnings)}
    emit(result, as_text(path, database), as_json=arguments.json)
    return 0
