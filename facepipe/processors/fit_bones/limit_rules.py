"""Limits of bones as a field of an action: read from a file on the command line, whole in recipes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.declare import JsonValue

if TYPE_CHECKING:
    from facepipe.processors.fit_bones.limits import LimitRules


def read_rules(path: Path) -> LimitRules:
    """The limits in a file."""
    from facepipe.processors.fit_bones.limits import read_limits

    return read_limits(path)


def _load_rules(content: object, where: str) -> LimitRules | None:
    from facepipe.processors.fit_bones.limits import limits_from_json

    return None if content is None else limits_from_json(content, where)


RULES = JsonValue(lambda rules: None if rules is None else rules.to_json(), _load_rules)
