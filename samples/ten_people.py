"""Background characters: people of the head in the box as GLBs, and a sheet of who they are.

usage: python samples/ten_people.py FOLDER [COUNT [TEXELS]]

COUNT people (default 10), another with each seed from 1; TEXELS a side of their textures (default 1024), 0 for none.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

import facepipe

SIDE = 320  # pixels of a picture


def person(folder: Path, seed: int, texels: int) -> Path:
    """The picture of a person whose stage and GLB are written beside it."""
    stage = folder / f"person_{seed:02}.usdc"
    facepipe.sample(stage, seed=seed, textures=texels, overwrite=True)
    report = facepipe.export(stage, stage.with_suffix(".glb"), engine="generic", overwrite=True)
    print(f"{report.path}: {report.bytes:,} bytes", *report.dropped, sep="\n  ")
    picture = stage.with_suffix(".png")
    facepipe.render(stage, out=picture, view="three-quarter", size=SIDE, overwrite=True)
    return picture


def sheet(pictures: list[Path], columns: int = 5) -> Image.Image:
    """The pictures in rows."""
    rows = -(-len(pictures) // columns)
    whole = Image.new("RGB", (SIDE * min(columns, len(pictures)), SIDE * rows), "white")
    for number, file in enumerate(pictures):
        with Image.open(file) as picture:
            whole.paste(picture.convert("RGB"), (SIDE * (number % columns), SIDE * (number // columns)))
    return whole


def main(words: list[str]) -> int:
    """The exit code."""
    if not 1 <= len(words) <= 3:
        print(__doc__, file=sys.stderr)
        return 2
    folder = Path(words[0])
    count = int(words[1]) if len(words) > 1 else 10
    texels = int(words[2]) if len(words) > 2 else 1024
    folder.mkdir(parents=True, exist_ok=True)
    sheet([person(folder, seed, texels) for seed in range(1, count + 1)]).save(folder / "people.png")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
