"""What is written beside a fit: a picture of what bones miss, and the coefficients as a payload."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.payload import PayloadContent, Precision
from facepipe.pictures import HeatMap, PictureOptions, contact_sheet, picture, save_png
from facepipe.processors.bone_payload import write_payload
from facepipe.processors.fit_bones.report import FitBonesReport
from facepipe.processors.fit_bones.targets import Target
from facepipe.stage import Face

_PICTURES = 12  # of a heat map's sheet


def draw_missed(face: Face, targets: Sequence[Target], report: FitBonesReport, path: Path) -> None:
    """The targets that bones miss most, in the pose of their worst frame, on one scale."""
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


def write_coefficients(face: Face, report: FitBonesReport, precision: Precision, path: Path) -> dict[str, Any]:
    """Write the coefficients on the stage: one clip, one pose, or one pose a target."""
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
