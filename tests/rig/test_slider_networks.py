"""Learned networks beside a face's sliders: the rig's, the graph's and torch's are one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from facepipe_onnx import Deformer, Options, export_parts, validate
from network_faces import CHANNELS, SLIDERS, network, networked
from slider_faces import jointless, random_values

from facepipe.core.errors import ExportError, InputError
from facepipe.importers.slider_network import read_network
from facepipe.parts import SliderNetwork
from facepipe.rig import CHANNELS as NAMES
from facepipe.rig import build, slide
from facepipe.rig.sliders import kept_outputs, network_fault

TOLERANCE = 1e-5
ACTIVE = {"tanh": np.tanh, "relu": lambda x: max(x, 0.0), "silu": lambda x: x / (1.0 + np.exp(-x))}
JOINTS = ("root", "root/jaw", "root/jaw/lip")


def by_hand(own: SliderNetwork, values: dict[str, float]) -> np.ndarray:
    """(outputs,) of a network, number by number."""
    ranges = {one.name: (one.minimum, one.maximum) for one in SLIDERS}
    x = [min(max(values[name], ranges[name][0]), ranges[name][1]) for name in own.sliders]
    for number, (weight, bias) in enumerate(zip(own.weights, own.biases, strict=True)):
        if number:
            x = [ACTIVE[own.activation](one) for one in x]
        x = [
            sum(float(w) * one for w, one in zip(row, x, strict=True)) + float(b)
            for row, b in zip(weight, bias, strict=True)
        ]
    return np.array(x)


@pytest.mark.parametrize("activation", ["tanh", "relu", "silu"])
@pytest.mark.parametrize("hidden", [(), (7,), (5, 9, 4)])
def test_adds_to_what_the_sliders_do(hidden: tuple[int, ...], activation: Any) -> None:
    own = network(hidden, activation)
    parts, random = networked(own), np.random.default_rng(0)
    for _ in range(5):
        values = random_values(parts, random)
        alone, alone_weights = slide(SLIDERS, JOINTS, values)
        both, weights = slide(SLIDERS, JOINTS, values, own)
        found = by_hand(own, values)
        expected = np.zeros((3, 9))
        for (joint, channel), amount in zip(CHANNELS, found, strict=False):
            expected[JOINTS.index(joint), NAMES.index(channel)] = amount
        assert np.allclose(both - alone, expected, atol=1e-12)
        for shape, amount in zip(own.shapes, found[3:], strict=True):
            assert weights[shape] - alone_weights.get(shape, 0.0) == pytest.approx(amount)


@pytest.mark.parametrize("activation", ["tanh", "relu", "silu"])
@pytest.mark.parametrize("hidden", [(), (7,), (5, 9, 4)])
def test_the_graph_is_the_rig(hidden: tuple[int, ...], activation: Any, tmp_path: Path) -> None:
    parts = networked(network(hidden, activation))
    export_parts(parts, tmp_path / "s.onnx", Options(sliders=True, points=True))
    assert validate(tmp_path / "s.onnx") == ()
    check_graph(parts, Deformer(tmp_path / "s.onnx"))


def check_graph(parts: Any, graph: Deformer) -> None:
    """Its points are the rig's under random sliders."""
    rig, random = build(parts), np.random.default_rng(1)
    for _ in range(10):
        values = random_values(parts, random)
        coefficients, weights = slide(parts.sliders, rig.joints, values, parts.slider_network)
        expected = rig.evaluate(weights, coefficients=coefficients)
        found = graph.evaluate(sliders=values)["points"]
        assert np.abs(found - expected).max() < TOLERANCE * np.ptp(rig.points[:, 1])


