"""Fit the bones of a face to targets: coefficients within limits, a SkelAnimation for each target.

A target is a blendshape of the face (jawOpen, jawOpen=0.5), `shapes` (each of them), an animation of the face (all its
frames), a face stage of its topology, a stage with points over time, a SkelAnimation of a stage (clip.usda:talk), or an
OBJ, GLB or glTF of its topology (sculpt.obj:Head says which mesh a single one of another name is; OBJ is read in the
units and axes of the face). Meshes that a target lacks don't count.

Limits are those of the rig, and over them those of a file, where later joints win: {"joints": {"*": {"t": [-0.1, 0.1],
"r": [-0.5, 0.5]}, "jaw": {"rx": [0, 0.4], "tz": [null, 0]}}, "lock": ["root:*", "eye*:s"], "units": "cm"}. Channels are
tx ty tz (units: stage, mm, cm or m) rx ry rz (radians) sx sy sz (factors), or t r s; null is no limit.

OUT is an override layer over RIG. What bones can't reach is reported; --residual keeps it as a sparse blendshape, which
the animation turns on. Exit code 1: done, but a target is missed by more than the threshold.

examples:
  facepipe fit-bones rig.usda --target smile.usda -o fitted.usda --residual
  facepipe fit-bones rig.usda --target shapes --limits limits.json --region mouth=2 --region neck=0 -o fitted.usda
  facepipe fit-bones rig.usda --target cache.usdc -o clip.usda --coefficients clip.fpb
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.fit_bones_text import as_text
from facepipe.cli.parser import add_options, add_output, check_input, given_options, output_of, pairs, picture_of
from facepipe.cli.show import emit, progress, warn
from facepipe.errors import FacepipeError, InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from PIL.Image import Image

    from facepipe.parts import FaceParts, FloatArray
    from facepipe.processors.fit_bones import FitBones, FitBonesReport, Target
    from facepipe.stage import Face

_PICTURES = 12  # of a heat map's sheet


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.fit_bones import FitBonesOptions

    add = parser.add_argument
    add("rig", type=Path, metavar="RIG", help="face stage with joints and skin weights")
    add("--target", action="append", required=True, metavar="T", help="what to reach; may be given again")
    add_output(parser, "override layer to write: .usda .usdc .usd .usdz")
    add("--limits", type=Path, metavar="JSON", help="limits of joints and channels")
    add("--region", action="append", default=[], metavar="NAME=WEIGHT", help="how much points of a region count")
    add("--mask", action="append", default=[], metavar="NAME", help="only points of this region or point subset count")
    add("--initial", metavar="ANIMATION|FPB", help="coefficients to start from (default rest)")
    add("--coefficients", type=Path, metavar="FPB", help="write the coefficients as a payload: .fpb")
    add("--precision", choices=("float16", "float32"), default="float32", help="of the payload (default float32)")
    add("--heatmap", type=Path, metavar="PNG", help="draw the targets that are missed most, coloured by distance")
    add("--flatten", action="store_true", help="write a standalone file")
    add("--json", action="store_true", help="print the report as JSON")
    add_options(parser, FitBonesOptions, "how to fit")


def run(arguments: argparse.Namespace) -> int:
    """Read, fit, author, report."""
    import facepipe
    from facepipe.processors.fit_bones import read_targets

    out, picture, payload = _outputs(arguments)
    face = facepipe.open(arguments.rig)
    fit = _fit(arguments, face)
    targets = read_targets(face, arguments.target, lambda path: _load(path, face))
    if payload is not None and len(targets) > 1 and any(target.times is not None for target in targets):
        raise InputError(payload, "holds one clip or several poses, expected a single --target with times")
    report, image = _author(face, fit, targets, arguments, out, picture is not None)
    result = {"path": str(out), **json.loads(report.to_json())}
    text = [as_text(out, report)]
    if picture is not None and image is not None:
        from facepipe.render import save_png

        save_png(image, picture)
        result["picture"] = str(picture)
        text.append(str(picture))
    if payload is not None:
        result["coefficients"] = _write_payload(payload, out, report, arguments)
        text.append(f"{payload}: {result['coefficients']['bytes']:,} bytes")
    warn(report.warnings)
    emit(result, "\n".join(text), as_json=arguments.json)
    return 1 if report.missed else 0


def _outputs(arguments: argparse.Namespace) -> tuple[Path, Path | None, Path | None]:
    """The paths to write, checked before any work: stage, picture, payload."""
    from facepipe.processors.bone_payload import check_payload_suffix
    from facepipe.processors.fit_bones.target_files import split_file
    from facepipe.stage.files import check_suffix

    files = [file for file, _ in map(split_file, arguments.target) if file is not None]
    initial = [arguments.initial] if _is_file(arguments.initial) else []
    inputs = [arguments.rig, *map(Path, files), *map(Path, initial)]
    inputs += [arguments.limits] if arguments.limits else []
    out = output_of(arguments, inputs)
    check_suffix(out)
    picture = None if arguments.heatmap is None else picture_of(arguments.heatmap, arguments, inputs, out)
    if arguments.coefficients is None:
        return out, picture, None
    payload = output_of(argparse.Namespace(output=arguments.coefficients, force=arguments.force), inputs)
    check_payload_suffix(payload)
    return out, picture, payload


def _is_file(initial: str | None) -> bool:
    return initial is not None and Path(initial).suffix.lower() == ".fpb"


def _fit(arguments: argparse.Namespace, face: Face) -> FitBones:
    from facepipe.processors.fit_bones import FitBones, FitBonesOptions, LimitRules, read_limits

    if arguments.limits is not None:
        check_input(arguments.limits)
    return FitBones(
        limits=LimitRules() if arguments.limits is None else read_limits(arguments.limits),
        regions=pairs(arguments.region, "--region"),
        mask=tuple(arguments.mask),
        initial=_initial(face, arguments.initial),
        **given_options(arguments, FitBonesOptions),
    )


def _initial(face: Face, word: str | None) -> FloatArray | None:
    from facepipe.payload import decode
    from facepipe.processors.apply_bones import check_fits
    from facepipe.processors.bone_payload import payload_bytes
    from facepipe.processors.fit_bones import initial_coefficients

    if word is None:
        return None
    if not _is_file(word):
        return initial_coefficients(face, word)
    content = decode(payload_bytes(Path(word)), face.skeleton.joints, word)
    check_fits(face, content)
    first: FloatArray = content.frames[0]
    return first


def _load(path: Path, face: Face) -> FaceParts:
    """An OBJ in the units and axes of the face, or a glTF in its own."""
    from facepipe.importers import load, obj

    check_input(path)
    if path.suffix.lower() == ".obj":
        up_axis = "Z" if face.up_axis == "Z" else "Y"
        return load("obj", path, obj.Options(meters_per_unit=face.meters_per_unit, up_axis=up_axis)).parts  # type: ignore[arg-type]
    return load("gltf", path).parts


def _author(
    face: Face, fit: FitBones, targets: Sequence[Target], arguments: argparse.Namespace, out: Path, drawn: bool
) -> tuple[FitBonesReport, Image | None]:
    """Fit and save; the picture is drawn before anything is saved."""
    from facepipe.processors.fit_bones import fit_bones_recipe
    from facepipe.stage import Face

    recipe = fit_bones_recipe(arguments.rig, arguments.target, out, fit, arguments.initial)
    frames = sum(len(target.points) for target in targets)
    with face.deriving(out, flatten=arguments.flatten) as derived, progress("fit", frames) as bar:
        try:
            report = fit(derived, targets, recipe=recipe, done=bar.update)
        except FacepipeError as error:  # the layer being made has no file yet: name its source
            raise error.under(arguments.rig) if error.where.startswith(("<", "/")) else error from None
        return report, _draw(Face(derived.stage, derived.prim), targets, report) if drawn else None


def _draw(face: Face, targets: Sequence[Target], report: FitBonesReport) -> Image:
    """The targets that bones miss most, in the pose of their worst frame, on one scale."""
    import numpy as np

    from facepipe.render import HeatMap, PictureOptions, contact_sheet, picture

    order = sorted(zip(targets, report.targets.items(), strict=True), key=lambda pair: -pair[1][1].distances.max_mm)
    largest = max(order[0][1][1].distances.max_mm, report.threshold_mm)
    parts, images = face.parts(), []
    for target, (name, one) in order[:_PICTURES]:
        posed = [face.evaluate(joint_transforms=face.sample(name, frame)[0]) for frame in range(len(target.points))]
        off = np.linalg.norm(np.stack(posed) - target.points, axis=2) * face.mm_per_unit
        worst = int(off.max(axis=1).argmax())
        heatmap = HeatMap(values=off[worst], label=name, range=(0.0, float(largest)))
        image = picture(parts, posed[worst], PictureOptions(heatmap=heatmap))
        images.append((f"{name}: {one.distances.max_mm:.3g} mm", image))
    return images[0][1] if len(images) == 1 else contact_sheet(images, min(4, len(images)))


def _write_payload(path: Path, out: Path, report: FitBonesReport, arguments: argparse.Namespace) -> dict[str, object]:
    """The coefficients on the saved stage: one clip, one pose, or one pose a target."""
    import numpy as np

    import facepipe
    from facepipe.payload import PayloadContent
    from facepipe.processors.bone_payload import write_payload

    face = facepipe.open(out)
    found = {one.name: one for one in face.animations}
    poses = [found[name] for name in report.targets]
    values = np.concatenate([one.coefficients for one in poses if one.coefficients is not None])
    single = len(poses) == 1 and poses[0].times is None
    content = PayloadContent(
        joints=face.skeleton.joints,
        coefficients=values[0] if single else values,
        times=poses[0].times if len(poses) == 1 else None,
        meters_per_unit=face.meters_per_unit,
        precision=arguments.precision,
    )
    written: dict[str, object] = json.loads(write_payload(path, content, face.rig()).to_json())
    return written
