"""JSON schemas of actions: they admit what recipes hold, and nothing that a recipe's reader refuses."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from facepipe.actions import find_action, summaries
from facepipe.core.errors import InputError
from facepipe.declare import Field, fields_of, option, schema_of
from facepipe.kinds import FOUND, StageAction
from facepipe.performing import recipe_to
from facepipe.scanning.rebuild import RegisterScansOptions

# a source of any action; `rebuild` alone reads it
_PROJECT = 'template = "smile.toml"\ndatabase = "smile.toml"\n[neutral]\nscan = "smile.toml"\n'
# JSON of all types; what a field's range and choices add comes to them
_ANY = (None, True, False, 0, 1, 5, -1, 0.5, 1e12, "", "auto", [], ["a"], [1, 9], [1.5], {}, {"a": 1.5}, {"a": "b"})


def action_of(verb: str) -> type[StageAction[Any]]:
    kind = find_action(verb)
    assert kind is not None
    return kind


@pytest.mark.parametrize("verb", summaries())
def test_what_a_recipe_holds_is_valid(verb: str, tmp_path: Path) -> None:
    kind = action_of(verb)
    file = tmp_path / "smile.toml"
    file.write_text(_PROJECT)
    needed = {field.name: (str(file),) if field.several else file for field in fields_of(kind) if field.needed}
    options = dict(recipe_to(kind(**needed), tmp_path / "out.usda").options)
    options.pop(FOUND, None)
    schema = schema_of(kind)
    Draft202012Validator.check_schema(schema)
    found = json.loads(json.dumps(options))
    Draft202012Validator(schema).validate(found)
    defaults = {name: one["default"] for name, one in schema["properties"].items() if "default" in one}
    Draft202012Validator(schema).validate({**defaults, **found})
    assert {*defaults} | {*needed} == {*schema["properties"]}

    for name in needed:
        assert not Draft202012Validator(schema).is_valid({key: found[key] for key in found if key != name})
    assert not Draft202012Validator(schema).is_valid({**found, "unknown": 1})


@dataclass(frozen=True, kw_only=True)
class Lists:
    """Ranges and choices of what is in lists and objects; the kinds of our actions have few."""

    sizes: tuple[float, ...] = option((), "sizes", 0.0, 1.5)
    sides: tuple[str, ...] = option((), "sides", choices=("a", "b"))
    weights: Mapping[str, float] = option(dict, "weights", 0.0, 1.0)
    steps: tuple[int, ...] | None = option(None, "steps", 1, 5)


@pytest.mark.parametrize("kind", [*map(find_action, summaries()), Lists], ids=[*summaries(), "lists"])
def test_values_are_valid_that_a_recipe_can_have(kind: type[Any]) -> None:
    schema, tried = schema_of(kind), 0
    for field in fields_of(kind):
        validator = Draft202012Validator(schema["properties"][field.name])
        for value in candidates(field):
            assert validator.is_valid(value) == admits(field, value), (field.name, value)
            tried += 1
    assert tried >= 5


def candidates(one: Field) -> list[Any]:
    """JSON to try on a field: nothing on those that read their values in a way of their own."""
    if one.role != "option":
        return ["head.usda", 5, 0.5, True, {"a": "b"}]
    if one.value is not None:
        return []
    ends = [] if one.low is None or one.high is None else [one.low, one.high, one.low - 1, one.high + 1]
    whole = int in one.kinds
    return [*_ANY, *one.choices, *[int(end) if whole else end for end in ends]]


def admits(one: Field, value: Any) -> bool:
    """Whether a recipe can hold it."""
    if one.role != "option":
        return isinstance(value, str) and not one.several
    try:
        one.check(one.load(value, "recipe"))
    except InputError:
        return False
    return True


def test_options_are_checked_when_they_are_made() -> None:
    with pytest.raises(InputError, match=r"option reach_mm: is 0\.0, expected a number from 0\.1 to 1000"):
        RegisterScansOptions(reach_mm=0.0)
