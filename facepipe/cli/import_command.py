"""Make a face stage of a real face: facepipe import KIND SOURCE OUT.

examples:
  facepipe import ict ../shared/data/ict_facekit/ict_facekit.npz ict.usdc --identity-seed 7
  facepipe import makehuman makehuman_head.npz mh.usda --targets nose/nose-scale-horiz-incr=0.5
  facepipe import obj shapes/ face.usdc
  facepipe import gltf head.glb head.usda
  facepipe import usd others.usd face.usda
"""

from __future__ import annotations

import argparse
from pathlib import Path

from facepipe.cli.parser import add_options, add_output, options_from, output_of
from facepipe.cli.show import progress, warn


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments, and the options of the kind in `words`; of all kinds for --help."""
    from facepipe.importers import IMPORTERS, importer

    parser.add_argument("kind", choices=sorted(IMPORTERS), metavar="KIND", help=" ".join(sorted(IMPORTERS)))
    parser.add_argument("source", type=Path, metavar="SOURCE", help="file or folder to read")
    add_output(parser, "face stage to write: .usda .usdc .usd .usdz", positional=True)
    named = [word for word in words if not word.startswith("-") and word in IMPORTERS][:1]
    for kind in named or IMPORTERS:
        add_options(parser, importer(kind).Options, f"options of {kind}")


def run(arguments: argparse.Namespace) -> int:
    """Read, author, save."""
    from facepipe.importers import importer, load
    from facepipe.stage import save_parts
    from facepipe.stage.files import check_suffix

    out = output_of(arguments, [arguments.source])
    check_suffix(out)
    options = options_from(arguments, importer(arguments.kind).Options)
    with progress("import", 2) as bar:
        imported = load(arguments.kind, arguments.source, options)
        bar.update()
        save_parts(imported.parts, out)
        bar.update()
    warn(imported.warnings)
    print(out)
    return 0
