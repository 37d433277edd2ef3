"""Renders random heads that change their looks: ``python training/features_heads.py OUT --count 4650 --seed 1``.

As `heads.py`, but every picture of a person has another skin, hair, brows and stubble: what its pictures share is the
shape of the head alone, which is what the identity features shall show. The crop is nearly the aligned one. The arrays
of a shard are those of `heads.py`, and

- ``neutral`` (n, 68, 3) float32: landmarks of the person's neutral, centred, in units of their root mean square
  distance from the centre
"""

from __future__ import annotations

import argparse

import head_sources
import heads
import numpy as np
import scenes
from script_arguments import add_shards

from facepipe.heads.asset import asset
from facepipe.pictures.scene import build_scene

SHARD = 150  # pictures
_FIRST = 1_000_000  # beyond the persons of `heads.py`


def person(identity: int, views: int, slider_share: float, rng: np.random.Generator) -> list[heads.Arrays]:
    """`views` pictures of one person, each in another look."""
    who = head_sources.Person(rng, by_sliders=rng.random() < slider_share)
    common = heads.known(identity, who) | {"neutral": neutral_landmarks(who.bare())}
    found = []
    for _ in range(views):
        look = head_sources.random_look(rng)
        subject = who.dressed(look, rng)
        scene = build_scene(subject.face, subject.pose(rng), scenes.SIZE)
        found.append(heads.photo(scene, look, scenes.Placement(0.95, 0.0, np.zeros(2)), rng) | common)
    return found


def neutral_landmarks(subject: head_sources.Subject) -> np.ndarray:
    """(68, 3) of the person without an expression, without place and size."""
    marks = subject.neutral()[asset().landmarks]
    marks = marks - marks.mean(axis=0)
    return (marks / np.sqrt((marks**2).sum(axis=1).mean())).astype(np.float32)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Render random heads that change their looks.")
    add_shards(parser, count=4650, shard=SHARD, seed=1)
    parser.add_argument("--views", type=int, default=3, help="pictures a person (default 3)")
    parser.add_argument("--slider-share", type=float, default=0.3, help="of persons with sliders (default 0.3)")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for number in range(options.first, options.first + options.count // SHARD):
        rng = np.random.default_rng([options.seed, number])
        persons = [_FIRST + number * SHARD + i for i in range(SHARD // options.views)]
        rows = [row for one in persons for row in person(one, options.views, options.slider_share, rng)]
        heads.write_shard(rows, options.out / f"looks_{number:03d}.npz")


if __name__ == "__main__":
    main()
