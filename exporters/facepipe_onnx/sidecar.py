"""The metadata of a graph as JSON: in the model and, the same, in a file beside it.

Top-level keys are stored as `metadata_props` ``facepipe.<key>``; the sidecar ``<model file>.json`` is an object of
them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError

PREFIX = "facepipe."


def path_of(model: Path) -> Path:
    """The sidecar of a model file."""
    return model.with_name(f"{model.name}.json")


def to_properties(metadata: dict[str, Any]) -> dict[str, str]:
    """Metadata as `metadata_props`."""
    return {PREFIX + key: json.dumps(metadata[key], sort_keys=True, allow_nan=False) for key in sorted(metadata)}


def from_properties(properties: dict[str, str]) -> dict[str, Any]:
    """Metadata out of `metadata_props`; keys of others are left out.

    :raises InputError: text that is no JSON
    """
    own = {key.removeprefix(PREFIX): text for key, text in properties.items() if key.startswith(PREFIX)}
    return {key: parse(text, f"metadata {PREFIX}{key}") for key, text in own.items()}


def to_text(metadata: dict[str, Any]) -> str:
    """Metadata as the sidecar's text."""
    return json.dumps(metadata, sort_keys=True, indent=1, allow_nan=False) + "\n"


def parse(text: str | bytes, where: object) -> Any:
    """JSON without NaN and infinity.

    :raises InputError: it is not that
    """

    def refuse(word: str) -> Any:
        raise ValueError(f"number {word}")

    try:
        return json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise InputError(where, f"no valid JSON ({error})") from error
