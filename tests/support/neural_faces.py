"""Neural rigs with random numbers on made faces, for tests of what runs them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from command_line import done
from faces import tiny_face
from neural_training import turning_face
from slider_faces import jointless

import facepipe
from facepipe.neural import load_neural_rig, save_neural_rig
from facepipe.parts import FaceParts, Slider
from facepipe.rig import Rig, build, slide
from facepipe.rig.neural_rig import Control, EncoderLayer, NeuralEncoder, NeuralRig, bones_in, share_limits, values_of
from facepipe.stage import Face, save_parts
from facepipe.verbs.whole_faces import MILLIMETRES, Topology, whole_points, world_to_world

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


def neural_encoder(rig: NeuralRig, points: int = 8, seed: int = 0) -> NeuralEncoder:
    """Random numbers of the least sizes: two tokens of four points, two heads, one layer."""
    random, controls = np.random.default_rng(seed), len(rig.controls)

    def some(*shape: int) -> np.ndarray:
        return 0.1 * random.normal(size=shape)

    layer = EncoderLayer(
        attend=some(4, 12),
        attend_bias=some(12),
        join=some(4, 4),
        join_bias=some(4),
        widen=some(4, 6),
        widen_bias=some(6),
        narrow=some(6, 4),
        narrow_bias=some(4),
    )
    chosen = random.choice(len(rig.rest), points, replace=False)
    return NeuralEncoder(
        controls=rig.controls,
        topology=rig.topology,
        point_count=len(rig.rest),
        chosen=chosen,
        rest=rig.rest[chosen],
        scale=2.0,
        heads=2,
        point=some(3, 5),
        point_bias=some(points, 5),
        feature=some(5, 3),
        feature_bias=some(3),
        token=some(points // 2 * 3, 4),
        places=some(2, 4),
        layers=(layer,),
        reduce=some(8, 3),
        reduce_bias=some(3),
        last=some(3, controls),
        straight=some(3 * points, controls),
        offset=some(controls),
    )


def random_values(rig: NeuralRig, count: int, seed: int = 1) -> np.ndarray:
    """(count, c) values in float32, some beyond their limits."""
    low, high = (np.array([getattr(control, key) for control in rig.controls]) for key in ("minimum", "maximum"))
    shares = np.random.default_rng(seed).uniform(-0.3, 1.3, (count, len(rig.controls)))
    return np.asarray((low + shares * (high - low)).astype(np.float32), dtype=np.float64)


FRAMES = 24


def untrained_rig(bones: Rig | None, seed: int = 0) -> NeuralRig:
    """A rig of five controls and bent outputs that no training made: ten shapes, three coefficients where bones are."""
    random = np.random.default_rng(seed)
    controls = (
        Control(name="open", minimum=-0.2),
        Control(name="look", minimum=-1.0),
        *(Control(name=name) for name in ("smile", "pucker", "blink")),
    )
    rest = whole_points(turning_face()) if bones is None else bones.points
    shapes = np.linalg.qr(random.normal(size=(3 * len(rest), 10)))[0].T.reshape(10, -1, 3)
    channels = np.array([[1, 3], [1, 8], [2, 4]]) if bones is not None else np.zeros((0, 2), np.int64)
    sizes = np.concatenate([np.full(10, 100.0), np.full(len(channels), 0.3)])
    last = 0.3 * random.normal(size=(len(sizes), 6)) * sizes[:, None]
    hidden, bias = random.normal(size=(6, 5)), random.normal(size=6)
    return NeuralRig(
        controls=controls,
        rest=rest,
        shapes=shapes,
        linear=random.normal(size=(5, len(sizes))) * sizes,
        hidden=hidden,
        hidden_bias=bias,
        last=last,
        last_bias=-last @ (bias / (1.0 + np.exp(-bias))),
        topology="made",
        bones=bones,
        channels=channels,
    )


def frames(rig: NeuralRig, seed: int = 1) -> np.ndarray:
    """Values all over the ranges, half of them at rest."""
    random = np.random.default_rng(seed)
    low, high = share_limits(rig.controls)
    shape = (FRAMES, len(low))
    return values_of(rig.controls, random.uniform(low, high, shape) * (random.random(shape) < 0.5))


def moving(rig: NeuralRig, count: int = 60) -> np.ndarray:
    """(count, c) values that swing slowly within the ranges."""
    low, high = share_limits(rig.controls)
    turns = np.linspace(0.0, 2.0 * np.pi, count)[:, None] * (1.0 + 0.3 * np.arange(len(low)))
    return values_of(rig.controls, (low + high) / 2.0 + 0.4 * np.sin(turns + np.arange(len(low))))


def millimetres(parts: FaceParts, rig: NeuralRig, values: np.ndarray) -> np.ndarray:
    """What the face's own rig makes of values of the controls."""
    own, to = build(parts), world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES)
    names = [control.name for control in rig.controls]
    found = []
    for row in values:
        coefficients, weights = slide(
            parts.sliders, own.joints, dict(zip(names, row.tolist(), strict=True)), parts.slider_network
        )
        found.append(own.evaluate(weights, coefficients=coefficients) @ to[:3, :3].T)
    return np.array(found)


def saved_rig(folder: Path, parts: FaceParts, *, bones: bool) -> NeuralRig:
    """The rig of head.fpnr, beside the face head.usda."""
    save_parts(parts, folder / "head.usda")
    save_neural_rig(neural_rig(facepipe.open(folder / "head.usda").parts(), bones=bones), folder / "head.fpnr", {})
    return load_neural_rig(folder / "head.fpnr")


def applied(folder: Path, capsys: pytest.CaptureFixture[str], *words: object) -> Face:
    out = done(capsys, "neural-rig", "apply", folder / "head.usda", folder / "head.fpnr", *words, "--json", quiet=False)
    return facepipe.open(json.loads(out)["path"])
