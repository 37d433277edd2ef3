"""Author named landmarks on a face; OUT is an override layer over FACE.

The file holds a list of point indices, an object {"name": index}, or
{"scheme": "multipie68", "mesh": "Head", "indices": [...], "names": [...]}.

example: facepipe landmarks head.usda --from points.json -o head.landmarks.usda
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.cli.parser import add_output, output_of
from facepipe.cli.show import emit
from facepipe.errors import InputError

if TYPE_CHECKING:
    from facepipe.processors.landmarks import SetLandmarks


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    parser.add_argument("face", type=Path, metavar="FACE", help="face stage")
    parser.add_argument("--from", dest="source", type=Path, required=True, metavar="JSON", help="landmarks to author")
    add_output(parser, "override layer to write: .usda .usdc .usd .usdz")
    parser.add_argument("--scheme", help="name of the scheme (default: the file's, else multipie68)")
    parser.add_argument("--mesh", help="mesh they lie on (default: the file's, else the one with most points)")
    parser.add_argument("--flatten", action="store_true", help="write a standalone file")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Read the file, author the layer."""
    import facepipe

    out = output_of(arguments, [arguments.face, arguments.source])
    set_landmarks = read_landmarks(arguments.source, arguments.scheme, arguments.mesh)
    with facepipe.open(arguments.face).deriving(out, flatten=arguments.flatten) as face:
        report = set_landmarks(face)
    emit(report, f"{out}: {report.count} landmarks of {report.scheme} on {report.mesh}", as_json=arguments.json)
    return 0


def read_landmarks(path: Path, scheme: str | None, mesh: str | None) -> SetLandmarks:
    """The processor that a landmarks file describes.

    :raises InputError: no readable JSON of one of the three forms
    """
    from facepipe.processors.landmarks import SetLandmarks

    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(path, f"can't be read: {error.strerror}") from None
    except (ValueError, RecursionError):
        raise InputError(path, "no JSON, expected a list or an object of point indices") from None
    names: Any = ()
    if isinstance(content, dict) and "indices" in content:
        scheme, mesh = scheme or content.get("scheme"), mesh or content.get("mesh")
        content, names = content["indices"], content.get("names") or ()
    elif isinstance(content, dict):
        content, names = list(content.values()), tuple(content)
    whole = isinstance(content, list) and all(type(index) is int and abs(index) < 2**31 for index in content)
    if not whole or not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise InputError(path, "expected point indices: a list, an object {name: index}, or {indices, names, scheme}")
    return SetLandmarks(scheme=str(scheme or "multipie68"), mesh=mesh, indices=tuple(content), names=tuple(names))
