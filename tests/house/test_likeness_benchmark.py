"""The benchmark of likeness: how it judges pictures by their descriptors, and what it says of what is missing."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from benchmark_modules import BENCHMARKS
from likeness import judged, left_out, main, neutral_distances, table
from likeness_bound import distances
from likeness_pictures import CAMERA, LOOKS, MASKED, MEAN, PHOTO, TEXTURED, UNTEXTURED, YAWS, Made
from likeness_portraits import Portrait

pytestmark = pytest.mark.needs_torch

GRID = np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0), [0.0]), axis=-1).reshape(-1, 3)
TRIANGLES = np.array([(i, j, i + 5) for i in (0, 1, 2, 4, 5, 6, 8, 9, 10) for j in (i + 1, i + 4)])


def person(name: str, narrow: np.ndarray = GRID) -> Made:
    """Made of a portrait that is called as the person is, and by a number."""
    lines = [(line, look) for look in LOOKS for line in (CAMERA, MASKED, PHOTO, *YAWS)]
    return Made(
        portrait=Portrait(name=name, person=name.rstrip("0123456789"), path=Path(name)),
        photo=Path(f"{name}/photo"),
        pictures={key: Path(name, *key) for key in lines},
        narrow=narrow,
        seconds={"bake-photo": 2.0},
    )


def seen(places: dict[str, float]) -> dict[Path, np.ndarray | None]:
    """Descriptors on a line, of all pictures of portraits and others; of those without a place there is none."""
    keys = [person(name).pictures.values() for name in ("ann", "ann2", "bob")]
    pictures = [
        *(picture for each in keys for picture in each),
        *(Path(f"{name}/photo") for name in ("ann", "ann2", "bob")),
    ]
    return {**dict.fromkeys([*pictures, Path("seed")]), **{Path(name): np.array([at]) for name, at in places.items()}}


def test_a_front_is_compared_with_photos_of_the_person_and_with_other_people() -> None:
    people, other = (
        [person(name) for name in ("ann", "ann2", "bob")],
        {TEXTURED: Path("seed"), UNTEXTURED: Path("seed")},
    )
    photos = {"ann/photo": 0.0, "ann2/photo": 0.1, "bob/photo": 2.0}
    fronts = {"ann/front/textured": 0.3, "ann2/front/textured": 0.1, "bob/front/textured": 0.9, "seed": 0.55}
    lines = judged(people, [other], seen({**photos, **fronts}))
    assert lines["front"][TEXTURED] == pytest.approx({"ann": 0.3, "ann2": 0.0, "bob": 1.1})
    assert lines["other photo"][TEXTURED] == {"ann": pytest.approx(0.2), "ann2": pytest.approx(0.1), "bob": None}
    assert lines["margin"][TEXTURED] == {"ann": pytest.approx(0.25), "ann2": pytest.approx(0.45), "bob": None}
    assert lines["look-alikes"][TEXTURED] == pytest.approx({"ann": 0.25, "ann2": 0.45, "bob": 0.35})
    assert set(lines["front"][UNTEXTURED].values()) == {None}, "no face was found"
    assert set(lines["look-alikes"][MEAN].values()) == {None}, "it is the same for everyone"


def test_the_masked_render_is_compared_with_the_photo_under_the_same_mask() -> None:
    places = {"ann/photo": 5.0, "ann/photo, masked/textured": 1.0, "ann/camera, masked/textured": 1.25}
    assert judged([person("ann")], [], seen(places))["camera, masked"][TEXTURED] == {"ann": 0.25}


def test_people_made_of_several_portraits_are_judged_by_the_one_left_out() -> None:
    people = [person(name) for name in ("ann", "ann2", "bob")]
    places = {"ann2/photo": 0.0, "ann/front/textured": 0.5, "seed": 0.25}
    assert left_out(people, {"ann2": Path("seed")}, seen(places)) == [
        {"portrait": "ann2", "together": 0.25, "alone": [0.5]}
    ]


def test_neutrals_are_compared_after_similarity() -> None:
    turned = 2.5 * GRID @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]] + 7
    bent = GRID + [0, 0, 1] * (GRID[:, :1] == 0)
    same, *different = neutral_distances([person("ann"), person("ann2", turned), person("bob", bent)], TRIANGLES)
    assert (same["same"], same["mm"]) == (True, pytest.approx(0, abs=1e-9))
    assert [pair["same"] for pair in different] == [False, False]
    assert min(pair["mm"] for pair in different) > 0.05


def test_the_table_shows_means_and_worst() -> None:
    lines = {line: {TEXTURED: {"ann": 0.25, "bob": 0.5}} for line in ("front", "look-alikes")}
    pair = {"portraits": ["ann", "bob"], "same": False, "mm": 1.5}
    seconds = {"ann": {"bake-photo": 2.0}, "bob": {"bake-photo": 4.0}}
    printed = table(
        {
            "lines": lines,
            "neutrals": [pair],
            "seconds": seconds,
            "not_found": ["x.png"],
            "together": [{"portrait": "ann", "together": 0.25, "alone": [0.5, None]}],
        }
    )
    assert "the others together to ann: 0.250, each alone 0.500, none" in printed
    rows = [line.split() for line in printed.splitlines()]
    assert ["front", "textured", "0.250", "0.500", "0.375", "0.500"] in rows
    assert ["look-alikes", "textured", "0.250", "0.500", "0.375", "0.250"] in rows
    assert "known among look-alikes: 2 of 2 textured" in printed
    assert "different people: 1.50 mm apart, at least 1.50" in printed
    assert "no face found: x.png" in printed


def test_it_says_what_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--dlib", "python", "--data", str(tmp_path), "--cache", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [str(BENCHMARKS / "likeness.py"), *words])
    assert main() == 2
    assert "astronaut.png: no such file" in capsys.readouterr().err


def test_a_true_portrait_is_compared_where_both_pictures_show_a_face() -> None:
    front, photo, lost = Path("front"), Path("photo"), Path("lost")
    pairs = [("front", front, photo), ("front", front, lost), ("photos", photo, lost), ("yaw", photo, front)]
    values = distances(pairs, {front: np.array([0.0]), photo: np.array([0.25])})
    assert values == {"front": [0.25], "yaw": [0.25]}
