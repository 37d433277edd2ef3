"""Renders random heads, large, with many points: ``python training/dense_heads.py OUT --count 4500 --seed 4``.

As `heads.py`, but heads alone, nearly in the aligned crop. Arrays of a shard (n = 300, S = 224):

- ``image`` (n, S, S, 3) uint8 sRGB, RGB
- ``points`` (n, 274, 2) float32 x, y in pixels: the 68 landmarks of Multi-PIE, whose contour lies on the outline where
  the head is turned away, then the points of the scheme ``dense`` of the built-in head and of the pupils,
  the person's left first; hidden ones too
"""

from __future__ import annotations

import argparse
from functools import cache

import head_sources
import heads
import numpy as np
import pictures
import scenes
from script_arguments import add_shards

from facepipe.heads.assembly import pupil
from facepipe.heads.asset import asset
from facepipe.pictures.scene import Scene, build_scene

SHARD, SIZE = 300, 224  # pictures, and pixels a side
_VIEWS, _POSES = 6, 3  # pictures of a person, and expressions
_SQUINTS = 0.35
_TURN, _SCALE, _SHIFT = 0.15, 0.1, 0.04  # off the aligned crop: radians, powers of two, and shares of a side


def person(rng: np.random.Generator) -> list[heads.Arrays]:
    """Pictures of one person."""
    who = head_sources.Person(rng, by_sliders=rng.random() < heads.SHARE_SLIDERS)
    subject = (who.scanned if rng.random() < heads.SHARE_SCANS else who.dressed)(who.look, rng)
    rows, textures = [], None
    for _ in range(_POSES):
        scene = build_scene(subject.face, subject.pose(rng, _SQUINTS), SIZE, textures)
        textures = scene.textures
        rows += [_picture(scene, who, rng) for _ in range(_VIEWS // _POSES)]
    return rows


def _picture(scene: Scene, who: head_sources.Person, rng: np.random.Generator) -> heads.Arrays:
    place = scenes.Placement(
        float(2 ** rng.uniform(-_SCALE, _SCALE)), rng.uniform(-_TURN, _TURN), rng.uniform(-_SHIFT, _SHIFT, 2)
    )
    view = scenes.render(scene, who.look, place, pictures.background(SIZE, rng), rng)
    image = pictures.occlude(view.image, view.labels.copy(), view.landmarks, rng)
    screen = view.camera.project(scene.points[[*asset().dense, *pupils()]])
    dense = screen[:, :2] / np.maximum(screen[:, 3:], 1.0)
    return {
        "image": pictures.photographed(image, rng),
        "points": np.concatenate([view.landmarks, dense]).astype(np.float32),
    }


@cache
def pupils() -> list[int]:
    """The foremost point of either eye, the person's left first."""
    return [asset().parts[name].points.start + pupil(name) for name in ("EyeballLeft", "EyeballRight")]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Render random heads, large, with many points.")
    add_shards(parser, count=4500, shard=SHARD, seed=4)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for number in range(options.first, options.first + options.count // SHARD):
        rng = np.random.default_rng([options.seed, number])
        rows = [row for _ in range(SHARD // _VIEWS) for row in person(rng)]
        heads.write_shard(rows, options.out / f"dense_{number:03d}.npz")


if __name__ == "__main__":
    main()
