"""Actions performed: a face stage made of its sources, with the recipe that makes it again."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from facepipe.core import __version__
from facepipe.core.atomic import apart, replacing, replacing_folder, together
from facepipe.core.errors import FacepipeError, InputError, SchemaError
from facepipe.core.locks import locked
from facepipe.core.reports import Report, Watch, unwatched
from facepipe.declare import Field, fields_of, json_value
from facepipe.importers import read_face
from facepipe.kinds import FOUND, Action, FileAction, FolderAction, Job, StageAction
from facepipe.parts import Recipe
from facepipe.registry import exporter, outputs, suffixes
from facepipe.stage import Face, open_face, save_parts
from facepipe.stage.files import SUFFIXES, check_output, check_report_folder, relative_path
from facepipe.stage.recipes import changed_sources, existing_source, named_source, recipe_of, source_digest

R = TypeVar("R", bound=Report)


@dataclass(frozen=True, kw_only=True)
class Performed:
    """What was written beside a result, and its entries in the JSON."""

    report: Report
    beside: Mapping[str, Any]  # field -> its path, or what its writer returned


def perform(
    action: Action[Any],
    out: Path,
    *,
    flatten: bool = False,
    watch: Watch = unwatched,
    waiting: Callable[[], object] = lambda: None,
) -> Performed:
    """Do an action; the result and what is asked for beside it are written whole, or nothing is.

    :param out: for a stage one, or a file that an exporter writes, with its defaults
    :param flatten: write a standalone stage; so is one over a file that is imported
    :param waiting: called once where another process changes the file that the action changes alone
    :raises FacepipeError: what can't be read, done or written
    """
    action.check()
    alone = isinstance(action, FileAction) and action.alone
    with locked(out, waiting=waiting) if alone else nullcontext(), together(out), ExitStack() as files:
        temporary = {
            one: (path, files.enter_context((replacing if one.suffix else replacing_folder)(path)))
            for one, path in _beside(action)
        }
        if isinstance(action, StageAction):
            return _staged(action, out, files, temporary, flatten=flatten, watch=watch)
        assert isinstance(action, FileAction)
        report = action.write(job_of(action, out, watch))
        return Performed(report=report, beside=_written(action, (report,), temporary))


Temporary = Mapping[Field, tuple[Path, Path]]  # what is asked for beside the result: its path, and where it is first


def _staged(
    action: StageAction[Any], out: Path, files: ExitStack, temporary: Temporary, *, flatten: bool, watch: Watch
) -> Performed:
    job = job_of(action, out, watch)
    base, standalone = files.enter_context(_opened(action))
    stage, exported = out, out.suffix.lower() not in SUFFIXES
    if exported:
        stage = Path(files.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))) / f"{out.stem}.usdc"
        files.enter_context(apart())  # the stage is exported before the rest takes its place
    with base.deriving(stage, flatten=flatten or standalone or exported) as face:
        try:
            report = action.author(face, job)
        except FacepipeError as error:  # of the layer that is being made, which has no file yet: its source is named
            first = error.where.partition(" -> ")[0]
            is_prim = first.startswith("<") or (first.startswith("/") and not Path(first).suffix)
            raise error.under(action.base) if is_prim and first != str(action.base) else error from None
        results = _written(action, (Face(face.stage, face.prim), report), temporary)
    warnings = (*base.warnings, *report.warnings)
    if exported:
        module = exporter(out)
        known = {field.name for field in fields_of(module.Options)}
        options = {name: value for name, value in action.exported.items() if name in known}
        export = module.export(open_face(stage), out, module.Options(**options))
        results["export"], warnings = export.to_dict(), (*warnings, *export.warnings)
    return Performed(report=replace(report, warnings=warnings), beside=results)


def _written(action: Action[Any], made: tuple[Any, ...], temporary: Temporary) -> dict[str, Any]:
    """Write what is asked for beside a result; its entries in the JSON."""
    results: dict[str, Any] = {}
    for field, (path, place) in temporary.items():
        try:
            written = getattr(action, field.write)(*made, place)
        except InputError as error:  # about the temporary file: about the one that it is for
            raise (InputError(path, error.what) if str(place) in error.where else error) from None
        results[field.name] = str(path) if written is None else {**written, "path": str(path)}
    return results


def check_result(action: Action[Any], out: Path, inputs: Sequence[Path], *, overwrite: bool) -> None:
    """Check before any work that a result can have a name, what is written with it and beside it, and a folder itself.

    :raises InputError: a suffix that it can't have, or a file or folder that may not be written
    """
    if isinstance(action, FolderAction):
        known = re.compile(action.holds)
        check_report_folder(out, overwrite=overwrite, taken=inputs, known=known, command=action.verb)
    suffix = out.suffix.lower()
    if isinstance(action, FileAction):
        if suffix not in action.suffixes and not isinstance(action, FolderAction):
            raise InputError(out, f"suffix '{out.suffix}', expected {' '.join(action.suffixes)}")
        written = action.with_it(out)
    else:
        exported = [f".{one}" for one in suffixes()]
        if suffix not in (*SUFFIXES, *exported):
            raise InputError(out, f"suffix '{suffix}', expected one of {' '.join((*SUFFIXES, *exported))}")
        written = outputs(out) if suffix in exported else ()
    for one in written:
        if one != out:
            check_output(one, inputs, overwrite=overwrite)
    for field, path in _beside(action):
        if not field.suffix:
            taken, known = [*inputs, out], re.compile(field.holds)
            check_report_folder(path, overwrite=overwrite, taken=taken, known=known, command=action.verb)
            continue
        check_output(path, inputs, overwrite=overwrite)
        if path.suffix.lower() != field.suffix:
            raise InputError(path, f"suffix '{path.suffix}', expected {field.suffix}")
        if path.absolute() == out.absolute():
            raise InputError(path, "is the output too, expected another file")


@contextmanager
def _opened(action: StageAction[Any]) -> Iterator[tuple[Face, bool]]:
    """The face to put a layer over, and whether its file can't be that layer's: it is imported, or made."""
    path, made_base = action.base, action.made_base()
    if isinstance(made_base, Face):
        yield made_base, False
        return
    if made_base is None:
        if path.suffix.lower() in SUFFIXES:
            yield open_face(path), False
            return
        face = read_face(path)
        made_base = face.parts(), face.warnings
    parts, warnings = made_base
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        made = Path(folder) / f"{path.stem or 'face'}.usdc"  # the working folder, ".", has no name
        with apart():
            save_parts(parts, made)
        del parts, made_base  # 60 MB of the built-in head, while the action works
        opened = open_face(made)
        opened.warnings = warnings
        yield opened, True


def job_of(action: Action[Any], out: Path, watch: Watch = unwatched) -> Job:
    """What `action` is given to make `out`."""

    def recipe(changed: Action[Any] = action, /, **found: Any) -> Recipe:
        return recipe_to(changed, out, **found)

    return Job(out=out, watch=watch, recipe=recipe)


def _beside(action: Action[Any]) -> Iterator[tuple[Field, Path]]:
    for field in fields_of(type(action)):
        if field.role == "beside" and getattr(action, field.name) is not None:
            yield field, Path(getattr(action, field.name))


def files_of(action: Action[Any], *, kept: bool = False) -> tuple[Path, ...]:
    """The files that an action reads, each once, in the order of its fields.

    :param kept: those alone that its recipe names
    """
    sources = [one for one in fields_of(type(action)) if one.role == "source" and (one.kept or not kept)]
    values = [(one, getattr(action, one.name)) for one in sources]
    own = (Path(file) for one, value in values if value is not None for file, _ in _named(one, value))
    return tuple(dict.fromkeys((*own, *action.further_files)))


def _named(one: Field, value: Any) -> Iterator[tuple[str, str]]:
    """The files that the value of a source names, each with what its word says besides."""
    for word in value if isinstance(value, tuple) else (value,):
        file, rest = (os.fspath(word), "") if one.split is None else one.split(word)
        if file is not None:
            yield file, rest


def recipe_to(action: Action[Any], out: str | os.PathLike[str], **found: Any) -> Recipe:
    """The recipe to author on what an action makes as `out`: its fields as JSON, files as seen from that folder.

    A digest covers every USD layer that its source stands on.

    :param found: what else is to be kept
    :raises InputError: a source can't be read
    """
    folder = Path(out).absolute().parent
    options = {}
    for field in fields_of(type(action)):
        value = getattr(action, field.name)
        # what a recipe without the option means is left out of it: one of before is made again to the same bytes
        if field.kept and (field.before is ... or value != field.before):
            options[field.name] = _seen_from(folder, field, value) if field.role == "source" else field.dump(value)
    files = {relative_path(str(file), folder): file for file in files_of(action, kept=True)}
    return Recipe(
        verb=action.verb,
        sources=tuple(files),
        digests=tuple(source_digest(file) for file in files.values()),
        options={**options, **({FOUND: json_value(found)} if found else {})},
        version=__version__,
    )


def _seen_from(folder: Path, one: Field, value: Any) -> Any:
    def word(value: Any) -> str:
        file, rest = (os.fspath(value), "") if one.split is None else one.split(value)
        return str(value) if file is None else relative_path(file, folder) + (f":{rest}" if rest else "")

    return [word(each) for each in value] if isinstance(value, tuple) else None if value is None else word(value)


@dataclass(frozen=True, kw_only=True)
class Kept:
    """A recipe read back."""

    values: Mapping[str, Any]  # field of the action -> its value; files absolute
    standalone: bool  # the result was saved without reference to its base
    warnings: tuple[str, ...] = ()  # sources that have changed since, one line each


def read_kept(
    path: str | os.PathLike[str],
    kind: type[StageAction[Any]],
    replaced: Collection[str] = (),
    instead: Mapping[int, Path] | None = None,
) -> Kept:
    """The recipe on the face that an action made; its other layers may be lost.

    :param replaced: fields that the caller has others for: their files may be lost or changed
    :param instead: number of a source, from 1 -> the file that takes its place
    :raises InputError: no recipe of the action, a source that is not where it was, or no such number in `instead`
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    file = Path(path)
    recipe, standalone = recipe_of(file, kind.verb)
    where, fields = f"{file} -> recipe", {field.name: field for field in fields_of(kind) if field.kept}
    try:
        values = _values(recipe.options, fields, where)
    except InputError as error:
        raise SchemaError(error.where, error.what) from None
    places = _places(file, recipe, fields, {**values, **dict.fromkeys(replaced)}, instead or {})
    for name, one in fields.items():
        if one.role == "source" and name not in replaced and values.get(name) is not None:
            values[name] = _found_at(places, one, values[name])
    digests = enumerate(zip(recipe.sources, recipe.digests, strict=True), 1)
    old = [
        (places[one], digest) for number, (one, digest) in digests if one in places and number not in (instead or {})
    ]
    return Kept(values=values, standalone=standalone, warnings=changed_sources(file, old))


