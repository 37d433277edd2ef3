"""Faces with sliders of every kind, for tests of what evaluates them."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
from faces import with_meshes
from import_data import shared
from small_head import make

from facepipe.importers import load, makehuman
from facepipe.parts import Curve, FaceParts, Skeleton, Slider
from facepipe.rig import CHANNELS
from facepipe.rig.sliders import channel_entries, shape_entries, with_entries

BEND: Curve = ((0.0, 0.0), (0.3, 0.1), (0.8, 0.9), (1.0, 1.0))
DECREASE: Curve = ((-1.0, 1.0), (0.0, 0.0))
INCREASE: Curve = ((0.0, 0.0), (1.0, 1.0))


@functools.cache
def sample_with_sliders() -> FaceParts:
    """The sample, with a curved slider beside its own."""
    parts = make(0)
    jaw = next(joint for joint in parts.skeleton.joints if joint.endswith("jaw"))
    curved = Slider(
        name="curved",
        minimum=-1.0,
        channels=((jaw, "rx", 0.2), (jaw, "ty", -0.3), (jaw, "sy", 0.1)),
        channel_curves=(BEND, DECREASE, None),
        shapes=(("jawOpen", 0.6), ("mouthPucker", 0.5)),
        shape_curves=(INCREASE, DECREASE),
    )
    return replace(parts, sliders=(*parts.sliders, curved))


@functools.cache
def makehuman_with_sliders() -> FaceParts:
    """MakeHuman with expressions, and sliders that are straight, curved and driving shapes."""
    source = shared("makehuman/makehuman_head.npz")
    parts = load("makehuman", source, makehuman.Options(shapes="expression/caucasian/*")).parts
    rng = np.random.default_rng(7)
    shapes = [shape.name for shape in parts.meshes[0].blendshapes]
    sliders = [moved(f"move{i}", parts, rng, i % 3) for i in range(24)]
    for i, name in enumerate(shapes[:6]):
        curves = (None,) if i % 2 else (BEND,)
        sliders.append(Slider(name=f"express{i}", shapes=((name, 0.8),), shape_curves=curves))
    return replace(parts, sliders=tuple(sliders))


def moved(name: str, parts: FaceParts, rng: np.random.Generator, kind: int) -> Slider:
    """A slider that moves some joints of the head: straight, curved, or both ways from a default within its range."""
    joints = [joint for joint in parts.skeleton.joints if "/head" in joint]
    unit = 0.01 / parts.meters_per_unit * 0.3  # 3 mm
    size = {"t": unit, "r": 0.1, "s": 0.05}
    channels = [(str(rng.choice(joints)), str(rng.choice(CHANNELS))) for _ in range(6)]
    entries = tuple((joint, channel, float(rng.normal() * size[channel[0]])) for joint, channel in channels)
    if kind == 0:
        return Slider(name=name, channels=entries)
    if kind == 1:
        curves = tuple(BEND if i % 2 else None for i in range(6))
        return Slider(name=name, channels=entries, channel_curves=curves)
    curves = tuple((DECREASE, INCREASE, None)[i % 3] for i in range(6))
    return Slider(
        name=name, minimum=-1.0, maximum=1.5, default=0.25, value=0.5, channels=entries, channel_curves=curves
    )


def without_scales(parts: FaceParts) -> FaceParts:
    """The face with sliders that scale nothing: SkelAnimation holds scales as half floats."""
    sliders = tuple(
        with_entries(
            slider,
            [entry for entry in channel_entries(slider) if not entry[0][1].startswith("s")],
            list(shape_entries(slider)),
        )
        for slider in parts.sliders
    )
    return replace(parts, sliders=sliders)


def jointless(parts: FaceParts) -> FaceParts:
    """The face without joints and skin: blendshapes alone move it."""
    skeleton = Skeleton(transform=parts.skeleton.transform)
    return replace(with_meshes(parts, skin=None), skeleton=skeleton, animations=(), bone_limits=None)


def random_values(parts: FaceParts, rng: np.random.Generator) -> dict[str, float]:
    """Values of all sliders in float32, some beyond their ranges."""
    values = {}
    for slider in parts.sliders:
        reach = slider.maximum - slider.minimum
        values[slider.name] = float(np.float32(rng.uniform(slider.minimum - reach / 3, slider.maximum + reach / 3)))
    return values
