"""List the regions of a face; with --map author them from a picture painted over its UV layout.

The map is a PNG, the legend a JSON object {"#ff0000": "eyes", ...} or {"regions": {"eyes": "#ff0000", ...}}. Beside the
colours a legend may have "outside": the region of points that the map does not cover (without it they keep the regions
they have), "meshes": {"Eye*": "eyes"}: regions of other meshes, whole, and "background": a colour that means unpainted.
A map covers the UV tile 0 to 1 unless --tile says otherwise. OUT is an override layer over FACE.

examples:
  facepipe regions head.usda --picture regions.png
  facepipe regions head.usda --map map.png --legend legend.json -o head.regions.usda
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.cli.parser import add_options, options_from, output_of, picture_of
from facepipe.cli.show import emit, warn
from facepipe.core.errors import InputError
from facepipe.core.texts import table

if TYPE_CHECKING:
    from PIL.Image import Image

    from facepipe.processors.regions import RegionCount, RegionsReport
    from facepipe.stage import Face


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.geometry.map_sampling import MapSampling

    parser.add_argument("face", type=Path, metavar="FACE", help="face stage")
    parser.add_argument("--map", type=Path, metavar="PNG", help="regions painted over the UV layout, a colour each")
    parser.add_argument("--legend", type=Path, metavar="JSON", help="which colour is which region")
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help="override layer to write, with --map")
    parser.add_argument("--force", action="store_true", help="overwrite OUT and the picture where they exist")
    parser.add_argument("--mesh", metavar="NAMES", help="meshes the map covers, globs (default: that of most points)")
    parser.add_argument("--uv-set", metavar="NAME", help="UV set that it was painted over (default: st, or the first)")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="draw the regions on the face")
    parser.add_argument("--flatten", action="store_true", help="write a standalone file")
    parser.add_argument("--json", action="store_true", help="print what there is or was authored as JSON")
    add_options(parser, MapSampling, "lookup")


def run(arguments: argparse.Namespace) -> int:
    """List, or read map and legend and author the layer."""
    import facepipe

    if arguments.map is None:
        for flag in ("legend", "output", "mesh", "uv_set"):
            if getattr(arguments, flag) is not None:
                raise InputError(f"--{flag.replace('_', '-')}", "given without --map, expected both or neither")
        picture = _picture_path(arguments, [arguments.face])
        return _list(facepipe.open(arguments.face), arguments, picture)
    if arguments.legend is None:
        raise InputError("--legend", "none given, expected a JSON file with --map")
    inputs = [arguments.face, arguments.map, arguments.legend]
    out = output_of(arguments, inputs)
    return _author(arguments, out, _picture_path(arguments, inputs, out))


def _picture_path(arguments: argparse.Namespace, inputs: list[Path], out: Path | None = None) -> Path | None:
    return None if arguments.picture is None else picture_of(arguments.picture, arguments, inputs, out)


def _list(face: Face, arguments: argparse.Namespace, picture: Path | None) -> int:
    from facepipe.parts import all_regions
    from facepipe.processors.regions import count_regions

    whole = count_regions(all_regions(face.meshes))
    if picture is not None:
        _save(_draw(face), picture)
    result = {
        "face": face.where,
        "points": sum(len(mesh.points) for mesh in face.meshes),
        "regions": _plain(whole),
        "meshes": {mesh.name: _plain(count_regions(mesh.regions)) for mesh in face.meshes},
        "picture": str(picture) if picture else None,
    }
    lines = [_table(whole) if whole else f"{face.where}: no regions", *([str(picture)] if picture else [])]
    emit(result, "\n".join(lines), as_json=arguments.json)
    return 0


def _author(arguments: argparse.Namespace, out: Path, picture: Path | None) -> int:
    from facepipe.core.atomic import together
    from facepipe.geometry.map_sampling import MapSampling
    from facepipe.pipeline.regions import RegionJob, RegionPlace, make

    job = RegionJob(
        face=arguments.face,
        map=arguments.map,
        legend=arguments.legend,
        out=out,
        place=RegionPlace(mesh=arguments.mesh, uv_set=arguments.uv_set),
        sampling=options_from(arguments, MapSampling),
        flatten=arguments.flatten,
    )
    images: list[Image] = []

    def seen(face: Face) -> None:
        if picture is not None:
            images.append(_draw(face))

    with together(out):
        report = make(job, seen)
        if images and picture is not None:
            _save(images[0], picture)
    warn(report.warnings)
    result = {"path": str(out), "picture": str(picture) if picture else None, **dataclasses.asdict(report)}
    emit(result, _text(out, picture, report), as_json=arguments.json)
    return 0


def _draw(face: Face) -> Image:
    from facepipe.pictures import PictureOptions, RegionColors, picture

    parts = face.parts()
    return picture(parts, face.evaluate(), PictureOptions(regions=RegionColors.of(parts)))


def _save(image: Image, path: Path) -> None:
    from facepipe.pictures import save_png

    save_png(image, path)


def _text(out: Path, picture: Path | None, report: RegionsReport) -> str:
    lines = []
    for one in report.meshes:
        facts = [f"{one.points} points"]
        facts += [f"{count} {what}" for count, what in ((one.outside, "outside the map"), (one.kept, "kept")) if count]
        if not one.covered:
            facts += [f"all in {name}" for name, count in one.regions.items() if count.points]
        facts += [f"removed: {', '.join(one.removed)}"] if one.removed and one.covered else []
        lines += [f"{out} -> {one.mesh}: {', '.join(facts)}", *([_table(one.regions)] if one.covered else [])]
    return "\n".join([*lines, *([str(picture)] if picture else [])])


def _table(regions: Any) -> str:
    rows = [[name, one.points, one.most, f"{one.share * 100:.1f}%"] for name, one in regions.items()]
    return table([["region", "points", "most of", "share"], *rows])


def _plain(regions: dict[str, RegionCount]) -> dict[str, Any]:
    return {name: dataclasses.asdict(one) for name, one in regions.items()}
