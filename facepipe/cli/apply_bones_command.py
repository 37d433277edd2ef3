"""Rebuild a face from bone coefficients: an animation on an override layer, or its points.

COEFFICIENTS is a payload (.fpb) for the joints of FACE. OUT holds a SkelAnimation below FACE: a pose, a clip where the
payload has sample times, or poses NAME_1, NAME_2 ... where it has frames without times; the (first) one is what the
skeleton plays. An .npz holds `points`, (n, 3) or (frames, n, 3) in stage units, and `times`. Exit code 1: done, but
coefficients are beyond the limits of FACE; --clamp brings them into these.

examples:
  facepipe apply-bones head.usda --info person.fpb
  facepipe apply-bones head.usda person.fpb -o person.usda
  facepipe apply-bones head.usda person.fpb -o points.npz
"""

from __future__ import annotations

import argparse
import dataclasses
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.cli.parser import output_of
from facepipe.cli.show import emit, progress, warn
from facepipe.core.errors import InputError

if TYPE_CHECKING:
    from facepipe.payload import Header, PayloadContent
    from facepipe.stage import Face


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    parser.add_argument("face", type=Path, metavar="FACE", help="face stage")
    parser.add_argument("coefficients", type=Path, metavar="COEFFICIENTS", help="bone coefficients: .fpb")
    parser.add_argument("--info", action="store_true", help="print what COEFFICIENTS holds, and whether it fits FACE")
    output = "override layer to write: .usda .usdc .usd .usdz, or points: .npz"
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help=output)
    parser.add_argument("--force", action="store_true", help="overwrite OUT where it exists")
    parser.add_argument("--clamp", action="store_true", help="bring coefficients into the bone limits of FACE")
    parser.add_argument("--name", help="name of the animation (default: the file's)")
    parser.add_argument("--flatten", action="store_true", help="write a standalone file")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Read, then tell or rebuild."""
    import facepipe
    from facepipe.payload import decode
    from facepipe.processors.bone_payload import payload_bytes

    inputs = [arguments.face, arguments.coefficients]
    if arguments.info:
        _refuse_flags(arguments, "--info", ("output", "name", "clamp"))
        return _info(facepipe.open(arguments.face), arguments)
    out = output_of(arguments, inputs)
    data = payload_bytes(arguments.coefficients)
    face = facepipe.open(arguments.face)
    content = decode(data, face.skeleton.joints, arguments.coefficients)
    if out.suffix.lower() == ".npz":
        _refuse_flags(arguments, f"-o {out.name}", ("name", "flatten"))
        return _points(face, content, arguments, out)
    return _author(face, content, arguments, out)


def _refuse_flags(arguments: argparse.Namespace, beside: str, names: tuple[str, ...]) -> None:
    for name in names:
        if getattr(arguments, name):
            raise InputError(f"--{name}", f"given with {beside}, expected only one of them")


def _author(face: Face, content: PayloadContent, arguments: argparse.Namespace, out: Path) -> int:
    from facepipe.core.names import identifier
    from facepipe.pipeline.apply_bones import ApplyJob, ApplyOptions, make, missed

    name = arguments.name if arguments.name is not None else identifier(arguments.coefficients.stem)
    if identifier(name) != name:
        raise InputError(f"--name {name}", f"no name of a prim, expected one like {identifier(name)}")
    options = ApplyOptions(name=name, clamp=arguments.clamp)
    files = {"face": arguments.face, "coefficients": arguments.coefficients}
    report = make(ApplyJob(**files, out=out, options=options, flatten=arguments.flatten), face, content)
    names = ", ".join(report.animations[:4]) + (" ..." if len(report.animations) > 4 else "")
    text = f"{out}: {names}: {report.frames} frame(s) of {report.joints} joints"
    warn(report.warnings)
    emit({"path": str(out), **dataclasses.asdict(report)}, text, as_json=arguments.json)
    return 1 if missed(report, options) else 0


def _points(face: Face, content: PayloadContent, arguments: argparse.Namespace, out: Path) -> int:
    import numpy as np

    from facepipe.core.atomic import write_bytes
    from facepipe.processors.apply_bones import check_fits, limit_warnings, posed_points
    from facepipe.processors.bone_limits import beyond_limits, within_limits

    check_fits(face, content)
    beyond = beyond_limits(face, content)
    content = within_limits(face, content) if arguments.clamp else content
    with progress("pose", len(content.frames)) as bar:
        points = posed_points(face, content, bar.update)
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {"points": points} | ({} if content.times is None else {"times": content.times})
    np.savez(buffer, **arrays)
    write_bytes(out, buffer.getvalue())
    text = f"{out}: points {points.shape}"
    warnings = limit_warnings(beyond, clamped=arguments.clamp)
    warn(warnings)
    result = {"path": str(out), "shape": list(points.shape), "beyond_limits": beyond, "warnings": warnings}
    emit(result, text, as_json=arguments.json)
    return 1 if beyond and not arguments.clamp else 0


def _info(face: Face, arguments: argparse.Namespace) -> int:
    from facepipe.payload import decode, read_header
    from facepipe.processors.apply_bones import limit_warnings
    from facepipe.processors.bone_limits import beyond_limits
    from facepipe.processors.bone_payload import payload_bytes

    where = arguments.coefficients
    data = payload_bytes(where)
    header = read_header(data, where)
    misfit = _misfit(face, header)
    result: dict[str, Any] = {"path": str(where), "bytes": len(data), "fits": not misfit, **header._asdict()}
    frames = f"{header.frames} frame(s)" if header.has_frames else "one pose"
    lines = [
        f"{where}: {len(data):,} bytes: {frames}, {header.stored} of {header.joints} joints in {header.precision}, "
        f"units of {header.meters_per_unit:g} m, joints hash {header.joints_hash}"
    ]
    beyond: tuple[str, ...] = ()
    if misfit:
        lines.append(f"is not for {arguments.face}: {misfit}")
    else:
        content = decode(data, face.skeleton.joints, where)
        beyond, ranges = beyond_limits(face, content), _ranges(content)
        result |= {**ranges, "beyond_limits": beyond}
        lines += [*_ranges_text(ranges), *limit_warnings(beyond, clamped=False)]
    emit(result, "\n".join(lines), as_json=arguments.json)
    return 1 if beyond or misfit else 0


def _misfit(face: Face, header: Header) -> str:
    """Why a payload is not for a face; empty where it is."""
    import numpy as np

    from facepipe.payload import joints_hash

    joints = face.skeleton.joints
    if (header.joints, header.joints_hash) != (len(joints), joints_hash(joints).hex()):
        return f"its {len(joints)} joints are others"
    if np.float32(header.meters_per_unit) != np.float32(face.meters_per_unit):
        return f"its units are {face.meters_per_unit:g} m"
    return ""


def _ranges(content: PayloadContent) -> dict[str, Any]:
    import numpy as np

    values = content.frames
    return {
        "translation": float(np.abs(values[..., :3]).max()),
        "rotation": float(np.abs(values[..., 3:6]).max()),
        "scale": [float(values[..., 6:].min()), float(values[..., 6:].max())],
        "times": None if content.times is None else [float(content.times[0]), float(content.times[-1])],
    }


def _ranges_text(ranges: dict[str, Any]) -> list[str]:
    scales = " to ".join(f"{one:g}" for one in ranges["scale"])
    times = ranges["times"]
    return [
        f"moves by at most {ranges['translation']:g} units, {ranges['rotation']:g} radians, scales {scales}",
        *([f"times {times[0]:g} to {times[1]:g} s"] if times else []),
    ]
