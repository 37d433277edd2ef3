"""Draws docs/looks.png: `python docs/looks_picture.py`. The average head in every style of hair, and tones of skin."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from facepipe.heads.assembly import make_head
from facepipe.heads.people import MODES, STYLES, Look
from facepipe.heads.surfaces import dressed
from facepipe.pictures import PictureOptions, contact_sheet, picture, save_png

HERE = Path(__file__).resolve().parent
HAIRS = ("dark", "dark", "brown", "grey", "red", "blond", "black")
EYES = ("green", "brown", "blue", "grey", "hazel", "blue", "dark")
TONES = (2.0, 7.0, 3.0, 5.0, 1.0, 4.0, 9.0)


def main() -> None:
    """Dress, draw, save."""
    bare = make_head(np.zeros(MODES))
    pictures = []
    for style, tone, hair, eyes in zip(STYLES, TONES, HAIRS, EYES, strict=True):
        look = Look(tone=tone, style=style, hair=hair, eyes=eyes, beard=0.5 * (style == "stubble"), freckles=0.5)
        options = PictureOptions(size=300, view="three-quarter" if len(pictures) % 2 else "front")
        pictures.append((f"{style}, tone {tone:g}", picture(dressed(bare, look, 1024), None, options)))
    save_png(contact_sheet(pictures, columns=4), HERE / "looks.png")


if __name__ == "__main__":
    main()
