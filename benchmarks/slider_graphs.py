"""Microseconds per evaluation of graphs of sliders, against facepipe's own evaluation in numpy.

Faces: the sample with its own sliders, MakeHuman with made-up ones, half of them curves of four knots, over the joints
below its neck, and over every joint.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from facepipe_onnx import Deformer, Options, export_parts
from onnx_timing import median, start

from facepipe.heads import make
from facepipe.parts import FaceParts, Slider
from facepipe.rig import CHANNELS, Rig, build, slide

AIM_US = 100.0
SLIDERS = 60
CURVE = ((0.0, 0.0), (0.3, 0.1), (0.8, 0.9), (1.0, 1.0))


@dataclass(frozen=True, kw_only=True)
class SliderRow:
    """One face's figures, times in microseconds."""

    face: str
    sliders: int
    joints: int
    moving: int  # joints that some slider moves
    nodes: int
    file_kb: float
    onnx: float
    onnx_cold: float  # after 256 MB of other work
    points: float  # the same with the option points
    rig: float  # facepipe.rig.slide and the joint tree, numpy float64
    error: float  # largest difference of skinning matrices to the rig, in head heights


def slider_rows(makehuman: FaceParts | None, runs: int, other: np.ndarray[Any, Any]) -> list[SliderRow]:
    """The figures of all faces; `other` is read before each cold evaluation."""
    faces = {"sample": make(0, controls="bones")}
    if makehuman is not None:
        names = makehuman.skeleton.joints
        faces["makehuman head"] = driven(makehuman, [name for name in names if "/head" in name])
        faces["makehuman all"] = driven(makehuman, names)
    return [_measure(name, parts, runs, other) for name, parts in faces.items()]


def driven(parts: FaceParts, joints: Sequence[str]) -> FaceParts:
    """The face with `SLIDERS` sliders that move 8 of the joints each, and every joint at least once."""
    rng = np.random.default_rng(0)
    sliders = []
    for number in range(SLIDERS):
        own = [joints[(number * len(joints) // SLIDERS + i) % len(joints)] for i in range(8)]
        entries = tuple((joint, channel, float(rng.normal() * 0.02)) for joint in own for channel in CHANNELS)
        curves = (CURVE,) * len(entries) if number % 2 else ()
        sliders.append(Slider(name=f"slider{number}", channels=entries, channel_curves=curves))
    return replace(parts, sliders=tuple(sliders))


def _measure(name: str, parts: FaceParts, runs: int, other: np.ndarray[Any, Any]) -> SliderRow:
    rig = build(parts)
    rng = np.random.default_rng(1)
    values = {one.name: float(np.float32(rng.uniform(one.minimum, one.maximum))) for one in parts.sliders}
    with tempfile.TemporaryDirectory() as folder:
        path, with_points = Path(folder) / "sliders.onnx", Path(folder) / "points.onnx"
        report = export_parts(parts, path, Options(sliders=True))
        export_parts(parts, with_points, Options(sliders=True, points=True))
        found = Deformer(path).evaluate(sliders=values)["skinning_matrices"]
        sessions = [start(path), start(with_points)]
    feeds = {"sliders": np.array([list(values.values())], np.float32)}
    if rig.shapes:
        feeds["weights"] = np.zeros((1, len(rig.shapes)), np.float32)
    moving = {joint for slider in parts.sliders for joint, *_ in slider.channels}
    difference = np.abs(found - _matrices(rig, parts, values)).max()
    neutral = rig.evaluate()
    return SliderRow(
        face=name,
        sliders=len(parts.sliders),
        joints=len(rig.joints),
        moving=len(moving),
        nodes=report.counts["nodes"],
        file_kb=report.bytes / 1e3,
        onnx=1e3 * median(lambda: sessions[0].run(None, feeds), 10 * runs),
        onnx_cold=1e3 * median(lambda: sessions[0].run(None, feeds), max(5, runs // 10), before=lambda: other.sum()),
        points=1e3 * median(lambda: sessions[1].run(None, feeds), runs),
        rig=1e3 * median(lambda: _matrices(rig, parts, values), max(5, runs // 3)),
        error=float(difference / np.ptp(neutral[:, 1])),
    )


def _matrices(rig: Rig, parts: FaceParts, values: dict[str, float]) -> Any:
    coefficients, _ = slide(parts.sliders, rig.joints, values)
    return rig.joint_worlds(rig.local_transforms(coefficients)) @ rig.inverse_bind


def slider_table(rows: Sequence[SliderRow]) -> str:
    """The figures for people."""
    lines = [
        "sliders         count joints moving nodes  file KB   onnx   cold  points    rig  rig/onnx  aim/onnx    error"
    ]
    for one in rows:
        over = slider_ratios(one)
        lines.append(
            f"{one.face:15} {one.sliders:5} {one.joints:6} {one.moving:6} {one.nodes:5} {one.file_kb:8.0f} "
            f"{one.onnx:6.1f} {one.onnx_cold:6.0f} {one.points:7.0f} {one.rig:6.0f} {over['rig / onnx']:9.1f} "
            f"{over['aim / onnx']:9.1f} {one.error:8.1e}"
        )
    return "\n".join([*lines, f"times in microseconds; the aim is {AIM_US:g}"])


def slider_ratios(one: SliderRow) -> dict[str, float]:
    """What the times are worth; above 1 the graph is the faster one, or the aim met."""
    return {"aim / onnx": AIM_US / one.onnx, "rig / onnx": one.rig / one.onnx}