@pytest.mark.needs_torch
def test_torch_is_the_rig() -> None:
    from with_torch import torch

    from facepipe.rig.torch.rig import DifferentiableRig

    parts = networked(network((8, 6)))
    rig, random = build(parts), np.random.default_rng(2)
    learned = DifferentiableRig(rig, parts.sliders, dtype=torch.float64, network=parts.slider_network)
    rows = [random_values(parts, random) for _ in range(4)]
    batch = torch.tensor([[row[name] for name in learned.sliders.names] for row in rows], dtype=torch.float64)
    for row, found in zip(rows, learned(batch), strict=True):
        coefficients, weights = slide(parts.sliders, rig.joints, row, parts.slider_network)
        assert np.abs(found.numpy() - rig.evaluate(weights, coefficients=coefficients)).max() < 1e-9
    inside = torch.tensor([[0.3, 0.2, 0.7, 0.5, -0.4]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda values: learned(values).flatten()[::17], (inside,))


def test_networks_that_only_bones_or_only_shapes_are_left_of(tmp_path: Path) -> None:
    whole = networked(network())
    export_parts(whole, tmp_path / "a.onnx", Options(sliders=True, shapes="mouth*"))
    described = Deformer(tmp_path / "a.onnx").metadata["slider_network"]
    assert (described["shapes"], described["layers"]) == (["mouthSmileLeft"], [4, 16, 4])
    assert described["info"] == {"trained_on": "nothing"}
    own = kept_outputs(network(), lambda _: False, lambda _: True)
    assert own is not None
    sliders = tuple(replace(one, channels=(), channel_curves=()) for one in SLIDERS)
    shapes_only = jointless(replace(whole, sliders=sliders, slider_network=own))
    export_parts(shapes_only, tmp_path / "b.onnx", Options(sliders=True, points=True))
    check_graph(shapes_only, Deformer(tmp_path / "b.onnx"))
    assert kept_outputs(network(), lambda _: False, lambda _: False) is None


def test_sliders_that_do_nothing_but_through_the_network(tmp_path: Path) -> None:
    sliders = tuple(replace(one, channels=(), shapes=(), channel_curves=(), shape_curves=()) for one in SLIDERS)
    parts = replace(networked(network()), sliders=sliders)
    export_parts(parts, tmp_path / "s.onnx", Options(sliders=True, points=True))
    check_graph(parts, Deformer(tmp_path / "s.onnx"))
    still = tuple(replace(one, minimum=0.5, maximum=0.5, default=0.5) for one in SLIDERS[:4])
    parts = replace(networked(network()), sliders=(*still, SLIDERS[4]))
    export_parts(parts, tmp_path / "t.onnx", Options(sliders=True, points=True))
    check_graph(parts, Deformer(tmp_path / "t.onnx"))


def _faults() -> dict[str, Callable[[SliderNetwork], SliderNetwork]]:
    return {
        "no slider 'gone'": lambda one: replace(one, sliders=("gone", *one.sliders[1:])),
        "no joint 'root/nose'": lambda one: replace(one, channels=(("root/nose", "rx"), *one.channels[1:])),
        "channel 'qx'": lambda one: replace(one, channels=(("root", "qx"), *one.channels[1:])),
        "layer 0": lambda one: replace(one, weights=(one.weights[0][:, 1:], one.weights[1])),
        "layer 1": lambda one: replace(one, biases=(one.biases[0], one.biases[1][:, None])),
        "layer 1: NaN": lambda one: replace(one, biases=(one.biases[0], one.biases[1] * np.nan)),
        "activation 'gelu'": lambda one: replace(one, activation="gelu"),
        "a shape twice": lambda one: replace(one, shapes=("jawOpen", "jawOpen")),
        "outputs for 4": lambda one: replace(one, shapes=one.shapes[1:]),
        "1 biases": lambda one: replace(one, biases=one.biases[1:]),
    }


@pytest.mark.parametrize("message", _faults())
def test_damaged_networks_are_refused(message: str, tmp_path: Path) -> None:
    damaged = _faults()[message](network())
    with pytest.raises(InputError, match=message):
        slide(SLIDERS, JOINTS, {}, damaged)
    with pytest.raises((InputError, ExportError), match=r"NaN|" + message):
        export_parts(networked(damaged), tmp_path / "s.onnx", Options(sliders=True))
    assert not list(tmp_path.iterdir())


def test_an_unknown_shape_is_refused(tmp_path: Path) -> None:
    odd = replace(network(), shapes=("jawOpen", "sneer"))
    with pytest.raises(ExportError, match="no shape 'sneer'"):
        export_parts(networked(odd), tmp_path / "s.onnx", Options(sliders=True))
    assert network_fault(odd) is None  # by itself it is whole


@pytest.mark.parametrize("code", [0xD800, 0xDFFF, 0x110000, 0x7FFFFFFF, 0xFFFFFFFF])
def test_names_that_are_no_text_are_refused(code: int, tmp_path: Path) -> None:
    """numpy stores any number as a character; strings made of these end in a SystemError, or can't be written."""
    arrays = {"outputs": np.array(["root:rx"]), "layer0.weight": np.ones((1, 1)), "layer0.bias": np.zeros(1)}
    np.savez(tmp_path / "n.npz", sliders=np.array([code], np.uint32).view("U1"), **arrays)
    with pytest.raises(InputError, match=r"n.npz -> sliders: array holds code points that are no text"):
        read_network(tmp_path / "n.npz", ("root",), ())
