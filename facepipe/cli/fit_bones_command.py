"""Fit the bones of a face to targets: coefficients within limits, a SkelAnimation for each target.

A target is a blendshape of the face (jawOpen, jawOpen=0.5), `shapes` (each of them), an animation of the face (all its
frames), a face stage of its topology, a stage with points over time, a SkelAnimation of a stage (clip.usda:talk), or an
OBJ, GLB or glTF of its topology (sculpt.obj:Head says which mesh a single one of another name is; OBJ is read in the
units and axes of the face). Meshes that a target lacks don't count.

Limits are those of the rig, and over them those of a file, where later joints win: {"joints": {"*": {"t": [-0.1, 0.1],
"r": [-0.5, 0.5]}, "jaw": {"rx": [0, 0.4], "tz": [null, 0]}}, "lock": ["root:*", "eye*:s"], "units": "cm"}. Channels are
tx ty tz (units: stage, mm, cm or m) rx ry rz (radians) sx sy sz (factors), or t r s; null is no limit.

OUT is an override layer over RIG and needs that file; hand on what --flatten writes. Its skeleton plays the fit of a
single target; of several none plays. What bones can't reach is reported; --residual keeps it as a sparse blendshape,
which the animation turns on. Exit code 1: done, but a target is missed by more than the threshold.

The recipe stays on the result. --edit fits again from it with what the line changes: another RIG, other targets (all of
them), limits, masks and options; a --region joins those there are (NAME=1 undoes one). Without -o that is in place
(with --force), and anything else authored in that file is lost. Payload and picture are made where they are asked for.

examples:
  facepipe fit-bones rig.usda --target smile.usda -o fitted.usda --residual
  facepipe fit-bones rig.usda --target shapes --limits limits.json --region mouth=2 --region neck=0 -o fitted.usda
  facepipe fit-bones rig.usda --target cache.usdc -o clip.usda --coefficients clip.fpb
  facepipe fit-bones --edit fitted.usda --threshold-mm 0.5 --no-residual --force
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from facepipe.cli.fit_bones_request import Request, request_of
from facepipe.cli.fit_bones_text import as_text
from facepipe.cli.parser import add_options
from facepipe.cli.show import emit, progress, warn
from facepipe.core.atomic import replacing, together
from facepipe.core.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from facepipe.payload import Precision
    from facepipe.processors.fit_bones import FitBonesReport, Target
    from facepipe.stage import Face

_PICTURES = 12  # of a heat map's sheet


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.fit_bones import FitBonesOptions

    add, absent = parser.add_argument, argparse.SUPPRESS
    add("rig", nargs="?", type=Path, metavar="RIG", help="face stage with joints and skin weights")
    add("--target", action="append", default=[], metavar="T", help="what to reach; may be given again")
    add("-o", "--output", type=Path, metavar="OUT", help="override layer to write: .usda .usdc .usd .usdz")
    add("--force", action="store_true", help="overwrite OUT, with --edit FITTED, and the files below")
    add("--edit", type=Path, metavar="FITTED", help="fit again from the recipe of a result, with what else is given")
    add("--coefficients", type=Path, metavar="FPB", help="write the coefficients as a payload: .fpb")
    add("--precision", choices=("float16", "float32"), default="float32", help="of the payload (default float32)")
    add("--heatmap", type=Path, metavar="PNG", help="draw the targets that are missed most, coloured by distance")
    add("--flatten", action="store_true", help="write a standalone file")
    add("--json", action="store_true", help="print the report as JSON")
    group = parser.add_argument_group("how to fit (kept in the recipe; with --edit they change it)")
    add = group.add_argument
    add("--limits", type=Path, default=absent, metavar="JSON", help="limits over those of the rig (default none)")
    text = "how much points of a region or point subset count, 0 or more (default 1); a flag for each"
    add("--region", action="append", default=[], metavar="NAME=WEIGHT", help=text)
    text = "only points of this region or point subset count (default all do); may be given again"
    add("--mask", action="append", default=absent, metavar="NAME", help=text)
    text = "start from the first frame of an animation of RIG or of a payload (default rest)"
    add("--initial", default=absent, metavar="ANIMATION|FPB", help=text)
    for name, nothing in (("limits", None), ("mask", []), ("initial", None)):
        text = f"with --edit: without the --{name} of the recipe"
        add(f"--no-{name}", dest=name, action="store_const", const=nothing, default=absent, help=text)
    add_options(group, FitBonesOptions, sparse=True)


def run(arguments: argparse.Namespace) -> int:
    """Read, fit, author, report."""
    import facepipe
    from facepipe.pipeline.fit_bones import targets_of

    request = request_of(arguments)
    warn(request.warnings)
    face = facepipe.open(request.job.rig)
    targets = targets_of(face, request.job.targets)
    if request.payload is not None and len(targets) > 1 and any(target.times is not None for target in targets):
        raise InputError(request.payload, "holds one clip or several poses, expected a single --target with times")
    made = _make(face, targets, request, arguments.precision)
    report, out = made.report, request.job.out
    warn(report.warnings)
    result = {"path": str(out), **json.loads(report.to_json())}
    result["warnings"] = [*request.warnings, *report.warnings]
    text = [as_text(out, report)]
    if made.drawn:
        result["picture"] = str(request.picture)
        text.append(str(request.picture))
    if made.payload is not None:
        result["coefficients"] = made.payload
        text.append(f"{request.payload}: {made.payload['bytes']:,} bytes")
    emit(result, "\n".join(text), as_json=arguments.json)
    return 1 if report.missed else 0


class _Made(NamedTuple):
    """What is on the saved stage, and beside it."""

    report: FitBonesReport
    drawn: bool
    payload: dict[str, Any] | None  # report of the payload


def _make(face: Face, targets: Sequence[Target], request: Request, precision: Precision) -> _Made:
    """Fit and save: the stage, picture and payload, or none of them."""
    from facepipe.pipeline.fit_bones import make

    payloads: list[dict[str, Any]] = []
    with together(request.job.out), ExitStack() as files:
        picture, coefficients = (
            None if path is None else files.enter_context(replacing(path))
            for path in (request.picture, request.payload)
        )

        def seen(result: Face, report: FitBonesReport) -> None:
            if picture is not None and request.picture is not None:
                with _named(request.picture):
                    _draw(result, targets, report, picture)
            if coefficients is not None and request.payload is not None:
                with _named(request.payload):
                    payloads.append(_payload(result, report, precision, coefficients))
                payloads[0]["path"] = str(request.payload)

        report = make(request.job, face, targets, progress, seen)
    return _Made(report, picture is not None, payloads[0] if payloads else None)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Errors about a temporary file, as those of the file that it is for."""
    try:
        yield
    except InputError as error:
        raise InputError(path, error.what) from None


def _draw(face: Face, targets: Sequence[Target], report: FitBonesReport, path: Path) -> None:
    """The targets that bones miss most, in the pose of their worst frame, on one scale."""
    import numpy as np

    from facepipe.pictures import HeatMap, PictureOptions, contact_sheet, picture, save_png

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
    save_png(images[0][1] if len(images) == 1 else contact_sheet(images, min(4, len(images))), path)


def _payload(face: Face, report: FitBonesReport, precision: Precision, path: Path) -> dict[str, Any]:
    """Write the coefficients on the stage: one clip, one pose, or one pose a target."""
    import numpy as np

    from facepipe.payload import PayloadContent
    from facepipe.processors.bone_payload import write_payload

    found = {one.name: one for one in face.animations}
    poses = [found[name] for name in report.targets]
    values = np.concatenate([one.coefficients for one in poses if one.coefficients is not None])
    single = len(poses) == 1 and poses[0].times is None
    content = PayloadContent(
        joints=face.skeleton.joints,
        coefficients=values[0] if single else values,
        times=poses[0].times if len(poses) == 1 else None,
        meters_per_unit=face.meters_per_unit,
        precision=precision,
    )
    written: dict[str, Any] = json.loads(write_payload(path, content, face.rig()).to_json())
    return written
