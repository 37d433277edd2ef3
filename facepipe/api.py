"""The public functions: read, sample, and one for each action, made of its declaration."""

from __future__ import annotations

import functools
import importlib
import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.names import did_you_mean
from facepipe.declare import Field, fields_of

if TYPE_CHECKING:
    from facepipe.core.reports import Report
    from facepipe.kinds import Action
    from facepipe.stage import Face

AnyPath = str | os.PathLike[str]


def read(path: AnyPath, kind: str | None = None, **options: Any) -> Face:
    """The face of any file: USD as it stands, else imported into memory; `warnings` of the face list what is lost.

    :param kind: of `facepipe import`, for files of one suffix that may be of several (ict, makehuman, folders of obj)
    :param options: of that kind, like ``identity_seed=7``
    :raises FacepipeError: no such file or importer, or a file that can't be read
    """
    from facepipe.stage.face import open_face
    from facepipe.stage.files import SUFFIXES

    if kind is None and not options and Path(path).suffix.lower() in SUFFIXES:
        return open_face(path)
    from facepipe.importers import kind_of, options_of, read_face

    kind = kind or kind_of(Path(path))
    return read_face(Path(path), kind, options_of(kind)(**options))


def sample(
    out: AnyPath | None = None,
    *,
    seed: int = 0,
    textures: int = 2048,
    age: float | None = None,
    feminine: float | None = None,
    overwrite: bool = False,
) -> Face:
    """The built-in head: one topology, a different person for every seed.

    :param out: a stage to save it as; None: it is in memory
    :param textures: texels a side of the skin's textures; 0: colours at points, and no hair
    :param age: years, 18 to 80; None: as the seed draws it
    :param feminine: 0 a man, 1 a woman; None: as the seed draws it
    :raises InputError: a seed below 0, an age or `feminine` out of range, or a file that can't be written
    """
    from facepipe.heads import make
    from facepipe.stage import Face, open_face, save_parts
    from facepipe.stage.files import check_output

    if out is not None:
        check_output(Path(out), (), overwrite=overwrite)
    parts = make(seed, textures=textures, age=age, feminine=feminine)
    if out is None:
        return Face.from_parts(parts)
    save_parts(parts, out)
    return open_face(out)


def given(name: str) -> Callable[..., Any] | None:
    """A function of a wing, or that of an action, `fit_bones` of `facepipe fit-bones`; None where there is none.

    :raises AttributeError: it is that of a plug-in that can't be used
    """
    from facepipe.actions import find_action, verb_of
    from facepipe.core.errors import InputError
    from facepipe.registry import manifest

    if name in manifest()["functions"]:
        module, _, function = manifest()["functions"][name].partition(":")
        found: Callable[..., Any] = getattr(importlib.import_module(module), function)
        return found
    verb = verb_of(name)
    try:
        kind: Any = None if verb is None else find_action(verb)
    except InputError as error:
        raise AttributeError(f"facepipe.{name}: {error}") from None
    return None if kind is None else function_of(kind)


def names() -> tuple[str, ...]:
    """The functions of all actions, and those that wings have beside."""
    from facepipe.actions import function_name, summaries
    from facepipe.registry import manifest

    return (*manifest()["functions"], *map(function_name, summaries()))


@functools.cache
def function_of(kind: type[Action[Any]]) -> Callable[..., Report]:
    """The function of an action, with its signature and docstring."""
    from facepipe.actions import function_name
    from facepipe.core.reports import unwatched
    from facepipe.kinds import FolderAction, InPlaceAction, Inspector

    fields = fields_of(kind)
    keywords = _own(kind)
    parameters = []
    for field in sorted(fields, key=lambda field: (not field.stands_alone, not field.needed)):
        way = inspect.Parameter.POSITIONAL_OR_KEYWORD if field.stands_alone else inspect.Parameter.KEYWORD_ONLY
        default = inspect.Parameter.empty if field.needed else field.default
        parameters.append(inspect.Parameter(field.name, way, default=default))
    keyword = inspect.Parameter.KEYWORD_ONLY
    own = [inspect.Parameter(name, keyword, default=default) for name, (default, _) in keywords.items()]
    alone = [parameter for parameter in parameters if parameter.kind is not keyword]
    signature = inspect.Signature([*alone, *own, *(parameter for parameter in parameters if parameter.kind is keyword)])

    def function(*files: Any, **named: Any) -> Report:
        from facepipe.performing import check_result, files_of, perform
        from facepipe.stage.files import check_output

        try:
            values = dict(signature.bind(*files, **named).arguments)
        except TypeError as error:  # as Python says it, with the parameter that is most like an unknown one
            wrong = next((one for one in named if one not in signature.parameters), None)
            near = "" if wrong is None else did_you_mean(wrong, signature.parameters)
            raise TypeError(f"facepipe.{function_name(kind.verb)}() {error}{near}") from None
        action = kind(**{field.name: _value(field, values[field.name]) for field in fields if field.name in values})
        if isinstance(action, Inspector):
            action.check()
            report: Report = action.look(unwatched)
            return report
        given_out, overwrite = values.get("out"), values.get("overwrite", False)
        if given_out is None and isinstance(action, InPlaceAction):
            check_result(action, action.base, (), overwrite=True)
            return perform(action, action.base).report
        out, read = (
            Path(str(given_out)),
            [values[field.name] for field in fields if field.is_read and field.name in values],
        )
        inputs = [*files_of(action), *(Path(one) for one in read if isinstance(one, str | os.PathLike))]
        if not isinstance(action, FolderAction):
            check_output(out, inputs, overwrite=overwrite)
        check_result(action, out, inputs, overwrite=overwrite)
        return perform(action, out, flatten=values.get("flatten", False)).report

    function.__name__ = function.__qualname__ = function_name(kind.verb)
    lines = [f"{kind.summary[0].upper()}{kind.summary[1:]}: `facepipe {kind.verb}`.", ""]
    lines += [f":param {field.name}: {field.help_text}" for field in fields]
    lines += [f":param {name}: {said}" for name, (_, said) in keywords.items()]
    function.__doc__ = "\n".join(
        [*lines, ":raises FacepipeError: what can't be read, done or written; then nothing is written"]
    )
    said: Any = function
    said.__signature__ = signature
    return function


def _own(kind: type[Action[Any]]) -> dict[str, tuple[Any, str]]:
    """Parameters of its function that are no fields, with their defaults and what they are."""
    from facepipe.kinds import FileAction, InPlaceAction, Inspector, StageAction

    if issubclass(kind, Inspector):
        return {}
    result = kind.output if issubclass(kind, FileAction) else "stage to write, or a file that an exporter writes"
    default = None if issubclass(kind, InPlaceAction) else inspect.Parameter.empty
    own = {"out": (default, result), "overwrite": (False, "put it in place of a file that is there")}
    return {**own, "flatten": (False, "write a standalone file")} if issubclass(kind, StageAction) else own


def _value(field: Field, value: Any) -> Any:
    """A value as the action has it: paths of names, and what JSON or a file would say."""
    if value is None:
        return None
    if field.is_read and field.parse is not None and isinstance(value, str | os.PathLike):
        return field.parse(Path(value))
    if field.listed and isinstance(value, str | os.PathLike):
        value = (value,)  # one of several
    if field.value is not None and isinstance(value, Mapping):
        return field.value.load(value, field.name)
    if field.role == "option":
        return tuple(value) if isinstance(value, Sequence) and not isinstance(value, str) else value
    path = os.fspath if field.split is not None else Path  # a word that names a file stays one
    return tuple(map(path, value)) if field.several else path(value)
