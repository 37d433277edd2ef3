"""Draws docs/rebuild_scan.png: `python docs/rebuild_picture.py`. Needs ../shared/data.

ICT-FaceKit (MIT license) fitted to "Infinite, 3D Head Scan" by Lee Perry-Smith (CC-BY 3.0, based on a work at
www.triplegangers.com; www.ir-ltd.net), with 60 people made of ICT-FaceKit's modes as database and 20 landmarks placed
by hand (docs/rebuild_landmarks.json). The scan has closed eyes; the last picture is the neutral, with open ones.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

from PIL import Image

from facepipe.cli import main
from facepipe.importers import ict, load
from facepipe.pictures import save_png
from facepipe.scanning.database import create_database, save_database
from facepipe.verbs.whole_faces import WholeFace, whole_face

HERE = Path(__file__).parent
DATA = HERE.parent.parent / "shared" / "data"
PEOPLE = 60
WIDTH = 900


def person(seed: int) -> WholeFace:
    """The neutral of an ICT identity with all 100 modes."""
    parts = load("ict", DATA / "ict_facekit" / "ict_facekit.npz", ict.Options(identity_seed=seed)).parts
    neutral = replace(parts, meshes=tuple(replace(mesh, blendshapes=()) for mesh in parts.meshes))
    return whole_face(neutral, f"person{seed}")


def draw(folder: Path) -> Image.Image:
    """The sheet of the fit, made smaller."""
    head, faces, out, sheet = (str(folder / name) for name in ("head.usdc", "faces.fpdb", "person.usda", "sheet.png"))
    save_database(create_database([partial(person, seed) for seed in range(PEOPLE)]).database, Path(faces))
    main(["import", "ict", str(DATA / "ict_facekit" / "ict_facekit.npz"), head])
    scan, marks = str(DATA / "scans" / "LeePerrySmith.glb"), str(HERE / "rebuild_landmarks.json")
    given = ["--template", head, "--database", faces, "--landmarks", marks]
    shown = ["--weights", "eyeBlink_L=1", "eyeBlink_R=1"]
    main(["fit-neutral", scan, *given, *shown, "-o", out, "--picture", sheet])
    image = Image.open(sheet).convert("RGB")
    return image.resize((WIDTH, round(image.height * WIDTH / image.width)), Image.Resampling.LANCZOS)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        save_png(draw(Path(name)), HERE / "rebuild_scan.png")
