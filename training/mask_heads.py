"""Renders heads with what is face and what is hair: ``python training/mask_heads.py OUT --count 25600 --seed 5``.

As `dense_heads.py`, from near and from far, often with glasses, hands or things in front. Arrays of a shard (n = 320,
S = 224):

- ``image`` (n, S, S, 3) uint8 sRGB, RGB
- ``shares`` (n, S, S, 2) uint8: 255 where there is nothing but the face (skin, eyes, mouth, ears and neck), or
  nothing but hair, that below which the skin is painted too; elsewhere is something else
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import head_sources
import heads
import numpy as np
import numpy.typing as npt
import pictures
import scenes
from card import Model
from dense_heads import SHARD, SIZE, shared_card
from script_arguments import add_shards

from facepipe.geometry.colors import from_srgb
from facepipe.heads.asset import asset
from facepipe.heads.skin import TILES, masks
from facepipe.parts import FaceParts, Mesh
from facepipe.pictures.scene import build_scene

_VIEWS, _POSES = 16, 2  # pictures of a person, and expressions
_SCALE = -1.2, 0.1  # of the crop beside the aligned one, powers of two
_TURN, _SHIFT = 0.25, 0.1  # radians, and shares of a side

FloatArray = npt.NDArray[np.floating]


def person(rng: np.random.Generator) -> list[heads.Arrays]:
    """Pictures of one person."""
    who = head_sources.Person(rng, by_sliders=rng.random() < heads.SHARE_SLIDERS)
    subject = who.dressed(who.look, rng)
    values, rows, model = shares_at_points(subject.face, shaved=who.look.style == "bald"), [], None
    for _ in range(_POSES):
        scene = build_scene(subject.face, subject.pose(rng), SIZE, model and model.scene)
        if model is None:
            model = shared_card().load(scene)
        else:
            model.pose(scene)
        rows += [_picture(model, values, who, rng) for _ in range(_VIEWS // _POSES)]
    model.release()
    return rows


def _picture(model: Model, values: FloatArray, who: head_sources.Person, rng: np.random.Generator) -> heads.Arrays:
    place = scenes.Placement(
        float(2 ** rng.uniform(*_SCALE)), rng.uniform(-_TURN, _TURN), rng.uniform(-_SHIFT, _SHIFT, 2)
    )
    head = model.scene.points[: asset().parts["Head"].points.stop]
    camera, landmarks = scenes.random_camera(head, place, SIZE, rng)
    behind = from_srgb(pictures.background(SIZE, rng)).astype(np.float32)
    image = shared_card().draw(model, camera, scenes.random_light(who.look, rng), behind) / 255
    shares = shared_card().shares(model, values)[..., :2]
    image, cover = pictures.often_occluded(image, landmarks, rng)
    shown = shares * (1 - cover)[..., None]
    return {
        "image": pictures.photographed(image, rng),
        "shares": np.asarray(np.clip(shown, 0, 1) * 255 + 0.5, np.uint8),
    }


def shares_at_points(face: FaceParts, *, shaved: bool) -> FloatArray:
    """(n, 3) how far points of all meshes are face, and hair; the third is 0.

    :param shaved: whether nothing of hair is on the scalp
    """
    rows = []
    for mesh in face.meshes:
        hair = np.full(len(mesh.points), float(mesh.name == "Hair"))
        if mesh.name == "Head" and not shaved:
            hair = _scalp(mesh)
        face_too = 0.0 if mesh.name == head_sources.CLOTHES else 1 - hair
        rows.append(np.column_stack([face_too + 0 * hair, hair, 0 * hair]))
    return np.concatenate(rows)


def _scalp(head: Mesh) -> FloatArray:
    """(n,) 0..1 where hair grows."""
    uv, (uv_set, *_) = np.zeros((len(head.points), 2)), head.uv_sets
    uv[head.face_vertex_indices] = np.asarray(uv_set.values)[uv_set.indices]
    tiles = np.stack([masks(tile)["scalp"] for tile in range(len(TILES))])
    tile, size = np.floor(uv[:, 0]).astype(int), tiles.shape[1]
    row, column = ((1 - uv[:, 1]) * size).astype(int), ((uv[:, 0] - tile) * size).astype(int)
    return np.asarray(tiles[tile, row.clip(0, size - 1), column.clip(0, size - 1)])


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Render random heads with what is face and what is hair.")
    add_shards(parser, count=25600, shard=SHARD, seed=5)
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
    heads.write_shard([row for _ in range(SHARD // _VIEWS) for row in person(rng)], out / f"mask_{number:03d}.npz")


if __name__ == "__main__":
    main()
