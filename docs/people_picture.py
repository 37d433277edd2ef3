"""Draws docs/people.png: `python docs/people_picture.py`. Twelve people of `facepipe sample`."""

from __future__ import annotations

from pathlib import Path

from facepipe.heads import make
from facepipe.pictures import PictureOptions, contact_sheet, picture, save_png

SEEDS = range(1, 13)


def main() -> None:
    """Draw them, front and turned in turns, and save."""
    pictures = []
    for seed in SEEDS:
        options = PictureOptions(size=300, view="three-quarter" if seed % 2 else "front")
        pictures.append((f"seed {seed}", picture(make(seed, textures=1024), None, options)))
    save_png(contact_sheet(pictures, columns=6), Path(__file__).resolve().parent / "people.png")


if __name__ == "__main__":
    main()
