"""`facepipe apply-bones`: the action; beside it what a payload holds (--info) and the points that it makes (.npz)."""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from typing import Any

from facepipe.cli.action_line import ActionLine, action_of
from facepipe.cli.parser import Parser, output_of
from facepipe.cli.show import emit, progress, warn
from facepipe.core.errors import InputError
from facepipe.verbs.apply_bones import ApplyCoefficients

_LINE = ActionLine(ApplyCoefficients)
__doc__ = _LINE.__doc__  # of --help


def configure(parser: Parser, words: list[str]) -> None:
    """Add the arguments."""
    _LINE.configure(parser)
    parser.add_argument("--info", action="store_true", help="print what COEFFICIENTS holds, and whether it fits FACE")


def run(arguments: argparse.Namespace) -> int:
    """Print what the payload holds, or write points or the stage."""
    out: Path | None = arguments.output
    points = out is not None and out.suffix.lower() == ".npz"
    if not arguments.info and not points:
        return _LINE.run(arguments)
    refused = ("output", "name", "clamp", "edit") if arguments.info else ("name", "flatten", "edit")
    for name in refused:
        if getattr(arguments, name, None):
            beside = "--info" if arguments.info else f"-o {arguments.output.name}"
            raise InputError(f"--{name}", f"given with {beside}, expected only one of them")
    _, action = action_of(arguments, ApplyCoefficients)
    if action.is_person():
        return _person_info(action, as_json=arguments.json) if arguments.info else _person_points(action, arguments)
    return _info(action, as_json=arguments.json) if arguments.info else _points(action, arguments)


def _points(action: ApplyCoefficients, arguments: argparse.Namespace) -> int:
    import numpy as np

    import facepipe
    from facepipe.core.atomic import write_bytes
    from facepipe.payload import decode
    from facepipe.verbs.bone_payload import (
        beyond_limits,
        check_fits,
        limit_warnings,
        payload_bytes,
        posed_points,
        within_limits,
    )

    out = output_of(arguments, [action.face, action.coefficients])
    data, face = payload_bytes(action.coefficients), facepipe.read(action.face)
    content = decode(data, face.skeleton.joints, action.coefficients)
    check_fits(face, content)
    beyond = beyond_limits(face, content)
    content = within_limits(face, content) if action.clamp else content
    with progress("pose", len(content.frames)) as bar:
        points = posed_points(face, content, bar.update)
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {"points": points} | ({} if content.times is None else {"times": content.times})
    np.savez(buffer, **arrays)
    write_bytes(out, buffer.getvalue())
    text = f"{out}: points {points.shape}"
    warnings = limit_warnings(beyond, clamped=action.clamp)
    warn(warnings)
    result = {"path": str(out), "shape": list(points.shape), "beyond_limits": beyond, "warnings": warnings}
    emit(result, text, as_json=arguments.json)
    return 1 if beyond and not action.clamp else 0


def _person_points(action: ApplyCoefficients, arguments: argparse.Namespace) -> int:
    import numpy as np

    import facepipe
    from facepipe.core.atomic import write_bytes
    from facepipe.verbs.whole_faces import MILLIMETRES, world_to_world

    out = output_of(arguments, [action.face, action.coefficients])
    face = facepipe.read(action.face)
    content, _, points = action.person(face)
    parts = face.parts()
    to_stage = np.linalg.inv(world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES))
    points = points @ to_stage[:3, :3].T
    buffer = io.BytesIO()
    np.savez(buffer, points=points.astype(np.float32))
    write_bytes(out, buffer.getvalue())
    warnings = action.left_out_lines(content)
    warn(warnings)
    result = {"path": str(out), "shape": list(points.shape), "beyond_limits": (), "warnings": warnings}
    emit(result, f"{out}: points {points.shape}", as_json=arguments.json)
    return 1 if content.skipped else 0


def _person_info(action: ApplyCoefficients, *, as_json: bool) -> int:
    import facepipe
    from facepipe.payload.person import decode_person
    from facepipe.verbs.apply_person import basis_for
    from facepipe.verbs.bone_payload import payload_bytes

    where = action.coefficients
    data, face = payload_bytes(where), facepipe.read(action.face)
    content, misfit = decode_person(data, where), ""
    try:
        basis_for(content, face.parts(), where, str(action.face), action.database)
    except InputError as error:
        misfit = error.what
    numbers = {"modes": len(content.modes), "parts": len(content.parts), "points": len(content.points)}
    result: dict[str, Any] = {"path": str(where), "bytes": len(data), "fits": not misfit, "version": 2, **numbers}
    result |= {"basis": content.basis.hex(), "placement": content.placement is not None, "left_out": content.skipped}
    lines = [
        f"{where}: {len(data):,} bytes: a person on basis {content.basis.hex()}: {numbers['modes']} modes, "
        f"{numbers['parts']} parts, {numbers['points']:,} bytes of points"
    ]
    lines += [f"is not for {action.face}: {misfit}"] if misfit else []
    lines += action.left_out_lines(content)
    emit(result, "\n".join(lines), as_json=as_json)
    return 1 if misfit or content.skipped else 0


def _info(action: ApplyCoefficients, *, as_json: bool) -> int:
    import numpy as np

    import facepipe
    from facepipe.payload import decode, joints_hash, read_header
    from facepipe.verbs.bone_payload import beyond_limits, limit_warnings, payload_bytes

    where = action.coefficients
    face, data = facepipe.read(action.face), payload_bytes(where)
    header = read_header(data, where)
    joints, misfit = face.skeleton.joints, ""  # why it is not for the face
    if (header.joints, header.joints_hash) != (len(joints), joints_hash(joints).hex()):
        misfit = f"its {len(joints)} joints are others"
    elif np.float32(header.meters_per_unit) != np.float32(face.meters_per_unit):
        misfit = f"its units are {face.meters_per_unit:g} m"
    result: dict[str, Any] = {"path": str(where), "bytes": len(data), "fits": not misfit, **header._asdict()}
    frames = f"{header.frames} frame(s)" if header.has_frames else "one pose"
    lines = [
        f"{where}: {len(data):,} bytes: {frames}, {header.stored} of {header.joints} joints in {header.precision}, "
        f"units of {header.meters_per_unit:g} m, joints hash {header.joints_hash}"
    ]
    beyond: tuple[str, ...] = ()
    if misfit:
        lines.append(f"is not for {action.face}: {misfit}")
    else:
        content = decode(data, joints, where)
        beyond, values, times = beyond_limits(face, content), content.frames, content.times
        moved, turned = (float(np.abs(values[..., part]).max()) for part in (slice(3), slice(3, 6)))
        least, most = float(values[..., 6:].min()), float(values[..., 6:].max())
        ends = None if times is None else [float(times[0]), float(times[-1])]
        result |= {"translation": moved, "rotation": turned, "scale": [least, most], "times": ends}
        result["beyond_limits"] = beyond
        lines.append(f"moves by at most {moved:g} units, {turned:g} radians, scales {least:g} to {most:g}")
        lines += [f"times {ends[0]:g} to {ends[1]:g} s"] if ends else []
        lines += limit_warnings(beyond, clamped=False)
    emit(result, "\n".join(lines), as_json=as_json)
    return 1 if beyond or misfit else 0
