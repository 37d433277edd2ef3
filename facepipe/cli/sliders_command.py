"""List the sliders of a face, author them from a table, make them from its blendshapes, or set them.

--from authors the sliders of a .toml or .csv table: what each drives, by how much, its range, default, group and the
slider of the other side. Sliders of the same names are replaced; with --replace the table's are all that the face has.

--from-shapes makes sliders that move the bones as the face's blendshapes move it, all or those of PATTERNS
(names, comma between). Two that differ in the last word alone (nose_hump_decr, nose_hump_incr) are the ends of a slider
from -1 to 1, others go from 0 to 1; shapes of the left and the right get mirrored poses. What bones reach is told, in
millimetres. Exit code 1: done, but sliders were left out whose bones reach less than --least-reach.

--from-network puts a learned network beside the sliders: from the values of some it adds to bone coefficients and shape
weights. The .npz file holds sliders, outputs (joint:channel or shape:NAME), layer0.weight, layer0.bias and so on.

--set writes slider values and poses the face: a SkelAnimation of all that its sliders drive, which the skeleton plays.
Sliders that are not named keep their values. Exit code 1: done, but the pose is beyond the bone limits of FACE.

OUT is an override layer over FACE.

examples:
  facepipe sliders head.usda
  facepipe sliders head.usda --from table.toml -o controls.usda
  facepipe sliders head.usda --from-shapes 'nose_*,mouth_*' --limits face_bones.json -o controls.usda
  facepipe sliders head.usda --from-network learned.npz -o learned.usda
  facepipe sliders head.usda --set noseWidth=0.8 --set browArchLeft=1 --mirror -o person.usda
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.cli.parser import named, output_of, pairs
from facepipe.cli.show import emit, progress, warn
from facepipe.cli.sliders_from_network import listed, network_json, network_text
from facepipe.cli.sliders_from_shapes import add_shape_options, as_text, limit_files, maker_of, shape_flags
from facepipe.core.errors import InputError
from facepipe.core.texts import table

if TYPE_CHECKING:
    from facepipe.parts import Curve, Recipe, Slider
    from facepipe.processors.sliders import (
        AuthorNetwork,
        AuthorNetworkReport,
        AuthorSliders,
        AuthorSlidersReport,
        SetSliders,
        SetSlidersReport,
    )

_SHOWN = 4  # of what a slider drives


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    parser.add_argument("face", type=Path, metavar="FACE", help="face stage")
    parser.add_argument("--from", dest="source", type=Path, metavar="TABLE", help="sliders to author: .toml or .csv")
    made = "sliders to make of blendshapes, all or those of these names"
    parser.add_argument("--from-shapes", nargs="?", const="*", metavar="PATTERNS", help=made)
    text = "learned network to put beside the sliders: .npz"
    parser.add_argument("--from-network", type=Path, metavar="NPZ", help=text)
    replacing = "with --from and --from-shapes: drop the sliders that FACE has"
    parser.add_argument("--replace", action="store_true", help=replacing)
    setting = "slider value; may be given again"
    parser.add_argument("--set", action="append", default=[], metavar="SLIDER=VALUE", help=setting)
    parser.add_argument("--mirror", action="store_true", help="with --set: also the slider of the other side")
    parser.add_argument("--reset", action="store_true", help="all other sliders to their defaults")
    parser.add_argument("--name", default="sliders", help="name of the pose (default sliders)")
    output = "override layer to write: .usda .usdc .usd .usdz"
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help=output)
    parser.add_argument("--force", action="store_true", help="overwrite OUT where it exists")
    parser.add_argument("--flatten", action="store_true", help="write a standalone file")
    parser.add_argument("--json", action="store_true", help="print JSON")
    add_shape_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """List, author or set."""
    sets = bool(arguments.set or arguments.reset)
    makes, authors = arguments.from_shapes is not None, arguments.source is not None
    learns = arguments.from_network is not None
    every_way = (("--from", authors), ("--from-shapes", makes), ("--from-network", learns), (_setting(arguments), sets))
    ways = [name for name, on in every_way if on]
    if len(ways) > 1:
        raise InputError(ways[0], f"given with {ways[1]}, expected only one of them")
    every = ("--from, --from-shapes, --from-network or --set", bool(ways))
    for flag, (needed, there) in {
        "--replace": ("--from or --from-shapes", authors or makes),
        "--mirror": ("--set", bool(arguments.set)),
        "-o": every,
        "--flatten": every,
        **dict.fromkeys(shape_flags(arguments), ("--from-shapes", makes)),
    }.items():
        given = arguments.output is not None if flag == "-o" else getattr(arguments, flag.lstrip("-"), True)
        if given and not there:
            raise InputError(flag, f"given without {needed}, expected both or neither")
    if authors:
        return _author(arguments)
    if makes:
        return _make(arguments)
    if learns:
        return _learn(arguments)
    return _set(arguments) if sets else _list(arguments)


def _setting(arguments: argparse.Namespace) -> str:
    return "--set" if arguments.set else "--reset"


def _make(arguments: argparse.Namespace) -> int:
    from facepipe.pipeline.sliders import make

    out = _output(arguments, [arguments.face, *limit_files(arguments)])
    report = make(arguments.face, out, maker_of(arguments), progress, flatten=arguments.flatten)
    warn(report.warnings)
    emit({"path": str(out), **dataclasses.asdict(report)}, as_text(out, report), as_json=arguments.json)
    return 1 if report.left_out else 0


def _list(arguments: argparse.Namespace) -> int:
    import facepipe

    face = facepipe.open(arguments.face)
    sliders = face.sliders
    groups: dict[str, list[Slider]] = {}
    for slider in sliders:
        groups.setdefault(slider.group, []).append(slider)
    rows = [row for group in sorted(groups) for row in _rows(group, groups[group])]
    lines = [f"{arguments.face}: {len(sliders)} sliders in {len(groups)} groups", *([table(rows)] if rows else [])]
    lines += [listed(face.slider_network)] if face.slider_network else []
    network = None if face.slider_network is None else network_json(face.slider_network)
    result = {"path": str(arguments.face), "sliders": [_json(one) for one in sliders], "network": network}
    emit(result, "\n".join(lines), as_json=arguments.json)
    return 0


def _rows(group: str, sliders: list[Slider]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [(group or "(no group)",)]
    for one in sliders:
        value = "" if one.value is None or one.value == one.default else f"= {one.value:g}"
        span = f"{one.minimum:g} to {one.maximum:g}, {one.default:g}"
        rows.append((f"  {one.name}", span, value, _driven(one), f"mirror {one.mirror}" if one.mirror else ""))
    return rows


def _driven(slider: Slider) -> str:
    from facepipe.rig.sliders import channel_entries, shape_entries

    texts = [
        f"{joint.rpartition('/')[2]}:{channel} {gain:g}{_bent(curve)}"
        for (joint, channel, gain), curve in channel_entries(slider)
    ]
    texts += [f"{shape} {gain:g}{_bent(curve)}" for (shape, gain), curve in shape_entries(slider)]
    more = f" ... ({len(texts)} in all)" if len(texts) > _SHOWN else ""
    return ", ".join(texts[:_SHOWN]) + more


def _bent(curve: Curve | None) -> str:
    return "" if curve is None else f" x curve of {len(curve)}"


def _json(slider: Slider) -> dict[str, Any]:
    from facepipe.rig.sliders import channel_entries, shape_entries

    return {
        "name": slider.name,
        "group": slider.group,
        "range": [slider.minimum, slider.maximum],
        "default": slider.default,
        "value": slider.default if slider.value is None else slider.value,
        "mirror": slider.mirror,
        "channels": [
            {"joint": joint, "channel": channel, "gain": gain, "curve": curve}
            for (joint, channel, gain), curve in channel_entries(slider)
        ],
        "shapes": [{"shape": shape, "gain": gain, "curve": curve} for (shape, gain), curve in shape_entries(slider)],
    }


def _author(arguments: argparse.Namespace) -> int:
    from facepipe.processors.sliders import AuthorSliders, read_table, slider_recipe

    out = _output(arguments, [arguments.face, arguments.source])
    author = AuthorSliders(table=read_table(arguments.source), drop=arguments.replace)
    recipe = slider_recipe(arguments.face, out, table=arguments.source, drop=arguments.replace)
    report: AuthorSlidersReport = _derive(arguments, out, author, recipe)
    kept = f", {len(report.replaced)} of them replaced" if report.replaced else ""
    text = f"{out}: {len(report.sliders)} sliders{kept}, over {report.channels} channels and {report.shapes} shapes"
    text += f", {len(report.dropped)} dropped" if report.dropped else ""
    emit({"path": str(out), **dataclasses.asdict(report)}, text, as_json=arguments.json)
    return 0


def _learn(arguments: argparse.Namespace) -> int:
    import facepipe
    from facepipe.pipeline.sliders import network_author
    from facepipe.processors.sliders import slider_recipe

    out = _output(arguments, [arguments.face, arguments.from_network])
    author = network_author(facepipe.open(arguments.face), arguments.from_network)
    recipe = slider_recipe(arguments.face, out, network=arguments.from_network)
    report: AuthorNetworkReport = _derive(arguments, out, author, recipe)
    emit({"path": str(out), **dataclasses.asdict(report)}, network_text(out, report), as_json=arguments.json)
    return 0


def _set(arguments: argparse.Namespace) -> int:
    import facepipe
    from facepipe.processors.sliders import SetSliders, slider_recipe

    out = _output(arguments, [arguments.face])
    known = [one.name for one in facepipe.open(arguments.face).sliders]
    values = named(pairs(arguments.set, "--set"), known, "--set", "slider")
    settings = SetSliders(values=values, mirror=arguments.mirror, reset=arguments.reset, name=arguments.name)
    report: SetSlidersReport = _derive(arguments, out, settings, slider_recipe(arguments.face, out, settings=settings))
    what = ", ".join(f"{name} {value:g}" for name, value in report.values.items()) or "all at their defaults"
    text = f"{out}: {what}: {report.joints} joints off rest, {report.shapes} shapes on"
    emit({"path": str(out), **dataclasses.asdict(report)}, text, as_json=arguments.json)
    return 1 if report.beyond_limits else 0


def _output(arguments: argparse.Namespace, inputs: list[Path]) -> Path:
    from facepipe.stage.files import check_suffix

    out = output_of(arguments, inputs)
    check_suffix(out)
    return out


def _derive(
    arguments: argparse.Namespace, out: Path, processor: AuthorSliders | AuthorNetwork | SetSliders, recipe: Recipe
) -> Any:
    from facepipe.pipeline.sliders import derive

    report = derive(arguments.face, out, lambda face: processor(face, recipe=recipe), flatten=arguments.flatten)
    warn(report.warnings)
    return report
