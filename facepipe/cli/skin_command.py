"""Give a face a skeleton and skin weights: from joint positions, or from another face's skeleton.

--joints holds where joints are, in the world: {"unit": "mm", "joints": {"head": {"position": [0, 60, 20]}, "head/jaw":
{"position": [0, 0, 20], "surface": false}, "head/jaw/chin": {"position": [0, -72, 100], "regions": ["mouth_lower"]}},
"parts": {"Teeth*": {"upper": "head", "lower": "head/jaw"}}}.
A joint may have "rotation" (quaternion x y z w relative to its parent's axes), "radius" (no weight beyond, along the
surface), "regions" (of the face, or mouth_upper, mouth_lower, eye_left_upper ...) and "surface" (false: a pivot, which
moves loose parts only). "parts" gives meshes whole to joints; units are stage, mm, cm or m. Weights fall off along the
surface and never cross from lip to lip or lid to lid.

--from takes the skeleton and weights of another face, whatever its topology: a smooth warp by the landmarks multipie68,
which both need, lays it over FACE; joints move along, points take the weights of the nearest places, lips from lips;
on one topology, of the same points.
--optimise then refines the weights, so that the joints alone come nearer to the blendshapes that FACE has: RMS and max
distance of the moved points, before and after, with the best rigid motion of each joint. Joints stay where they are,
and only weights are authored. For bone coefficients of each shape, within limits and with scale, fit the result:
facepipe fit-bones OUT --target shapes -o FITTED.

A face that has the same joints keeps their order; where they stand may change, what its animations do relative to rest
does not. OUT is an override layer over FACE.

examples:
  facepipe skin head.usdc --joints joints.json -o skinned.usdc --picture weights.png
  facepipe skin ict.usdc --from makehuman.usdc -o rigged.usdc --optimise
  facepipe fit-bones rigged.usdc --target shapes -o fitted.usdc
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import add_options, add_output, options_from, output_of, picture_of
from facepipe.cli.show import emit, progress, warn
from facepipe.core.errors import InputError

if TYPE_CHECKING:
    from PIL.Image import Image

    from facepipe.processors.skin import SkinReport
    from facepipe.stage import Face


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.skin import SkinOptions

    parser.add_argument("face", type=Path, metavar="FACE", help="face stage without joints, or with the same ones")
    way = parser.add_mutually_exclusive_group(required=True)
    way.add_argument("--joints", type=Path, metavar="JSON", help="where joints are")
    way.add_argument("--from", dest="source", type=Path, metavar="OTHER_FACE", help="a skinned face, of any topology")
    add_output(parser, "override layer to write: .usda .usdc .usd .usdz")
    parser.add_argument("--optimise", action="store_true", help="refine the weights for the face's own blendshapes")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="draw the weights on the face, a colour a joint")
    parser.add_argument("--flatten", action="store_true", help="write a standalone file")
    parser.add_argument("--json", action="store_true", help="print what was authored as JSON")
    add_options(parser, SkinOptions, "weights", sparse=True)


def run(arguments: argparse.Namespace) -> int:
    """Read, skin, author the layer."""
    from facepipe.core.atomic import together
    from facepipe.pipeline.skin import SkinJob, make
    from facepipe.processors.skin import SkinOptions
    from facepipe.stage.files import check_suffix

    inputs = [arguments.face, arguments.joints or arguments.source]
    out = output_of(arguments, inputs)
    check_suffix(out)
    _check_flags(arguments)
    picture = None if arguments.picture is None else picture_of(arguments.picture, arguments, inputs, out)
    job = SkinJob(
        face=arguments.face,
        joints=arguments.joints,
        source=arguments.source,
        out=out,
        optimise=arguments.optimise,
        options=options_from(arguments, SkinOptions),
        flatten=arguments.flatten,
    )
    images: list[Image] = []

    def seen(face: Face) -> None:
        if picture is not None:
            images.append(_draw(face))

    with together(out):
        report = make(job, progress, seen)
        if images and picture is not None:
            from facepipe.pictures import save_png

            save_png(images[0], picture)
    warn(report.warnings)
    result = {"path": str(out), "picture": str(picture) if picture else None, **dataclasses.asdict(report)}
    emit(result, _text(out, picture, report), as_json=arguments.json)
    return 0


def _check_flags(arguments: argparse.Namespace) -> None:
    """:raises InputError: an option of another way to skin"""
    needs = {"sharpness": "joints", "smoothing": "source", "iterations": "optimise", "evenness": "optimise"}
    flags = {"joints": "--joints", "source": "--from", "optimise": "--optimise"}
    for name, needed in needs.items():
        if hasattr(arguments, name) and not getattr(arguments, needed):
            raise InputError(f"--{name}", f"given without {flags[needed]}, expected both or neither")


def _draw(face: Face) -> Image:
    from facepipe.pictures import PictureOptions, RegionColors, picture

    weights = face.rig().influences.toarray()
    names = [joint.rpartition("/")[2] for joint in face.skeleton.joints]
    masks = {
        name if names.count(name) == 1 else path: column
        for name, path, column in zip(names, face.skeleton.joints, weights.T, strict=False)
        if column.any()
    }
    return picture(face.parts(), face.evaluate(), PictureOptions(regions=RegionColors(masks=masks)))


def _text(out: Path, picture: Path | None, report: SkinReport) -> str:
    lines = [f"{out}: {report.joints} joints, at most {report.influences} a point"]
    lines += [f"weights change by {report.largest_step_per_mm:.3f} a mm at most"]
    if report.transfer is not None:
        away = report.transfer.surface_mm
        what = "of one topology, points lie" if report.transfer.same_topology else "points lie"
        what += f" {away['mean']:.2f} mm from {'their own' if report.transfer.same_topology else 'its surface'}"
        lines.append(f"from {report.transfer.source}: {what}, p95 {away['p95']:.2f}")
    if report.fit is not None:
        fit = report.fit
        misses = f"RMS {fit.rms_before_mm:.3f} -> {fit.rms_after_mm:.3f} mm, max {fit.max_before_mm:.1f} -> "
        lines.append(f"{fit.shapes} shapes by rigid joints alone: {misses}{fit.max_after_mm:.1f} mm")
        lines.append(f"bone coefficients of each shape: facepipe fit-bones {out} --target shapes -o FITTED")
    lines += [f"{mesh}: held by {joint}" for mesh, joint in report.rigid.items()]
    if report.weightless:
        some = ", ".join(joint.rpartition("/")[2] for joint in report.weightless[:8])
        lines.append(f"{len(report.weightless)} joints move no point: {some}{' ...' * (len(report.weightless) > 8)}")
    return "\n".join([*lines, *([str(picture)] if picture else [])])
