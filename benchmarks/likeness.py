"""How alike portraits and the people that facepipe makes of them are, to a face recogniser.

`fit-photo` fits the built-in head to each portrait, `bake-photo` gives it the photo's skin, and dlib, which stays in an
environment of its own, judges pictures of that:

    python3.11 -m venv dlib-env && dlib-env/bin/pip install dlib-bin numpy face_recognition_models "setuptools<81"
    python benchmarks/likeness.py --dlib dlib-env/bin/python [--portraits obama biden] [--others 10] [--size 1024]
        [--folder FOLDER] [--together] [--processes 2] [--json out.json]

Figures are distances of face descriptors; below 0.6 dlib takes two pictures for one person's. Looks: with the photo's
skin; with that of the average head, as `fit-photo` leaves it; and the average head in place of the person, with either
skin and with the expression that the person has in the photo. Lines:

  camera          the render in the photo's camera and light, without hair, on grey, to the photo
  camera, masked  the same where both are the same grey off the face that the render shows: hair, ears, neck, what is
                  behind
  front, yaw      the neutral in studio light, from the front and the sides; with the photo's skin its hair has the
                  style of the built-in head that is nearest to the photo's, else that of the average head
  other photo     the front to other photos of the same person (the mean of them)
  margin          by how much another photo is nearer to the front than to that of anyone else (the least)
  look-alikes     the same of the photo itself: above 0 the person is known among the three most alike. Anyone else are
                  the other portraits' people, and others that are drawn from the head in the box

With `--together` people with three portraits or more are made of all but one of them at once, too: how near the front
is to the one left out, beside the fronts of the others alone.

Blank: no face was found, or there is none to compare. Neutrals: narrow face, after similarity, from points to surface.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from arguments import positive
from children import ChildError, Json, run_child
from likeness_pictures import (
    CAMERA,
    LOOKS,
    MASKED,
    MEAN,
    MEAN_TEXTURED,
    PHOTO,
    TEXTURED,
    UNTEXTURED,
    YAWS,
    Made,
    made,
    other,
    together,
)
from likeness_portraits import portraits
from narrow_face import apart, narrow_triangles
from tables import aligned

import facepipe
from facepipe.core.arrays import FloatArray, IntArray

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
CACHE = Path.home() / ".cache" / "facepipe"
OTHER_PHOTO, MARGIN, LOOK_ALIKES = "other photo", "margin", "look-alikes"
LINES = (CAMERA, MASKED, *YAWS, OTHER_PHOTO, MARGIN, LOOK_ALIKES)
SKINS = {TEXTURED: TEXTURED, UNTEXTURED: UNTEXTURED, MEAN_TEXTURED: TEXTURED, MEAN: UNTEXTURED}  # of others, by look

Descriptors = Mapping[Path, FloatArray | None]  # of pictures; None: no face found
Figures = dict[str, dict[str, dict[str, float | None]]]  # line -> look -> portrait


def main() -> int:
    """Fit, bake, draw, judge, print; 2 where portraits or dlib are not to be had."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dlib", required=True, metavar="PYTHON", help="an interpreter with dlib")
    parser.add_argument("--portraits", nargs="+", metavar="NAME", help="of these alone (default all)")
    parser.add_argument("--others", type=positive, default=10, help="people drawn from the head (default 10)")
    parser.add_argument("--size", type=positive, default=1024, help="texels a side that are baked (default 1024)")
    parser.add_argument("--folder", type=Path, help="keep stages and pictures here; fits that are there stay")
    parser.add_argument("--together", action="store_true", help="also make people of several portraits at once")
    parser.add_argument("--processes", type=positive, default=2, help="people at a time (default 2)")
    parser.add_argument("--data", type=Path, default=DATA, help="default ../shared/data beside the repository")
    parser.add_argument(
        "--cache", type=Path, default=CACHE, help="where portraits are kept (default ~/.cache/facepipe)"
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as passing:
        folder = arguments.folder or Path(passing)
        folder.mkdir(parents=True, exist_ok=True)
        try:
            people, others, joint = _made(arguments, folder)
            pictures = [person.photo for person in people] + [one for each in others for one in each.values()]
            pictures += [picture for person in people for picture in person.pictures.values()] + [*joint.values()]
            seen = run_child(arguments.dlib, Path(__file__).with_name("dlib_faces.py"), *pictures, folder / "seen.json")
        except (ChildError, OSError) as error:
            print(error, file=sys.stderr)
            return 2
    rows = [None if row is None else np.array(row) for row in seen["descriptors"]]
    descriptors = dict(zip(pictures, rows, strict=True))
    result = {
        "lines": judged(people, others, descriptors),
        "together": left_out(people, joint, descriptors),
        "neutrals": neutral_distances(people, narrow_triangles()),
        "not_found": [picture.name for picture, row in descriptors.items() if row is None],
        "seconds": {person.portrait.name: dict(person.seconds) for person in people},
        "dlib": seen["version"],
    }
    print(table(result))
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return 0


def _made(arguments: argparse.Namespace, folder: Path) -> tuple[list[Made], list[dict[str, Path]], dict[str, Path]]:
    """The people of the portraits, pictures of others, and of people made of all their portraits but one, by its name.

    Several at a time, in processes of one thread.
    """
    wanted = portraits(arguments.data, arguments.cache)
    if arguments.portraits:
        wanted = [portrait for portrait in wanted if portrait.name in arguments.portraits]
    head = folder / "head.usdc"
    if not head.is_file():
        facepipe.sample(head)
    os.environ.update({"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"})
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        people = [pool.submit(made, portrait, head, folder, arguments.size) for portrait in wanted]
        others = [pool.submit(other, seed, folder, arguments.size) for seed in range(1, arguments.others + 1)]
        joint = {
            portrait.name: pool.submit(together, rest, head, folder, arguments.size)
            for portrait in (wanted if arguments.together else [])
            if len(rest := [each for each in wanted if each.person == portrait.person and each is not portrait]) > 1
        }
        pictures = {name: front.result() for name, front in joint.items()}
        return [person.result() for person in people], [each.result() for each in others], pictures


def judged(people: Sequence[Made], others: Sequence[Mapping[str, Path]], seen: Descriptors) -> Figures:
    """The figures of every line."""
    figures: Figures = {line: {look: {} for look in LOOKS} for line in LINES}
    for person in people:
        for look in LOOKS:
            shown = {line: person.pictures[line, look] for line in (CAMERA, MASKED, PHOTO, *YAWS)}
            again = [each.photo for each in people if _same(each, person) and each is not person]
            strangers = [each.pictures["front", look] for each in people if not _same(each, person)]
            strangers += [each[SKINS[look]] for each in others]
            values = {line: _apart(seen, shown[line], person.photo) for line in (CAMERA, *YAWS)}
            values[MASKED] = _apart(seen, shown[MASKED], shown[PHOTO])
            apart = _known(_apart(seen, shown["front"], photo) for photo in again)
            values[OTHER_PHOTO] = float(np.mean(apart)) if apart else None
            if look != MEAN:  # which is the same for everyone
                margins = _known(_margin(seen, photo, shown["front"], strangers) for photo in again)
                values[MARGIN] = min(margins, default=None)
                values[LOOK_ALIKES] = _margin(seen, person.photo, shown["front"], strangers)
            for line in LINES:
                figures[line][look][person.portrait.name] = values.get(line)
    return figures


def left_out(people: Sequence[Made], joint: Mapping[str, Path], seen: Descriptors) -> list[Json]:
    """How near a photo is to the front of its person made of the others together, and of each of them alone.

    :param joint: front pictures of people made of all their portraits but one, by its name
    """
    rows = []
    for person in people:
        if person.portrait.name in joint:
            alone = [each.pictures["front", TEXTURED] for each in people if _same(each, person) and each is not person]
            found = [_apart(seen, front, person.photo) for front in (joint[person.portrait.name], *alone)]
            rows.append({"portrait": person.portrait.name, "together": found[0], "alone": found[1:]})
    return rows


def _same(one: Made, other: Made) -> bool:
    return one.portrait.person == other.portrait.person


def _known(values: Iterable[float | None]) -> list[float]:
    return [value for value in values if value is not None]


def _apart(seen: Descriptors, one: Path, other: Path) -> float | None:
    """The distance of two pictures' descriptors; None: of one there is none."""
    first, second = seen[one], seen[other]
    return None if first is None or second is None else float(np.linalg.norm(first - second))


def _margin(seen: Descriptors, photo: Path, own: Path, strangers: Sequence[Path]) -> float | None:
    """By how much a photo is nearer to a person's own picture than to the nearest of strangers."""
    near, apart = _apart(seen, own, photo), _known(_apart(seen, each, photo) for each in strangers)
    return None if near is None or not apart else min(apart) - near


def neutral_distances(people: Sequence[Made], triangles: IntArray) -> list[Json]:
    """Millimetres between the neutrals of every two portraits, and whether they are of one person.

    :param triangles: (t, 3) of the narrow face
    """
    return [
        {
            "portraits": [one.portrait.name, other.portrait.name],
            "same": _same(one, other),
            "mm": apart(one.narrow, other.narrow, triangles).surface,
        }
        for one, other in combinations(people, 2)
    ]


def table(result: Json) -> str:
    """The figures for people."""
    names = list(result["seconds"])
    rows = [("line", "look", *names, "mean", "worst")]
    for line, looks in result["lines"].items():
        for look, figures in looks.items():
            known = _known(figures.values())
            if known:
                worst = (min if line in (MARGIN, LOOK_ALIKES) else max)(known)
                values = [*(figures[name] for name in names), float(np.mean(known)), worst]
                rows.append((line, look, *("" if value is None else f"{value:.3f}" for value in values)))
    lines = [*aligned(rows), "", *_right(result["lines"][LOOK_ALIKES]), *_neutrals(result["neutrals"])]
    for row in result["together"]:
        figures = ["none" if value is None else f"{value:.3f}" for value in (row["together"], *row["alone"])]
        lines.append(f"the others together to {row['portrait']}: {figures[0]}, each alone {', '.join(figures[1:])}")
    for step in ("fit-photo", "bake-photo"):
        seconds = [each[step] for each in result["seconds"].values() if step in each]
        if seconds:
            lines.append(f"{step}: {np.mean(seconds):.1f} s of processor time, at most {max(seconds):.1f}")
    if result["not_found"]:
        lines.append(f"no face found: {', '.join(result['not_found'])}")
    return "\n".join(lines)


def _right(looks: Mapping[str, Mapping[str, float | None]]) -> list[str]:
    counts = {look: _known(figures.values()) for look, figures in looks.items()}
    shares = [f"{sum(value > 0 for value in known)} of {len(known)} {look}" for look, known in counts.items() if known]
    return [f"known among look-alikes: {', '.join(shares)}"] if shares else []


def _neutrals(pairs: Sequence[Json]) -> list[str]:
    """The distances of neutrals of one person, and of different ones."""
    same, different = ([pair["mm"] for pair in pairs if pair["same"] is one] for one in (True, False))
    lines = []
    if same:
        lines.append(f"neutrals of one person: {np.mean(same):.2f} mm apart, at most {max(same):.2f}")
    if different:
        lines.append(f"neutrals of different people: {np.mean(different):.2f} mm apart, at least {min(different):.2f}")
    if same and different:
        closer = sum(value < min(different) for value in same)
        lines.append(f"pairs of one person closer than any other: {closer} of {len(same)}")
    return lines


if __name__ == "__main__":
    sys.exit(main())
