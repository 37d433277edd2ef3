"""The actions that a server does for others, with ids of what it keeps in place of paths.

A source is the id of an upload, or ``{"face": ID, "version": N}``, where N is the newest by default; with ``"name"``
too what of that face is meant, where the action takes that. Files beside the result, and other paths, are not taken.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError
from facepipe.declare import Field, fields_of, from_json, schema_of
from facepipe.kinds import Action
from facepipe.registry import manifest, own_action
from facepipe.server.library import STAGE, Version
from facepipe.server.refusals import MissingError

_ID = re.compile(r"[0-9a-f]{24}")
_ANY = "face.usdc"  # stands for a file where fields are checked before there are any
_REFERENCE: Any = {
    "anyOf": [
        {"type": "string", "pattern": f"^{_ID.pattern}$", "description": "an upload"},
        {
            "type": "object",
            "properties": {"face": {"type": "string"}, "version": {"type": "integer"}, "name": {"type": "string"}},
            "required": ["face"],
            "additionalProperties": False,
        },
    ]
}


def verbs() -> list[str]:
    """Those of the remote actions; plug-ins have none."""
    return [verb for verb, one in manifest()["actions"].items() if one["remote"]]


def kind_of(verb: str) -> Any:
    """:raises MissingError: no such action, or none that is done for others"""
    if verb not in verbs():
        raise MissingError(verb[:60], "is no action here")
    return own_action(verb)


def taken(kind: type[Action[Any]]) -> Iterator[Field]:
    """The fields that others may give."""
    for one in fields_of(kind):
        if one.role == "source" or (one.role == "option" and Path not in one.kinds):
            yield one


def schema(verb: str) -> dict[str, Any]:
    """JSON schema of an action's fields, as they are sent."""
    kind = kind_of(verb)
    whole = schema_of(kind)
    given = {one.name: one for one in taken(kind)}
    properties = {name: said for name, said in whole["properties"].items() if name in given}
    for name, one in given.items():
        if one.role == "source":
            items = {"anyOf": [{"type": "string"}, *_REFERENCE["anyOf"]]} if one.split else _REFERENCE
            said = {"type": "array", "items": items} if one.several else items
            more: dict[str, Any] = {} if one.needed else {"default": [] if one.listed else None}
            properties[name] = {**said, **more, "description": one.help_text}
    return {**whole, "properties": properties}


@dataclass
class Given:
    """Fields as a job keeps them, and what they stand on."""

    fields: dict[str, Any]
    versions: list[Version] = field(default_factory=list)
    uploads: list[str] = field(default_factory=list)


def given(verb: str, fields: Mapping[str, Any], newest: Callable[[str], int]) -> Given:
    """Fields that were sent, checked.

    :param newest: the newest version of a face; raises MissingError
    :raises FacepipeError: no such action or face, or fields that it doesn't take
    """
    kind = kind_of(verb)
    known = {one.name: one for one in taken(kind)}
    found = Given({})

    def referred(one: Field, value: Any) -> Any:
        where = f"{verb} -> {one.name}"
        if isinstance(value, str) and _ID.fullmatch(value):
            found.uploads.append(value)
            return {"upload": value}
        if isinstance(value, str) and one.split is not None and one.split(value)[0] is None:
            return value
        if not isinstance(value, Mapping) or not {"face"} <= {*value} <= {"face", "version", "name"}:
            raise InputError(where, 'expected the id of an upload, or {"face": ID, "version": N}')
        face, version, name = value["face"], value.get("version"), value.get("name", "")
        if not isinstance(face, str) or not _ID.fullmatch(face):
            raise InputError(where, "is no id of a face")
        if not isinstance(name, str) or (name and one.split is None):
            raise InputError(where, "takes no name")
        latest = newest(face)
        version = latest if version is None else version
        if not isinstance(version, int) or isinstance(version, bool) or not 1 <= version <= latest:
            raise MissingError(face, "no such version")
        found.versions.append(Version(face, version))
        return {"face": face, "version": version, **({"name": name} if name else {})}

    for name, value in fields.items():
        if name not in known and any(name == one.name for one in fields_of(kind)):
            raise InputError(f"{verb} -> {name[:60]}", "is not taken from others")
        one = known.get(name)
        if one is None or one.role != "source" or value is None:
            found.fields[name] = value
        elif one.several and not isinstance(value, list):
            raise InputError(f"{verb} -> {name}", "expected a list")
        else:
            found.fields[name] = [referred(one, each) for each in value] if one.several else referred(one, value)
    from_json(kind, placed(verb, found.fields, lambda upload: f"{upload}/{_ANY}"), verb).check()
    return found


def placed(verb: str, fields: Mapping[str, Any], path_of: Callable[[str], str]) -> dict[str, Any]:
    """Fields of a job with paths where versions and uploads lie.

    :param path_of: an upload's
    """
    sources = {one.name for one in fields_of(kind_of(verb)) if one.role == "source"}

    def path(value: Any) -> Any:
        if isinstance(value, list):
            return [path(one) for one in value]
        if not isinstance(value, Mapping):
            return value
        if "upload" in value:
            return path_of(value["upload"])
        name = f":{value['name']}" if "name" in value else ""
        return f"{Version(value['face'], value['version']).folder}/{STAGE}{name}"

    return {name: path(value) if name in sources else value for name, value in fields.items()}


def standing_on(verb: str, fields: Mapping[str, Any]) -> tuple[list[Version], list[str]]:
    """The versions and uploads that a job's fields name."""
    versions: list[Version] = []
    uploads: list[str] = []
    sources = {one.name for one in fields_of(kind_of(verb)) if one.role == "source"}
    for name in sources & fields.keys():
        for one in fields[name] if isinstance(fields[name], list) else [fields[name]]:
            if isinstance(one, Mapping) and "upload" in one:
                uploads.append(one["upload"])
            elif isinstance(one, Mapping):
                versions.append(Version(one["face"], one["version"]))
    return list(dict.fromkeys(versions)), list(dict.fromkeys(uploads))
