"""Author named landmarks on a face; OUT is an override layer over FACE.

The file holds a list of point indices, an object {"name": index}, {"scheme": ..., "indices": [...], "names": [...]},
or an object of several schemes, each a list or an object. A scheme without name is multipie68.

example: facepipe landmarks head.usda --from points.json -o head.landmarks.usda
"""

from __future__ import annotations

import argparse
from pathlib import Path

from facepipe.cli.parser import add_output, output_of
from facepipe.cli.show import emit


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
    from facepipe.pipeline.landmarks import LandmarkOptions, make

    out = output_of(arguments, [arguments.face, arguments.source])
    options = LandmarkOptions(scheme=arguments.scheme, mesh=arguments.mesh)
    report = make(arguments.face, arguments.source, out, options, flatten=arguments.flatten)
    result = {"path": str(out), "schemes": report.schemes, "mesh": report.mesh}
    lines = [f"{out}: {count} landmarks of {scheme} on {report.mesh}" for scheme, count in report.schemes.items()]
    emit(result, "\n".join(lines), as_json=arguments.json)
    return 0
