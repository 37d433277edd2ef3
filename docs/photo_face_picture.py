"""Draws docs/photo_face.png: `python docs/photo_face_picture.py`. Needs ../shared/data and the extra `train`.

A portrait of Eileen Collins (NASA, public domain), and the face that `fit-photo` and `bake-photo` make of it, with
nothing else given.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from PIL import Image

import facepipe
from facepipe.pictures import PictureOptions, contact_sheet, picture, save_png
from facepipe.pictures.camera import View, portrait
from facepipe.stage import Face

HERE = Path(__file__).resolve().parent
PHOTO = HERE.parent.parent / "shared" / "data" / "photos" / "astronaut.png"
SIZE = 300  # pixels a side of each picture
BOX = (140, 0, 320, 180)  # of the head in the photo, pixels
VIEWS: tuple[View, ...] = ("front", "three-quarter", "side")
NECK = 6.0  # cm below the chin that pictures show
SMILE = {f"{name}{side}": 0.7 for name in ("mouthSmile", "cheekSquint", "mouthUpperUp") for side in ("Left", "Right")}


def made(folder: Path) -> Face:
    """The person."""
    head, fitted, out = (folder / f"{name}.usda" for name in ("head", "fitted", "person"))
    facepipe.sample(head)
    facepipe.fit_photo(head, photos=[PHOTO], out=fitted)
    facepipe.bake_photo(fitted, photos=[PHOTO], out=out)
    return facepipe.open(out)


def draw(face: Face) -> Image.Image:
    """The sheet."""
    neutral, parts = face.evaluate(pose="set"), face.parts()
    chin = neutral[face.meshes[0].landmarks["multipie68"].indices[8], 1]
    framed = neutral[neutral[:, 1] > chin - NECK]
    cameras = {view: PictureOptions(size=SIZE, camera=portrait(framed, view, SIZE, SIZE)) for view in VIEWS}
    photo = Image.open(PHOTO).convert("RGB").crop(BOX).resize((SIZE, SIZE), Image.Resampling.LANCZOS)
    pictures = [("the photo", photo)]
    pictures += [(view, picture(parts, neutral, cameras[view])) for view in VIEWS]
    smiling = neutral + face.evaluate(SMILE) - face.evaluate({})
    return contact_sheet([*pictures, ("smiling", picture(parts, smiling, cameras["front"]))], columns=5)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        save_png(draw(made(Path(name))), HERE / "photo_face.png")
