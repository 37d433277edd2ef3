"""Draws docs/photo.png: `python docs/photo_picture.py`. Needs chromium, ../shared/data and the extra `train`.

The report page of the sample head fitted to a portrait of Eileen Collins (NASA, public domain) with its landmarks.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

from PIL import Image, ImageChops

from facepipe.cli import main
from facepipe.pictures import save_png

HERE = Path(__file__).parent
PHOTOS = HERE.parent.parent / "shared" / "data" / "photos"
SIZE = (1240, 4000)  # pixels, more than the page is high


def draw(folder: Path) -> Image.Image:
    """The page as a browser shows it."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit("needs chromium on the PATH")
    photo, marks = PHOTOS / "astronaut.png", PHOTOS / "astronaut.landmarks.json"
    head, out, report = (str(folder / name) for name in ("head.usda", "person.usda", "report"))
    main(["sample", head])
    main(["fit-photo", str(photo), head, "--landmarks", str(marks), "-o", out, "--report", report])
    shot, size = folder / "shot.png", f"--window-size={SIZE[0]},{SIZE[1]}"
    plain = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars")
    page = (Path(report) / "report.html").as_uri()
    subprocess.run([browser, *plain, size, f"--screenshot={shot}", page], check=True, capture_output=True)
    image = Image.open(shot).convert("RGB")
    used = ImageChops.difference(image, Image.new("RGB", image.size, "white")).getbbox()
    return image.crop((0, 0, image.width, min(image.height, (used[3] if used else 0) + 36)))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        save_png(draw(Path(name)), HERE / "photo.png")
