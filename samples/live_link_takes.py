"""A day's recordings on a character: every take of Live Link Face becomes a clip, all of them go into one GLB.

usage: python samples/live_link_takes.py FACE TAKES OUT.glb

TAKES is a folder of .csv files as the app sends them; each becomes an animation that is called as its file. A stage
FACE_takes.usda beside OUT keeps them: it stands over FACE, so that a change of the face reaches the clips too.
"""

from __future__ import annotations

import sys
from pathlib import Path

import facepipe


def perform(face: Path, takes: list[Path], stage: Path) -> Path:
    """The last of the stages that each put one take more on the face; it is `stage`."""
    for number, take in enumerate(takes, 1):
        out = stage if number == len(takes) else stage.with_stem(f"{stage.stem}_{number}")
        report = facepipe.animate(face, take, out=out, overwrite=True)
        print(f"{take.name}: {report.frames} frames at {report.frames_per_second:g} fps")
        for name, why in report.no_target.items():
            print(f"  {name}: {why}")
        face = out
    return face


def main(words: list[str]) -> int:
    """The exit code."""
    if len(words) != 3:
        print(__doc__, file=sys.stderr)
        return 2
    face, folder, out = map(Path, words)
    takes = sorted(folder.glob("*.csv"))
    if not takes:
        print(f"{folder}: no takes, expected .csv files", file=sys.stderr)
        return 2
    try:
        stage = perform(face, takes, out.with_name(f"{face.stem}_takes.usda"))
        report = facepipe.export(stage, out, animations=True, overwrite=True)
    except facepipe.FacepipeError as error:
        print(error, file=sys.stderr)
        return 2
    print(f"{out}: {report.bytes:,} bytes, {len(takes)} clips")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
