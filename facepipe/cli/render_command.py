"""Draw a face.

examples:
  facepipe render head.usda -o head.png --view three-quarter --set jawOpen=0.7
  facepipe render head.usda -o nose.png --slider noseWidth=0.8
  facepipe render head.usda -o moved.png --set jawOpen=1 --heatmap displacement
  facepipe render head.usda -o regions.png --regions
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import add_output, add_pose, output_of, pairs
from facepipe.cli.show import progress
from facepipe.core.errors import InputError
from facepipe.core.names import named

if TYPE_CHECKING:
    from facepipe.core.arrays import FloatArray
    from facepipe.pictures import HeatMap
    from facepipe.stage import Face

VIEWS = ("front", "side", "three-quarter")


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    parser.add_argument("face", type=Path, metavar="FACE", help="face stage")
    add_output(parser, "picture to write: .png")
    add_pose(parser)
    sliders = "slider value, over those that FACE has authored; may be given again"
    parser.add_argument("--slider", action="append", default=[], metavar="NAME=VALUE", help=sliders)
    what = "the person: set (as FACE is set, the default), rest (the template), or an animation's first sample"
    parser.add_argument("--pose", metavar="NAME", help=what)
    parser.add_argument("--view", choices=VIEWS, default="front", help="default front")
    parser.add_argument("--size", type=int, default=800, help="width and height [pixels] (default 800)")
    parser.add_argument(
        "--heatmap",
        metavar="PRIMVAR",
        help="colour by a per-point primvar in mm, or by `displacement` from the neutral",
    )
    parser.add_argument("--regions", action="store_true", help="colour by the face's regions, with a legend")
    parser.add_argument("--landmarks", metavar="SCHEME", help="draw numbered landmarks of a scheme")


def run(arguments: argparse.Namespace) -> int:
    """Open, pose, draw."""
    import facepipe

    out = output_of(arguments, [arguments.face])
    if out.suffix.lower() != ".png":
        raise InputError(out, f"suffix '{out.suffix}', expected .png")
    with progress("render", 2) as bar:
        face = facepipe.read(arguments.face)
        points = pose(face, arguments)
        bar.update()
        _draw(face, points, arguments, out)
        bar.update()
    print(out)
    return 0


def _draw(face: Face, points: FloatArray, arguments: argparse.Namespace, out: Path) -> None:
    from facepipe.pictures import PictureOptions, RegionColors, picture, save_png

    parts = face.parts()
    options = PictureOptions(
        size=arguments.size,
        view=arguments.view,
        heatmap=_heatmap(face, points, arguments.heatmap),
        regions=RegionColors.of(parts) if arguments.regions else None,
        landmarks=arguments.landmarks,
    )
    save_png(picture(parts, points, options), out)


def pose(face: Face, arguments: argparse.Namespace) -> FloatArray:
    """(n, 3) points that `--set`, `--bone`, `--slider` and `--pose` ask for."""
    from facepipe.rig.bone_coefficients import coefficients_of

    weights = named(pairs(arguments.set, "--set"), face.shapes, "--set", "shape")
    coefficients = coefficients_of(pairs(arguments.bone, "--bone"), face.skeleton.joints, face.skeleton.names)
    if not arguments.slider:
        return face.evaluate(weights, coefficients=coefficients, pose=arguments.pose or "set")
    if arguments.pose is not None:
        raise InputError("--pose", "given with --slider, expected only one of them")
    sliders = named(pairs(arguments.slider, "--slider"), [one.name for one in face.sliders], "--slider", "slider")
    return face.evaluate(weights, coefficients=coefficients, sliders=sliders)


def _heatmap(face: Face, points: FloatArray, name: str | None) -> HeatMap | None:
    import numpy as np

    from facepipe.core import tokens
    from facepipe.pictures import HeatMap

    if name is None:
        return None
    if name == "displacement":
        moved = np.linalg.norm(points - face.evaluate(), axis=1) * face.mm_per_unit
        return HeatMap(values=moved, label="displacement")
    unit = "" if name.startswith(tokens.REGION_PRIMVAR) else "mm"
    return HeatMap(values=face.primvar(name), label=name, unit=unit)
