"""Renders random heads to train the photo fit's networks on: ``python training/heads.py OUT --count 16000 --seed 0``.

Nothing of it is a photo: heads are of ICT-FaceKit's identity modes (MIT) and of the built-in sample under random
sliders, painted and lit at random in front of random patterns. The same command writes the same data.

OUT gets ``shard_000.npz``, ``shard_001.npz`` ... of `SHARD` pictures each, whole persons (`VIEWS` pictures a person,
one after the other), so that holding out shards holds out identities. Arrays of a shard (n = 500, S = 160):

- ``image`` (n, S, S, 3) uint8 sRGB, RGB
- ``label`` (n, S, S) uint8: 0 background (also neck, clothes, caps), 1 face, 2 hair, 3 left brow, 4 right brow,
  5 left eye, 6 right eye, 7 nose, 8 upper lip, 9 teeth (all inside the lips), 10 lower lip; left is the person's left
- ``landmarks`` (n, 68, 2) float32 x, y in pixels, Multi-PIE order; contour points 0-16 lie on the outline where the
  head is turned away; some lie outside of the picture; NaN where there is no head
- ``presence`` (n,) float32: 1 a face about where it belongs, 0 none (a pattern, a crop far off), 0.5 between
- ``identity`` (n,) int32: the number of the person over all shards, -1 where there is none
- ``source`` (n,) int8: 0 ICT-FaceKit, 1 sample, -1 none
- ``camera`` (n, 8) float32: yaw, pitch, roll in radians, distance, and of the crop beside the aligned one: scale,
  turn in radians, shift x and y in crops
- ``light`` (n, 9, 3) float32 spherical harmonics in camera coordinates
- ``attributes`` (n, a) float32 0..1 slider values of the sample, and ``attribute_mask`` (n, a) bool where they are
  known; ``attribute_names`` (a,) str
"""

from __future__ import annotations

import argparse
from pathlib import Path

import head_sources
import numpy as np
import painting
import pictures
import scenes
import styles
import torch
from script_arguments import add_heads, add_shards

SHARD, VIEWS = 500, 4
_SEEDS = (0, 1, 2, 3, 4, 5)  # of the sample; the first, the average head, half of the time
_SHARE_SAMPLE, _SHARE_NONE, _SHARE_FAR = 0.2, 0.05, 0.06

Arrays = dict[str, np.ndarray]


class Studio:
    """Everything that pictures are made of."""

    def __init__(self, ict: Path) -> None:
        self.ict, self.samples = head_sources.all_sources(ict, _SEEDS)
        self.names = head_sources.sample_attribute_names()
        self._painters: dict[int, painting.Painter] = {}

    def person(self, identity: int, rng: np.random.Generator) -> list[Arrays]:
        """`VIEWS` pictures of one person, or of none."""
        if rng.random() < _SHARE_NONE:
            return [self._nothing(rng) for _ in range(VIEWS)]
        sample = rng.random() < _SHARE_SAMPLE
        source = self.samples[max(0, int(rng.integers(-len(_SEEDS) + 2, len(_SEEDS))))] if sample else self.ict
        subject, style = source.draw(rng), styles.random_style(rng)
        painter = self._painters.setdefault(id(source), painting.Painter(source.topology))
        pictures_of = []
        for _ in range(VIEWS):
            place = scenes.far_placement(rng) if rng.random() < _SHARE_FAR else scenes.near_placement(rng)
            view = scenes.render(subject, style, painter, place, rng)
            shown = compose(view, rng)
            known = np.full(len(self.names), np.nan) if not sample else subject.attributes
            pictures_of.append(
                shown
                | {
                    "identity": np.int32(identity),
                    "source": np.int8(sample),
                    "attributes": np.nan_to_num(known).astype(np.float32),
                    "attribute_mask": np.isfinite(known),
                }
            )
        return pictures_of

    def _nothing(self, rng: np.random.Generator) -> Arrays:
        size = scenes.SIZE
        image = pictures.blobs(size, rng) if rng.random() < 0.5 else pictures.background(size, rng)
        return {
            "image": pictures.photographed(image, rng),
            "label": np.zeros((size, size), np.uint8),
            "landmarks": np.full((68, 2), np.nan, np.float32),
            "presence": np.float32(0),
            "camera": np.zeros(8, np.float32),
            "light": np.zeros((9, 3), np.float32),
            "identity": np.int32(-1),
            "source": np.int8(-1),
            "attributes": np.zeros(len(self.names), np.float32),
            "attribute_mask": np.zeros(len(self.names), bool),
        }


def compose(view: scenes.View, rng: np.random.Generator) -> Arrays:
    """A photo of a view, with its labels."""
    size = scenes.SIZE
    shown = view.labels == painting.FACE
    counted = view.color[shown if shown.sum() > 50 else view.coverage > 0]
    level = counted.mean() if len(counted) else 0.2
    exposed = pictures.encode(view.color * (np.exp(rng.uniform(np.log(0.10), np.log(0.55))) / max(level, 1e-3)))
    coverage = view.coverage[..., None]
    image = pictures.resized(np.concatenate([exposed * coverage, coverage], axis=2), size).astype(float)
    image = image[..., :3] + pictures.background(size, rng) * (1 - image[..., 3:])
    # A class is what covers the middle of a pixel.
    at = ((np.arange(size) + 0.5) * len(view.labels) / size).astype(int)
    labels = view.labels[np.ix_(at, at)].copy()
    image = pictures.occlude(image, labels, view.landmarks, rng)
    return {
        "image": pictures.photographed(image, rng),
        "label": labels.astype(np.uint8),
        "landmarks": view.landmarks.astype(np.float32),
        "presence": np.float32(view.present),
        "camera": view.camera.astype(np.float32),
        "light": view.light.astype(np.float32),
    }


def write_shard(studio: Studio, number: int, seed: int, folder: Path) -> None:
    """One shard, by its own random numbers."""
    rng = np.random.default_rng([seed, number])
    persons = SHARD // VIEWS
    rows = [row for i in range(persons) for row in studio.person(number * persons + i, rng)]
    arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    arrays["attribute_names"] = np.array(studio.names)
    unfinished = folder / f".shard_{number:03d}.tmp.npz"
    np.savez(unfinished, **arrays)
    unfinished.replace(folder / f"shard_{number:03d}.npz")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Render random heads to train networks on.")
    add_shards(parser, count=16000, shard=SHARD)
    add_heads(parser, seed=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    studio = Studio(options.ict)
    for number in range(options.first, options.first + options.count // SHARD):
        write_shard(studio, number, options.seed, options.out)
        print(f"shard {number}", flush=True)


if __name__ == "__main__":
    main()
