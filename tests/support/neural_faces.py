"""Neural rigs with random numbers on made faces, for tests of what runs them."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from faces import tiny_face
from slider_faces import jointless

from facepipe.parts import FaceParts, Slider
from facepipe.processors.database import Topology
from facepipe.processors.same_topology import MILLIMETRES, world_to_world
from facepipe.rig import build
from facepipe.rig.bones import bones_in
from facepipe.rig.neural_rig import Control, NeuralRig

CONTROLS = (
    Control(name="jaw"),
    Control(name="lip", minimum=-1.0, maximum=1.5, default=0.25),
    Control(name="brow", minimum=-30.0, maximum=10.0, default=-10.0),
)
CHANNELS = np.array([[0, 5], [1, 3], [1, 2], [2, 0], [2, 7]])


def face(up_axis: Literal["Y", "Z"] = "Y", unit: float = 0.01, *, joints: bool = True) -> FaceParts:
    """The tiny face, its skeleton turned and placed, one slider with a group and a value."""
    parts = tiny_face()
    placed = np.eye(4)
    placed[:3] = [[0.0, -2.0, 0.0, 1.0], [2.0, 0.0, 0.0, -2.0], [0.0, 0.0, 2.0, 3.0]]
    sliders = (Slider(name="lip", group="mouth", minimum=-1.0, value=0.5), Slider(name="old"))
    parts = replace(
        parts,
        up_axis=up_axis,
        meters_per_unit=unit,
        skeleton=replace(parts.skeleton, transform=placed),
        sliders=sliders,
    )
    return parts if joints else jointless(parts)


def neural_rig(parts: FaceParts, *, bones: bool, shapes: int = 4, units: int = 6, seed: int = 0) -> NeuralRig:
    """Random numbers for the meshes of a face; points move by millimetres of a head 5 units high."""
    random = np.random.default_rng(seed)
    rig, to = build(parts), world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES)
    own, channels = (bones_in(rig, to), CHANNELS) if bones else (None, np.zeros((0, 2), np.int64))
    count, unit = len(rig.points), float(np.cbrt(np.linalg.det(to[:3, :3])))
    rest = own.points if own else rig.evaluate() @ to[:3, :3].T
    if own is None:
        rest = rest + 0.05 * unit * random.normal(size=rest.shape)
    basis = np.linalg.qr(random.normal(size=(3 * count, shapes)))[0].T.reshape(shapes, count, 3)
    sizes = np.concatenate([np.full(shapes, 0.5 * unit), np.where(channels[:, 1] < 3, 0.2 * unit, 0.2)])
    return NeuralRig(
        controls=CONTROLS,
        rest=rest,
        shapes=basis,
        linear=random.normal(size=(3, len(sizes))) * sizes,
        hidden=random.normal(size=(units, 3)),
        hidden_bias=random.normal(size=units),
        last=random.normal(size=(len(sizes), units)) * sizes[:, None],
        last_bias=random.normal(size=len(sizes)) * 0.1 * sizes,
        topology=Topology.of(parts).digest,
        bones=own,
        channels=channels,
    )


def random_values(rig: NeuralRig, count: int, seed: int = 1) -> np.ndarray:
    """(count, c) values in float32, some beyond their limits."""
    low, high = (np.array([getattr(one, key) for one in rig.controls]) for key in ("minimum", "maximum"))
    shares = np.random.default_rng(seed).uniform(-0.3, 1.3, (count, len(rig.controls)))
    return np.asarray((low + shares * (high - low)).astype(np.float32), dtype=np.float64)
