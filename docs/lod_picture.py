"""Draws docs/lod.png: `python docs/lod_picture.py`. Needs `pip install 'facepipe[lod]'`.

A person of the sample and its lower levels in an expression, shaded and as wire frames.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import facepipe
from facepipe.parts import FloatArray
from facepipe.pictures import PictureOptions, contact_sheet, picture, save_png
from facepipe.pictures.camera import Camera, portrait
from facepipe.pictures.wireframe import wireframe

if TYPE_CHECKING:
    from PIL.Image import Image

    from facepipe.stage import Face

HERE = Path(__file__).resolve().parent
SEED = 3
COUNTS = (20000, 8000, 2500)
POSE = {"jawOpen": 0.35, "mouthSmileLeft": 0.8, "mouthSmileRight": 0.5, "eyeBlinkLeft": 0.4, "browInnerUp": 0.6}
VIEW = (0.35, 0.05)  # yaw, pitch
SIZE = 330
WIRE = (24, 44, 96)


def shaded(face: Face, points: FloatArray, seen: Camera) -> Image:
    """The level."""
    return picture(face.parts(), points, PictureOptions(size=SIZE, camera=seen))


def wired(image: Image, face: Face, points: FloatArray, seen: Camera) -> Image:
    """Its edges over a picture of it."""
    homogeneous = seen.project(points)
    screen = np.concatenate([homogeneous[:, :2] / homogeneous[:, 3:], homogeneous[:, 3:]], axis=1)
    result = image.convert("RGB")
    result.paste(WIRE, (0, 0), wireframe(face.parts(), screen, result.size))
    return result


def main() -> None:
    """Make levels, draw, save."""
    with tempfile.TemporaryDirectory() as name:
        face, lods = Path(name) / "head.usdc", Path(name) / "lods.usdc"
        facepipe.sample(face, seed=SEED, textures=1024)
        report = facepipe.lod(face, out=lods, triangles=COUNTS)
        worst = [max(shape.mean_mm for shape in level.errors.shapes.values()) for level in report.levels]
        said = ["the face itself", *(f"{mm:.2f} mm off in the worst shape" for mm in worst)]
        full = facepipe.open(lods)
        seen, above, below = portrait(full.evaluate(), VIEW, SIZE, SIZE), [], []
        for number in range(len(full.levels)):
            level = full.at_level(number)
            points = level.evaluate(POSE)
            image = shaded(level, points, seen)
            count = sum(int(mesh.face_vertex_counts.sum()) - 2 * len(mesh.face_vertex_counts) for mesh in level.meshes)
            above.append((f"lod{number}: {count:,} triangles", image))
            below.append((said[number], wired(image, level, points, seen)))
    save_png(contact_sheet([*above, *below], columns=len(above)), HERE / "lod.png")


if __name__ == "__main__":
    main()