def _places(
    file: Path, recipe: Recipe, fields: Mapping[str, Field], values: Mapping[str, Any], instead: Mapping[int, Path]
) -> dict[str, Path]:
    """Source of a recipe -> the file that it is, of those that `values` name."""
    where, numbers = f"{file} -> recipe", {source: number for number, source in enumerate(recipe.sources, 1)}
    if len(numbers) != len(recipe.sources):
        raise SchemaError(where, "names a source twice, expected each once")
    for number in instead:
        if not 1 <= number <= len(recipe.sources):
            what = f"no such source, expected a number from 1 to {len(recipe.sources)}"
            raise InputError(f"--replace {number}", what)
    places: dict[str, Path] = {}
    for name, field in fields.items():
        words = () if field.role != "source" or values.get(name) is None else _named(field, values[name])
        for source, _ in words:
            if source not in numbers:
                raise SchemaError(f"{where} -> {name}", f"{source[:60]}, expected one of the sources")
            number = numbers[source]
            path = instead.get(number) or named_source(f"{where} -> source {number}", source, file.absolute())
            given_as = "--replace" if field.several and field.stands_alone else field.shown
            places[source] = existing_source(f"{where} -> source {number}", path, given_as)
    return places


def _values(options: Mapping[str, Any], fields: Mapping[str, Field], where: str) -> dict[str, Any]:
    if not isinstance(options, Mapping):
        raise InputError(where, "options are damaged, expected an object")
    values = {}
    for name, value in options.items():
        if name not in fields:
            if name != FOUND:
                raise InputError(where, f"option '{str(name)[:60]}' is unknown, expected some of {', '.join(fields)}")
            continue
        field = fields[name]
        words = value if field.several else [value]
        if field.role != "source":
            values[name] = field.load(value, where)
            try:
                field.check(values[name])
            except InputError as error:
                raise error.under(where) from None
        elif value is None and field.default is None:
            values[name] = None
        elif not isinstance(words, list) or not all(isinstance(word, str) for word in words):
            raise InputError(f"{where} -> {field.name}", f"{str(value)[:40]}, expected the names of sources")
        else:
            values[name] = tuple(words) if field.several else words[0]
    for name, field in fields.items():
        if name not in values and field.before is not ...:
            values[name] = field.before
    missing = [field.name for field in fields.values() if field.needed and field.name not in values]
    if missing:
        raise InputError(where, f"no '{missing[0]}', expected one")
    return values


def _found_at(places: Mapping[str, Path], field: Field, value: Any) -> Any:
    """The value of a source with files where they were found."""

    def at(word: str) -> Any:
        if field.split is None:
            return places[word]
        file, rest = field.split(word)
        return word if file is None else f"{places[file]}:{rest}" if rest else str(places[file])

    return tuple(at(word) for word in value) if isinstance(value, tuple) else at(value)


def again(path: Path, kind: type[StageAction[Any]], watch: Watch = unwatched) -> tuple[Report, bool]:
    """Do the action of the recipe on the face at `path` again in its place: the report, and whether a check was missed.

    :raises FacepipeError: a recipe or sources that can't be read or used
    """
    kept = read_kept(path, kind)
    action = kind(**kept.values)
    report = perform(action, path, flatten=kept.standalone, watch=watch).report
    return report, action.missed(report)
