"""`facepipe sliders`: the action; without an option that changes sliders, their list."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from facepipe.cli.action_line import ActionLine
from facepipe.cli.show import emit
from facepipe.core.errors import InputError
from facepipe.core.reports import table
from facepipe.verbs.sliders.sliders import SlidersOfFace

if TYPE_CHECKING:
    from facepipe.parts import Curve, Slider

_LINE = ActionLine(SlidersOfFace)
__doc__ = _LINE.__doc__  # of --help
configure = _LINE.configure

_SHOWN = 4  # of what a slider drives
_WAYS = ("table", "network", "shapes", "values", "reset", "person")


def run(arguments: argparse.Namespace) -> int:
    """List, or author, make or set."""
    if arguments.edit is not None or any(hasattr(arguments, way) for way in _WAYS):
        return _LINE.run(arguments)
    for flag, given in {
        "--replace": hasattr(arguments, "drop"),
        "--mirror": hasattr(arguments, "mirror"),
        "-o": arguments.output is not None,
        "--flatten": arguments.flatten,
    }.items():
        if given:
            what = "given without --from, --from-shapes, --from-network, --person or --set, expected both or neither"
            raise InputError(flag, what)
    SlidersOfFace.line_values(arguments, {})
    if arguments.face is None:
        raise InputError("FACE", "none given, expected a face stage")
    import facepipe
    from facepipe.rig.sliders import channel_entries, shape_entries

    face = facepipe.read(arguments.face)
    sliders = face.sliders
    groups: dict[str, list[Slider]] = {}
    for slider in sliders:
        groups.setdefault(slider.group, []).append(slider)
    rows = [row for group in sorted(groups) for row in _rows(group, groups[group])]
    lines = [f"{arguments.face}: {len(sliders)} sliders in {len(groups)} groups", *([table(rows)] if rows else [])]
    network = face.slider_network
    if network:
        layers = " -> ".join(map(str, network.layers))
        what = f"{len(network.channels)} channels and {len(network.shapes)} shapes"
        lines.append(f"learned network {layers} ({network.activation}) adds to {what}")
    listed = [
        {
            "name": one.name,
            "group": one.group,
            "range": [one.minimum, one.maximum],
            "default": one.default,
            "value": one.setting,
            "mirror": one.mirror,
            "channels": [
                {"joint": joint, "channel": channel, "gain": gain, "curve": curve}
                for (joint, channel, gain), curve in channel_entries(one)
            ],
            "shapes": [{"shape": shape, "gain": gain, "curve": curve} for (shape, gain), curve in shape_entries(one)],
        }
        for one in sliders
    ]
    result = {"path": str(arguments.face), "sliders": listed, "network": network and network.summary()}
    emit(result, "\n".join(lines), as_json=arguments.json)
    return 0


def _rows(group: str, sliders: list[Slider]) -> list[tuple[str, ...]]:
    from facepipe.rig.sliders import channel_entries, shape_entries

    rows: list[tuple[str, ...]] = [(group or "(no group)",)]
    for slider in sliders:
        value = "" if slider.value is None or slider.value == slider.default else f"= {slider.value:g}"
        span = f"{slider.minimum:g} to {slider.maximum:g}, {slider.default:g}"
        texts = [
            f"{joint.rpartition('/')[2]}:{channel} {gain:g}{_bent(curve)}"
            for (joint, channel, gain), curve in channel_entries(slider)
        ]
        texts += [f"{shape} {gain:g}{_bent(curve)}" for (shape, gain), curve in shape_entries(slider)]
        more = f" ... ({len(texts)} in all)" if len(texts) > _SHOWN else ""
        mirror = f"mirror {slider.mirror}" if slider.mirror else ""
        rows.append((f"  {slider.name}", span, value, ", ".join(texts[:_SHOWN]) + more, mirror))
    return rows


def _bent(curve: Curve | None) -> str:
    return "" if curve is None else f" x curve of {len(curve)}"
