"""Draws docs/scan_face.png: `python docs/scan_picture.py`. Needs ../shared/data and the extra `train`.

"Infinite, 3D Head Scan" by Lee Perry-Smith (CC-BY 3.0, based on a work at www.triplegangers.com; www.ir-ltd.net), and
the face that `facepipe fit-neutral` makes of it, with nothing else given.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import facepipe
from facepipe.cli import main
from facepipe.geometry.similarity import robust_similarity
from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_landmarks import read_scan_landmarks
from facepipe.parts import FaceParts, Material, Mesh
from facepipe.pictures import PictureOptions, contact_sheet, picture, save_png
from facepipe.pictures.camera import View, portrait
from facepipe.stage import Face

HERE = Path(__file__).resolve().parent
SCAN = HERE.parent.parent / "shared" / "data" / "scans" / "LeePerrySmith.glb"
SIZE = 300  # pixels a side of each picture
NECK = 3.0  # cm below the chin that pictures show
VIEWS: tuple[View, ...] = ("front", "three-quarter", "side")
POSES = {
    "jawOpen": {"jawOpen": 0.7},
    "smile": {f"{name}{side}": 0.8 for name in ("mouthSmile", "cheekSquint") for side in ("Left", "Right")},
    "blink": {f"eyeBlink{side}": 1.0 for side in ("Left", "Right")},
}


def made(folder: Path) -> tuple[FaceParts, Face]:
    """The scan laid on the face, and the face."""
    marks, out = folder / "marks.json", folder / "face.usda"
    main(["scan-landmarks", str(SCAN), "-o", str(marks)])
    main(["fit-neutral", str(SCAN), "--landmarks", str(marks), "-o", str(out)])
    face, scan = facepipe.open(out), read_scan(SCAN)
    head = face.meshes[0]
    place = robust_similarity(read_scan_landmarks(marks).points, head.points[head.landmarks["multipie68"].indices])
    mesh = Mesh(
        name="Scan",
        points=place.apply(scan.points),
        face_vertex_counts=np.full(len(scan.triangles), 3, np.int32),
        face_vertex_indices=scan.triangles.ravel(),
        material="Clay",
    )
    clay = Material(name="Clay", diffuse_color=(0.5, 0.48, 0.46), roughness=0.7)
    return FaceParts(name="Scan", meters_per_unit=face.meters_per_unit, meshes=(mesh,), materials=(clay,)), face


def draw(scan: FaceParts, face: Face) -> Image.Image:
    """The sheet."""
    rest, parts = face.evaluate(), face.parts()
    chin = face.meshes[0].points[face.meshes[0].landmarks["multipie68"].indices[8], 1]
    framed = rest[rest[:, 1] > chin - NECK]
    cameras = {view: PictureOptions(size=SIZE, camera=portrait(framed, view, SIZE, SIZE)) for view in VIEWS}
    pictures = []
    for view in ("front", "three-quarter"):
        pictures.append(("the scan", picture(scan, None, cameras[view])))
        pictures.append(("the face", picture(parts, rest, cameras[view])))
    pictures.append(("from the side", picture(parts, rest, cameras["side"])))
    for name, weights in POSES.items():
        view = "three-quarter" if name == "smile" else "front"
        pictures.append((name, picture(parts, face.evaluate(weights), cameras[view])))
    return contact_sheet(pictures, columns=4)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        save_png(draw(*made(Path(name))), HERE / "scan_face.png")
