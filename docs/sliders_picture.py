"""Draws docs/sliders.png: `python docs/sliders_picture.py`. A person of the sample, and some of its sliders."""

from __future__ import annotations

import tempfile
from pathlib import Path

from PIL import Image

import facepipe
from facepipe.pictures import contact_sheet, save_png

SEED = 3
SET = {
    "as drawn": {},
    "noseWidth 1, noseLength 1": {"noseWidth": 1.0, "noseLength": 1.0},
    "jawWidth 1, strongJaw 1": {"jawWidth": 1.0, "strongJaw": 1.0},
    "age 1, eyeTilt -1": {"age": 1.0, "eyeTilt": -1.0},
    "smile 1, lookLeft 1": {"smile": 1.0, "lookLeft": 1.0},
}


def main() -> None:
    """Set sliders, draw, save."""
    pictures = []
    with tempfile.TemporaryDirectory() as name:
        head, person = Path(name) / "head.usdc", Path(name) / "person.usda"
        facepipe.sample(head, seed=SEED, textures=1024)
        for label, values in SET.items():
            if values:
                facepipe.sliders(head, values=values, out=person, overwrite=True)
            drawn = Path(name) / f"{len(pictures)}.png"
            facepipe.render(person if values else head, out=drawn, view="three-quarter", size=330)
            pictures.append((label, Image.open(drawn)))
    save_png(contact_sheet(pictures, columns=len(pictures)), Path(__file__).resolve().parent / "sliders.png")


if __name__ == "__main__":
    main()
