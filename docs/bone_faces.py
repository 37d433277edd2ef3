"""Faces that bone_tables.py and bones_picture.py fit: MakeHuman (CC0) and ICT-FaceKit (MIT license)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

import facepipe
from facepipe.importers import ict, load, makehuman
from facepipe.stage import Face, save_parts
from facepipe.verbs.skin import SkinFace, SkinReport

HERE = Path(__file__).resolve().parent
DATA = HERE.parents[1] / "shared" / "data"
LIMITS = HERE / "face_bones.json"  # the face's joints alone, in wide limits
MAKEHUMAN, ICT = "makehuman/makehuman_head.npz", "ict_facekit/ict_facekit.npz"
PARTS = ("nose", "mouth", "chin", "cheek", "forehead", "eyebrows", "eyes")  # three targets of each make a person
PEOPLE = 10


def makehuman_face(data: Path, out: Path, options: makehuman.Options) -> Face:
    """The MakeHuman head, imported and saved."""
    save_parts(load("makehuman", data / MAKEHUMAN, options).parts, out)
    return facepipe.open(out)


def ict_face(data: Path, out: Path, seed: int | None = None) -> Face:
    """An ICT-FaceKit head, imported and saved."""
    save_parts(load("ict", data / ICT, ict.Options(identity_seed=seed)).parts, out)
    return facepipe.open(out)


def skinned(face: Face, source: Face, out: Path, *, optimise: bool = False) -> tuple[Face, SkinReport]:
    """A face with the bones of another."""
    with face.deriving(out) as result:
        report = SkinFace(source=source, optimise=optimise)(result)
    return facepipe.open(out), report


def people(data: Path, folder: Path) -> Iterator[str]:
    """Files of MakeHuman heads, each with random targets of all parts of the face."""
    with np.load(data / MAKEHUMAN) as arrays:
        names = [str(name) for name in arrays["target_names"]]
    for seed in range(PEOPLE):
        random = np.random.default_rng(seed)
        chosen: dict[str, float] = {}
        for part in PARTS:
            own = [name for name in names if name.startswith(f"{part}/")]
            chosen |= {str(name): float(random.uniform(0.2, 0.8)) for name in random.choice(own, 3, replace=False)}
        file = folder / f"makehuman{seed}.usdc"
        makehuman_face(data, file, makehuman.Options(targets=chosen))
        yield str(file)
