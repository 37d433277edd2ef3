"""What `facepipe register-scan` is asked for, checked before any work."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from facepipe.cli.parser import options_from, output_of, pairs, picture_of
from facepipe.core.errors import InputError
from facepipe.core.names import identifier
from facepipe.processors.rebuild.scan_input import landmark_file

if TYPE_CHECKING:
    from facepipe.pipeline.register_job import RegisterJob


class Request(NamedTuple):
    """A scan to register, and its picture."""

    job: RegisterJob
    picture: Path | None


def request_of(arguments: argparse.Namespace) -> Request:
    """The request in a command line.

    :raises InputError: files, names or weights that can't be
    """
    from facepipe.pipeline.register_job import RegisterJob
    from facepipe.processors.rebuild import RegisterScansOptions

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
    picture = None if arguments.picture is None else picture_of(arguments.picture, arguments, inputs, out)
    job = RegisterJob(
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
        flatten=arguments.flatten,
        options=options_from(arguments, RegisterScansOptions),
    )
    return Request(job, picture)


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
