"""Identity joints of the head in the box: places and weights that carry what identity modes leave of people.

100 joints with at most 8 a point, learnt on blends of two drawn people by random regions, and on drawn people under
smooth random fields: what is beyond the modes. 60 joints leave a quarter more of unseen people.

    python samples/head/identity_joints.py facepipe/heads/data
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

import facepipe
from facepipe.core.arrays import FloatArray
from facepipe.heads import make
from facepipe.heads.asset import BASIS, asset
from facepipe.payload.basis import JointWeights, encode_basis
from facepipe.rig.joint_learning import learn_joints
from facepipe.stage import save_parts
from facepipe.verbs.blend import BlendOptions, BlendSession, Weights
from facepipe.verbs.person_basis import head_basis, unplaced
from facepipe.verbs.whole_faces import whole_points

_COUNT, _INFLUENCES, _ROUNDS = 100, 8, 14
_BLENDS, _WARPS = range(5000, 5150), range(5200, 5270)
_SOURCES = (20_000, 90_000)  # seeds of who is blended
_BUMPS, _WIDTHS_MM, _WARPS_MM = 100, (20.0, 45.0), (2.0, 5.0)
_UNSEEN = 0.1  # how much the mouth's inside counts


def main() -> None:
    """Blend, warp, learn, write."""
    basis, head = head_basis(), asset()
    skin = head.parts["Head"].points
    left = []
    for points in people():
        weights, placement = basis.mode_fit.placed(points)
        own = points if placement is None else unplaced(placement, points)
        left.append((own - basis.shaped(weights))[skin])
        print(f"\r{len(left)} of {len(_BLENDS) + len(_WARPS)}", end="", file=sys.stderr)
    print(file=sys.stderr)
    care = np.full(skin.stop, _UNSEEN)
    care[basis.fitted] = 1.0
    links = head.links.tocoo()
    edges = np.column_stack([links.row, links.col])[(links.row < links.col) & (links.col < skin.stop)]
    found = learn_joints(
        basis.mean[skin],
        edges,
        np.array(left),
        count=_COUNT,
        influences=_INFLUENCES,
        rounds=_ROUNDS,
        care=care,
        modes=basis.modes[:, skin].astype(np.float64),
        step=lambda: print(".", end="", file=sys.stderr, flush=True),
    )
    weights = shares(found.weights)
    indices = np.where(weights > 0, found.indices, 0).astype(np.uint8)
    own = JointWeights(skin.start, found.places.astype(np.float32), indices, weights)
    (Path(sys.argv[1]) / BASIS).write_bytes(encode_basis(replace(head.basis, identity_joints=own)))


def people() -> Iterator[FloatArray]:
    """(n, 3) millimetres of each."""
    regions = [*asset().regions, "default"]
    with tempfile.TemporaryDirectory() as folder:
        for seed in _BLENDS:
            random = np.random.default_rng(seed)
            paths = [Path(folder) / f"{side}.usdc" for side in range(2)]
            for source, path in zip(random.choice(np.arange(*_SOURCES), 2, replace=False), paths, strict=True):
                save_parts(make(int(source)), path)
            part = {name: float(random.choice([0.0, 1.0, random.uniform()])) for name in regions}
            both = {name: (1.0 - share, share) for name, share in part.items()}
            weights = Weights(default=both.pop("default"), regions=both)
            session = BlendSession([facepipe.open(path) for path in paths], BlendOptions(), live=False)
            yield 10 * session.neutral(weights).points
    for seed in _WARPS:
        random, points = np.random.default_rng(seed), whole_points(make(seed))
        width, size = random.uniform(*_WIDTHS_MM), random.uniform(*_WARPS_MM)
        centres = points[random.choice(asset().parts["Head"].points.stop, _BUMPS)]
        squares = ((points[:, None] - centres) ** 2).sum(axis=2)
        field = np.exp(-squares / (2 * width**2)) @ random.standard_normal((_BUMPS, 3))
        yield points + size * field / np.sqrt((field[head_basis().fitted] ** 2).sum(axis=1).mean())


def shares(weights: FloatArray) -> npt.NDArray[np.uint8]:
    """Weights as bytes in sum 255, those that round down most one more."""
    whole = np.floor(255 * weights)
    missing = np.rint(255 - whole.sum(axis=1, keepdims=True))
    rank = np.argsort(np.argsort(whole - 255 * weights, axis=1, kind="stable"), axis=1, kind="stable")
    return (whole + (rank < missing)).astype(np.uint8)


if __name__ == "__main__":
    main()
