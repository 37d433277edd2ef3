"""Make a face stage from a file of another program: facepipe import KIND SOURCE OUT.

examples:
  facepipe import ict ../shared/data/ict_facekit/ict_facekit.npz ict.usdc --identity-seed 7
  facepipe import makehuman makehuman_head.npz mh.usda --targets nose/nose-scale-horiz-incr=0.5
  facepipe import obj shapes/ face.usdc
  facepipe import gltf head.glb head.usdc
  facepipe import fbx head.fbx head.usdc
  facepipe import usd others.usd face.usda
  facepipe import gltf avatar.glb face.usda --rename arkit
"""

from __future__ import annotations

import argparse
from pathlib import Path

from facepipe.cli.parser import add_options, add_output, add_rename, options_from, output_of
from facepipe.cli.show import note, noted_names, progress, warn


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments, and the options of the kind in `words`; of all kinds for --help."""
    from facepipe.importers import kinds, options_of

    known = kinds()  # looks through all that is installed
    parser.add_argument("kind", choices=known, metavar="KIND", help=" ".join(known))
    parser.add_argument("source", type=Path, metavar="SOURCE", help="file or folder to read")
    add_output(parser, "face stage to write: .usda .usdc .usd .usdz", positional=True)
    add_rename(parser, words)
    named = [word for word in words if not word.startswith("-") and word in known][:1]
    for kind in named or known:
        add_options(parser, options_of(kind), f"options of {kind}")


def run(arguments: argparse.Namespace) -> int:
    """Read, author, save."""
    from facepipe.importers import load, options_of
    from facepipe.importers.rename_table import rename_of
    from facepipe.rig.conventions import convention_of, convention_text, shapes_of
    from facepipe.stage import save_parts
    from facepipe.stage.files import check_suffix

    out = output_of(arguments, [arguments.source])
    check_suffix(out)
    options = options_from(arguments, options_of(arguments.kind))
    rename = None if arguments.rename is None else rename_of(arguments.rename)
    with progress("import", 2) as bar:
        imported = load(arguments.kind, arguments.source, options)
        bar.update()
        renamed = None if rename is None else rename(imported.parts)
        parts = imported.parts if renamed is None else renamed.parts
        save_parts(parts, out)
        bar.update()
    warn((*imported.warnings, *(renamed.warnings if renamed else ())))
    noted_names(arguments.rename, renamed.names if renamed else {})
    found = convention_of(parts.shapes, shapes_of(parts.meshes))
    if found is not None and (not found["exact"] or found["arkit"]):
        note(f"shapes: {convention_text(found)}")
    print(out)
    return 0
