"""`facepipe regions`: the action; without a map, the list of regions."""

from __future__ import annotations

import argparse
import dataclasses
from typing import TYPE_CHECKING, Any

from facepipe.cli.action_line import ActionLine
from facepipe.cli.parser import output_of
from facepipe.cli.show import emit
from facepipe.core.errors import InputError
from facepipe.verbs.regions import AuthorRegions

if TYPE_CHECKING:
    from facepipe.verbs.regions import RegionCount

_LINE = ActionLine(AuthorRegions)
__doc__ = _LINE.__doc__  # of --help
configure = _LINE.configure


def run(arguments: argparse.Namespace) -> int:
    """List, or author the layer."""
    if arguments.edit is not None or hasattr(arguments, "map"):
        return _LINE.run(arguments)
    for name in ("legend", "output", "mesh", "uv_set"):
        if getattr(arguments, name, None) is not None:
            raise InputError(f"--{name.replace('_', '-')}", "given without --map, expected both or neither")
    if arguments.face is None:
        raise InputError("FACE", "none given, expected a face stage")
    picture = getattr(arguments, "picture", None)
    if picture is not None:
        output_of(argparse.Namespace(output=picture, force=arguments.force), [arguments.face])
        if picture.suffix.lower() != ".png":
            raise InputError(picture, f"suffix '{picture.suffix}', expected .png")
    import facepipe
    from facepipe.parts import all_regions
    from facepipe.verbs.regions import count_regions, draw_regions, region_table

    face = facepipe.read(arguments.face)
    whole = count_regions(all_regions(face.meshes))
    if picture is not None:
        draw_regions(face, picture)
    result = {
        "face": face.where,
        "points": sum(len(mesh.points) for mesh in face.meshes),
        "regions": _plain(whole),
        "meshes": {mesh.name: _plain(count_regions(mesh.regions)) for mesh in face.meshes},
        "picture": str(picture) if picture else None,
    }
    lines = [region_table(whole) if whole else f"{face.where}: no regions", *([str(picture)] if picture else [])]
    emit(result, "\n".join(lines), as_json=arguments.json)
    return 0


def _plain(regions: dict[str, RegionCount]) -> dict[str, Any]:
    return {name: dataclasses.asdict(one) for name, one in regions.items()}
