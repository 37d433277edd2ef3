"""Draws docs/photo.png: `python docs/photo_picture.py`. Needs ../shared/data and `pip install 'facepipe[train]'`.

The report sheet of the sample head fitted to a portrait of Eileen Collins (NASA, public domain) with its landmarks.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from PIL import Image

from facepipe.cli import main
from facepipe.pictures import save_png

HERE = Path(__file__).parent
PHOTOS = HERE.parent.parent / "shared" / "data" / "photos"
WIDTH = 1200


def draw(folder: Path) -> Image.Image:
    """The sheet, at half its size."""
    photo, marks = PHOTOS / "astronaut.png", PHOTOS / "astronaut.landmarks.json"
    head, out, report = (str(folder / name) for name in ("head.usda", "person.usda", "report"))
    main(["sample", head])
    main(["fit-photo", str(photo), head, "--landmarks", str(marks), "-o", out, "--report", report])
    sheet = Image.open(Path(report) / "sheet.png").convert("RGB")
    return sheet.resize((WIDTH, round(sheet.height * WIDTH / sheet.width)), Image.Resampling.LANCZOS)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        save_png(draw(Path(name)), HERE / "photo.png")
