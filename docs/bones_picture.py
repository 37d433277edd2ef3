"""Draws docs/bones.png: `python docs/bones_picture.py`. Needs ../shared/data.

ICT-FaceKit (MIT license) with the bones of MakeHuman (CC0), `--optimise`d: shapes of its own, what the
bones reach of them, and what the residual adds.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from bone_faces import DATA, HERE, LIMITS, ict_face, makehuman_face, skinned

import facepipe
from facepipe.importers import makehuman
from facepipe.parts import FloatArray
from facepipe.pictures import HeatMap, PictureOptions, contact_sheet, picture, save_png
from facepipe.stage import Face
from facepipe.verbs.fit_bones import FitBones, Target, read_limits, read_targets

if TYPE_CHECKING:
    from PIL.Image import Image

SHAPES = ("jawOpen", "mouthSmileLeft")
LARGEST_MM = 5.0  # of the heat map; what is missed by more has its last colour
SIZE = 264
VIEW = (0.3, 0.0)  # yaw, pitch
MARGIN = np.array([0.6, 0.68, 0.5])  # of the size of the landmarks, either side


def close_up(face: Face) -> FloatArray:
    """(n, 3) points that frame the face without neck and back of the head: all others, brought to its border."""
    mesh, landmarks = face.landmarks()
    marks = face.split(face.evaluate())[mesh.name][landmarks.indices]
    middle, half = marks.mean(axis=0), np.ptp(marks, axis=0) * MARGIN
    return np.clip(face.evaluate(), middle - half, middle + half)


def row(face: Face, saved: Face, target: Target) -> list[tuple[str, Image]]:
    """Rest, target, bones, what they leave, bones and residual."""
    local, weights = saved.sample(target.name)
    bones = saved.evaluate(joint_transforms=local)
    whole = saved.evaluate(weights, joint_transforms=local)
    off, left = (np.linalg.norm(one - target.points[0], axis=1) * face.mm_per_unit for one in (bones, whole))
    plain = PictureOptions(size=SIZE, view=VIEW, framing=close_up(face))
    heat = HeatMap(values=off, range=(0.0, LARGEST_MM))
    parts = face.parts()
    return [
        ("rest", picture(parts, face.evaluate(), plain)),
        (target.name, picture(parts, target.points[0], plain)),
        (f"bones: RMS {np.sqrt((off**2).mean()):.2f} mm", picture(parts, bones, plain)),
        (f"what they miss: {off.max():.1f} mm at most", picture(parts, bones, replace(plain, heatmap=heat))),
        (f"bones + residual: {left.max():.1f} mm at most", picture(parts, whole, plain)),
    ]


def main() -> None:
    """Skin, fit, draw, save."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        human = makehuman_face(DATA, folder / "makehuman.usdc", makehuman.Options())
        face, _ = skinned(ict_face(DATA, folder / "ict.usdc"), human, folder / "ict.usda", optimise=True)
        targets = read_targets(face, SHAPES)
        with face.deriving(folder / "fitted.usda") as result:
            FitBones(limits=read_limits(LIMITS), residual=True)(result, targets)
        saved = facepipe.open(folder / "fitted.usda")
        pictures = [one for target in targets for one in row(face, saved, target)]
    save_png(contact_sheet(pictures, columns=5), HERE / "bones.png")


if __name__ == "__main__":
    main()
