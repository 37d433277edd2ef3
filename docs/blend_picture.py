"""Draws docs/blend.png: `python docs/blend_picture.py`. Needs ../shared/data/ict_facekit (ICT-FaceKit, MIT license).

Two identities of one head, the second moved by 5 mm and turned by 3 degrees; eyes, brows and mouth of the second on the
first: averaged point by point, and blended in the gradient domain, with the same weights.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from facepipe.importers import load
from facepipe.importers.ict import Options
from facepipe.parts import FaceParts, FloatArray
from facepipe.pictures import PictureOptions, contact_sheet, picture, save_png
from facepipe.rig.trs import rotation_matrices
from facepipe.stage import Face
from facepipe.verbs.blend import BlendSession, Weights
from facepipe.verbs.blend.graph import mix

HERE = Path(__file__).resolve().parent
MODEL = HERE.parents[1] / "shared/data/ict_facekit/ict_facekit.npz"
AXIS, MOVE = np.array([0.3, 1.0, 0.2]), np.array([0.3, 0.3, 0.265])  # 5.0 mm


def identity(seed: int) -> FaceParts:
    """An ICT head without expressions, which the picture has no use for."""
    parts = load("ict", MODEL, Options(identity_seed=seed)).parts
    return replace(parts, meshes=tuple(replace(mesh, blendshapes=()) for mesh in parts.meshes))


def misaligned(parts: FaceParts, degrees: float = 3.0) -> FaceParts:
    """The same head elsewhere."""
    half = np.radians(degrees) / 2
    turn = rotation_matrices(np.array([*(np.sin(half) * AXIS / np.linalg.norm(AXIS)), np.cos(half)]))
    return replace(parts, meshes=tuple(replace(mesh, points=mesh.points @ turn.T + MOVE) for mesh in parts.meshes))


def main() -> None:
    """Blend, draw, save."""
    first, second = identity(1), misaligned(identity(3))
    session = BlendSession([Face.from_parts(first), Face.from_parts(second)])
    own = (0.0, 1.0)
    neutral = session.neutral(Weights(regions={"eyes": own, "eyebrows": own, "mouth": own}, default=(1.0, 0.0)))
    panels: dict[str, FloatArray] = {
        "A": session.sources.points[0],
        "B, 5 mm and 3° off": session.sources.points[1],
        "points averaged by region": mix(neutral.shares, session.sources.points),
        "facepipe blend": neutral.points,
    }
    options = PictureOptions(size=640, view="three-quarter")
    pictures = [(caption, picture(first, points, options)) for caption, points in panels.items()]
    save_png(contact_sheet(pictures, columns=4), HERE / "blend.png")


if __name__ == "__main__":
    main()
