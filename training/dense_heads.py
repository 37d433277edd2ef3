"""Renders random heads, large, with many points: ``python training/dense_heads.py OUT --count 76800 --seed 4``.

As `heads.py`, but heads alone, nearly in the aligned crop. Arrays of a shard (n = 320, S = 224):

- ``image`` (n, S, S, 3) uint8 sRGB, RGB
- ``points`` (n, 274, 2) float32 x, y in pixels: the 68 landmarks of Multi-PIE, whose contour lies on the outline where
  the head is turned away, then the points of the scheme ``dense`` of the built-in head and of the pupils,
  the person's left first; hidden ones too
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import head_sources
import heads
import numpy as np
import pictures
import scenes
from card import Card, Model
from script_arguments import add_shards

from facepipe.geometry.colors import from_srgb
from facepipe.heads.assembly import pupil
from facepipe.heads.asset import asset
from facepipe.pictures.scene import build_scene

SHARD, SIZE = 320, 224  # pictures, and pixels a side
_VIEWS, _POSES = 32, 4  # pictures of a person, and expressions
_SQUINTS = 0.35
_SPREAD = 0.8, 1.3  # of the modes of identity: faces that are nearer to the mean, and farther from it
_TURN, _SCALE, _SHIFT = 0.15, 0.1, 0.04  # off the aligned crop: radians, powers of two, and shares of a side


def person(rng: np.random.Generator, *, poses: int = _POSES, views: int = _VIEWS) -> list[heads.Arrays]:
    """So many pictures of one person.

    :param poses: different expressions, as many views of each
    """
    who = head_sources.Person(rng, by_sliders=rng.random() < heads.SHARE_SLIDERS, spread=rng.uniform(*_SPREAD))
    subject = (who.scanned if rng.random() < heads.SHARE_SCANS else who.dressed)(who.look, rng)
    rows, model = [], None
    for _ in range(poses):
        scene = build_scene(subject.face, subject.pose(rng, _SQUINTS), SIZE, model and model.scene)
        if model is None:
            model = shared_card().load(scene)
        else:
            model.pose(scene)
        rows += [_picture(model, who, rng) for _ in range(views // poses)]
    model.release()
    return rows


def _picture(model: Model, who: head_sources.Person, rng: np.random.Generator) -> heads.Arrays:
    place = scenes.Placement(
        float(2 ** rng.uniform(-_SCALE, _SCALE)), rng.uniform(-_TURN, _TURN), rng.uniform(-_SHIFT, _SHIFT, 2)
    )
    points = model.scene.points
    camera, landmarks = scenes.random_camera(points[: asset().parts["Head"].points.stop], place, SIZE, rng)
    behind = from_srgb(pictures.background(SIZE, rng)).astype(np.float32)
    image = shared_card().draw(model, camera, scenes.random_light(who.look, rng), behind) / 255
    image = pictures.occlude(image, np.zeros((SIZE, SIZE), np.uint8), landmarks, rng)
    screen = camera.project(points[[*asset().dense, *pupils()]])
    dense = screen[:, :2] / np.maximum(screen[:, 3:], 1.0)
    return {
        "image": pictures.photographed(image, rng),
        "points": np.concatenate([landmarks, dense]).astype(np.float32),
    }


@cache
def shared_card() -> Card:
    """The one of this process."""
    return Card(SIZE)


@cache
def pupils() -> list[int]:
    """The foremost point of either eye, the person's left first."""
    return [asset().parts[name].points.start + pupil(name) for name in ("EyeballLeft", "EyeballRight")]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Render random heads, large, with many points.")
    add_shards(parser, count=76800, shard=SHARD, seed=4)
    parser.add_argument("--processes", type=int, default=2, help="shards at a time (default 2)")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    numbers = range(options.first, options.first + options.count // SHARD)
    with ProcessPoolExecutor(options.processes, mp_context=get_context("spawn")) as pool:
        for task in [pool.submit(shard, number, options.seed, options.out) for number in numbers]:
            task.result()


def shard(number: int, seed: int, out: Path) -> None:
    """Write one of the files."""
    rng = np.random.default_rng([seed, number])
    heads.write_shard([row for _ in range(SHARD // _VIEWS) for row in person(rng)], out / f"dense_{number:03d}.npz")


if __name__ == "__main__":
    main()
