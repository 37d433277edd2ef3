"""Renders random heads to train the photo fit's networks on: ``python training/heads.py OUT --count 16000 --seed 0``.

Nothing of it is a photo: people are drawn from the head in the box, with skin, hair and clothes, posed and lit at
random in front of random patterns. The same command writes the same data.

OUT gets ``shard_000.npz``, ``shard_001.npz`` ... of `SHARD` pictures each, whole persons (`VIEWS` pictures a person,
one after the other), so that holding out shards holds out identities. Arrays of a shard (n = 500, S = 160):

- ``image`` (n, S, S, 3) uint8 sRGB, RGB
- ``label`` (n, S, S) uint8: 0 background (also neck and clothes), 1 face, 2 hair, 3 left brow, 4 right brow,
  5 left eye, 6 right eye, 7 nose, 8 upper lip, 9 teeth (all inside the lips), 10 lower lip; left is the person's left
- ``landmarks`` (n, 68, 2) float32 x, y in pixels, Multi-PIE order; contour points 0-16 lie on the outline where the
  head is turned away; some lie outside of the picture; NaN where there is no head
- ``presence`` (n,) float32: 1 a face about where it belongs, 0 none (a pattern, a crop far off), 0.5 between
- ``identity`` (n,) int32: the number of the person over all shards, -1 where there is none
- ``source`` (n,) int8: 0 drawn from the modes of identity, 1 the average head under sliders of bones, -1 none
- ``attributes`` (n, a) float32 0..1 values of those sliders, and ``attribute_mask`` (n, a) bool where they are known;
  ``attribute_names`` (a,) str
"""

from __future__ import annotations

import argparse
from pathlib import Path

import head_sources
import numpy as np
import pictures
import scenes
from script_arguments import add_shards

from facepipe.heads.people import Look
from facepipe.pictures.scene import Scene, build_scene

SHARD, VIEWS = 500, 10
SHARE_SLIDERS, _SHARE_NONE, _SHARE_FAR = 0.2, 0.05, 0.06
SHARE_SCANS = 0.08  # heads alone, without hair and clothes

Arrays = dict[str, np.ndarray]


def person(identity: int, rng: np.random.Generator, *, poses: int = 5, views: int = VIEWS) -> list[Arrays]:
    """So many pictures of one person, or of none.

    :param poses: different expressions, as many views of each
    """
    if rng.random() < _SHARE_NONE:
        return [_nothing(rng) for _ in range(views)]
    who = head_sources.Person(rng, by_sliders=rng.random() < SHARE_SLIDERS)
    subject = (who.scanned if rng.random() < SHARE_SCANS else who.dressed)(who.look, rng)
    rows, scene = list[Arrays](), None
    for _ in range(poses):
        scene = build_scene(subject.face, subject.pose(rng), scenes.SIZE, scene)
        for _ in range(views // poses):
            place = scenes.far_placement(rng) if rng.random() < _SHARE_FAR else scenes.near_placement(rng)
            rows.append(photo(scene, who.look, place, rng) | known(identity, who))
    return rows


def known(identity: int, who: head_sources.Person) -> Arrays:
    """What every picture of a person shares."""
    return {
        "identity": np.int32(identity),
        "source": np.int8(np.isfinite(who.attributes).all()),
        "attributes": np.nan_to_num(who.attributes).astype(np.float32),
        "attribute_mask": np.isfinite(who.attributes),
    }


def _nothing(rng: np.random.Generator) -> Arrays:
    size, names = scenes.SIZE, head_sources.slider_names()
    image = pictures.blobs(size, rng) if rng.random() < 0.5 else pictures.background(size, rng)
    return {
        "image": pictures.photographed(image, rng),
        "label": np.zeros((size, size), np.uint8),
        "landmarks": np.full((68, 2), np.nan, np.float32),
        "presence": np.float32(0),
        "identity": np.int32(-1),
        "source": np.int8(-1),
        "attributes": np.zeros(len(names), np.float32),
        "attribute_mask": np.zeros(len(names), bool),
    }


def photo(scene: Scene, look: Look, place: scenes.Placement, rng: np.random.Generator) -> Arrays:
    """A picture of a head with what is behind and in front of it, with its labels."""
    view = scenes.render(scene, look, place, pictures.background(scenes.SIZE, rng), rng)
    labels = view.labels.copy()
    image = pictures.occlude(view.image, labels, view.landmarks, rng)
    return {
        "image": pictures.photographed(image, rng),
        "label": labels,
        "landmarks": view.landmarks.astype(np.float32),
        "presence": np.float32(view.present),
    }


def write_shard(rows: list[Arrays], path: Path) -> None:
    """A whole file or none."""
    arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    unfinished = path.with_name(f".{path.stem}.tmp.npz")
    np.savez(unfinished, attribute_names=np.array(head_sources.slider_names()), **arrays)
    unfinished.replace(path)
    print(path.stem, flush=True)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Render random heads to train networks on.")
    add_shards(parser, count=16000, shard=SHARD, seed=0)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for number in range(options.first, options.first + options.count // SHARD):
        rng, persons = np.random.default_rng([options.seed, number]), SHARD // VIEWS
        rows = [row for i in range(persons) for row in person(number * persons + i, rng)]
        write_shard(rows, options.out / f"shard_{number:03d}.npz")


if __name__ == "__main__":
    main()
