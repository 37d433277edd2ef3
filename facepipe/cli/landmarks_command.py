"""Author named landmarks on a face; OUT is an override layer over FACE.

The file holds a list of point indices, an object {"name": index}, {"scheme": ..., "indices": [...], "names": [...]},
or an object of several schemes, each a list or an object. A scheme without name is multipie68.

example: facepipe landmarks head.usda --from points.json -o head.landmarks.usda
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import add_output, output_of
from facepipe.cli.show import emit
from facepipe.errors import InputError

if TYPE_CHECKING:
    from facepipe.parts import Recipe


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    parser.add_argument("face", type=Path, metavar="FACE", help="face stage")
    parser.add_argument("--from", dest="source", type=Path, required=True, metavar="JSON", help="landmarks to author")
    add_output(parser, "override layer to write: .usda .usdc .usd .usdz")
    parser.add_argument("--scheme", help="name of the scheme, where the file holds one (default: the file's)")
    parser.add_argument("--mesh", help="mesh they lie on (default: the one with most points)")
    parser.add_argument("--flatten", action="store_true", help="write a standalone file")
    parser.add_argument("--json", action="store_true", help="print what was authored as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Read the file, author the layer."""
    import facepipe
    from facepipe.importers.landmark_file import read_landmarks
    from facepipe.processors.landmarks import SetLandmarks, mesh_of
    from facepipe.stage.author_skeleton import author_recipe

    out = output_of(arguments, [arguments.face, arguments.source])
    source = facepipe.open(arguments.face)
    schemes = read_landmarks(arguments.source, len(mesh_of(source, arguments.mesh).points))
    if arguments.scheme and len(schemes) > 1:
        raise InputError(arguments.source, f"{len(schemes)} schemes, expected one where --scheme names it")
    with source.deriving(out, flatten=arguments.flatten) as face:
        reports = [
            SetLandmarks(scheme=arguments.scheme or scheme, landmarks=landmarks, mesh=arguments.mesh)(face)
            for scheme, landmarks in schemes.items()
        ]
        author_recipe(face.prim, _recipe(arguments, out))
    result = {"path": str(out), "schemes": {one.scheme: one.count for one in reports}, "mesh": reports[0].mesh}
    lines = [f"{out}: {one.count} landmarks of {one.scheme} on {one.mesh}" for one in reports]
    emit(result, "\n".join(lines), as_json=arguments.json)
    return 0


def _recipe(arguments: argparse.Namespace, out: Path) -> Recipe:
    from facepipe import __version__
    from facepipe.digests import digest
    from facepipe.parts import Recipe
    from facepipe.stage.files import relative_path

    sources = (arguments.face, arguments.source)
    return Recipe(
        verb="landmarks",
        sources=tuple(relative_path(str(source), out.parent) for source in sources),
        digests=tuple(digest([source]) for source in sources),
        options={"scheme": arguments.scheme, "mesh": arguments.mesh},
        version=__version__,
    )
