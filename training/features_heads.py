"""Renders random heads that change their looks: ``python training/features_heads.py OUT --count 4650 --seed 1``.

As `heads.py`, but every picture of a person has another skin, hair, brows, beard and make-up: what its pictures share
is the shape of the head alone, which is what the identity features shall tell. The crop is nearly the aligned one. The
arrays of a shard are those of `heads.py`, and

- ``neutral`` (n, 68, 3) float32: landmarks of the person's neutral, centred, in units of their root mean square
  distance from the centre
"""

from __future__ import annotations

import argparse

import head_sources
import heads
import numpy as np
import painting
import scenes
import styles
import torch
from script_arguments import add_heads, add_shards

SHARD = 150  # pictures
_FIRST = 1_000_000  # beyond the persons of `heads.py`


def person(
    studio: heads.Studio, identity: int, views: int, sample_share: float, rng: np.random.Generator
) -> list[heads.Arrays]:
    """`views` pictures of one person, each in another look."""
    sample = rng.random() < sample_share
    source = studio.samples[rng.integers(len(studio.samples))] if sample else studio.ict
    subject = source.draw(rng)
    painter = painting.Painter(source.topology)
    known = subject.attributes if sample else np.full(len(studio.names), np.nan)
    common = {
        "identity": np.int32(identity),
        "source": np.int8(sample),
        "attributes": np.nan_to_num(known).astype(np.float32),
        "attribute_mask": np.isfinite(known),
        "neutral": neutral_landmarks(subject),
    }
    found = []
    for _ in range(views):
        place = scenes.Placement(0.95, 0.0, np.zeros(2))
        view = scenes.render(subject, styles.random_style(rng), painter, place, rng)
        found.append(heads.compose(view, rng) | common)
    return found


def neutral_landmarks(subject: head_sources.Subject) -> np.ndarray:
    """(68, 3) of the person without an expression, without place and size."""
    if isinstance(subject, head_sources.SampleSubject):
        points = subject._rig(torch.as_tensor(subject._values, dtype=torch.float32))
    else:
        points = subject._points
    marks = points.reshape(-1, 3).numpy()[subject.topology.landmarks]
    marks = marks - marks.mean(axis=0)
    return (marks / np.sqrt((marks**2).sum(axis=1).mean())).astype(np.float32)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Render random heads that change their looks.")
    add_shards(parser, count=4650, shard=SHARD)
    parser.add_argument("--views", type=int, default=3, help="pictures a person (default 3)")
    parser.add_argument("--sample-share", type=float, default=0.3, help="of persons with sliders (default 0.3)")
    add_heads(parser, seed=1)
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    studio = heads.Studio(options.ict)
    for number in range(options.first, options.first + options.count // SHARD):
        rng = np.random.default_rng([options.seed, number])
        persons = [_FIRST + number * SHARD + i for i in range(SHARD // options.views)]
        rows = [row for one in persons for row in person(studio, one, options.views, options.sample_share, rng)]
        arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        unfinished = options.out / f".looks_{number:03d}.tmp.npz"
        np.savez(unfinished, attribute_names=np.array(studio.names), **arrays)
        unfinished.replace(options.out / f"looks_{number:03d}.npz")
        print(f"shard {number}", flush=True)


if __name__ == "__main__":
    main()
