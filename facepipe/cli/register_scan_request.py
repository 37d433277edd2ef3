"""What `facepipe register-scan` is asked for, checked before any work."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.cli.parser import output_of, pairs, picture_of
from facepipe.cli.scan_input import landmark_file
from facepipe.errors import InputError
from facepipe.names import identifier

if TYPE_CHECKING:
    from facepipe.parts import Recipe
    from facepipe.processors.rebuild import ScanFit


@dataclass(frozen=True, kw_only=True)
class Request:
    """Files, names and weights."""

    scan: Path
    landmarks: Path | None  # None: to be found on the scan
    personal: Path
    neutral_scan: Path | None
    neutral_landmarks: Path | None
    neutral_weights: Mapping[str, float]  # what it shows besides, as they were given
    name: str  # of the shape
    weights: Mapping[str, float]  # as they were given
    said_by: str  # the flag that gave them, for messages
    out: Path
    picture: Path | None
    flatten: bool

    def resolved(self, shapes: Sequence[str]) -> dict[str, float]:
        """The weights by the names of the face's shapes.

        :raises InputError: a shape that the face has not, or the expression's own name is one that it has
        """
        from facepipe.processors.rebuild import resolved

        if self.name in shapes:
            raise InputError(f"{self.personal} -> {self.name}", "the face has such a shape, expected another --name")
        return resolved(self.weights, shapes, self.said_by)

    def recipe(self, options: Any, given: Mapping[str, float], found: Mapping[str, float], fit: ScanFit) -> Recipe:
        """The recipe to author on the result.

        :param given: `resolved` weights
        :param found: the weights that the scan shows
        :raises InputError: a source that can't be read
        """
        from facepipe.options import json_value, to_json
        from facepipe.processors.rebuild.expression_file import VERB
        from facepipe.processors.rebuild.stage_recipe import stage_recipe

        files = {
            "personal": self.personal,
            "scan": self.scan,
            "landmarks": self.landmarks,
            "neutral_scan": self.neutral_scan,
            "neutral_landmarks": self.neutral_landmarks,
        }
        content = {
            "name": self.name,
            "weights": dict(given),
            "found": dict(found),
            "fit": json_value(dataclasses.asdict(fit)),
            "options": to_json(options),
        }
        content |= {"neutral_weights": dict(self.neutral_weights)} if self.neutral_weights else {}
        return stage_recipe(VERB, {what: file for what, file in files.items() if file is not None}, self.out, content)


def request_of(arguments: argparse.Namespace) -> Request:
    """The request in a command line.

    :raises InputError: files, names or weights that can't be
    """
    marks = landmark_file(arguments.scan, arguments.landmarks)
    neutral = arguments.neutral_scan
    for flag in ("neutral_landmarks", "neutral_weights"):
        if neutral is None and getattr(arguments, flag) is not None:
            raise InputError(f"--{flag.replace('_', '-')}", "expected --neutral-scan beside it")
    neutral_marks = None if neutral is None else landmark_file(neutral, arguments.neutral_landmarks)
    given = (arguments.scan, marks, arguments.personal, neutral, neutral_marks)
    inputs = [one for one in given if one is not None]
    out = output_of(arguments, inputs)
    weights, said_by = _weights(arguments)
    return Request(
        scan=arguments.scan,
        landmarks=marks,
        personal=arguments.personal,
        neutral_scan=neutral,
        neutral_landmarks=neutral_marks,
        neutral_weights=pairs(arguments.neutral_weights or [], "--neutral-weights"),
        name=_name(arguments),
        weights=weights,
        said_by=said_by,
        out=out,
        picture=None if arguments.picture is None else picture_of(arguments.picture, arguments, inputs, out),
        flatten=arguments.flatten,
    )


def _name(arguments: argparse.Namespace) -> str:
    if arguments.name is None:
        return identifier(arguments.scan.stem)
    name = str(arguments.name)
    if name != identifier(name):
        raise InputError(f"--name {name}", "expected letters, digits and underscores, no digit first")
    return name


def _weights(arguments: argparse.Namespace) -> tuple[dict[str, float], str]:
    from facepipe.processors.rebuild import DEFAULT_COMPOSITES

    if arguments.weights:
        return pairs(arguments.weights, "--weights"), "--weights"
    name = arguments.composite or arguments.scan.stem
    if name not in DEFAULT_COMPOSITES:
        known = ", ".join(DEFAULT_COMPOSITES)
        where = f"--composite {name}" if arguments.composite else str(arguments.scan)
        raise InputError(where, f"no composite of that name, expected --weights, or --composite with one of {known}")
    return dict(DEFAULT_COMPOSITES[name]), f"composite {name}"
