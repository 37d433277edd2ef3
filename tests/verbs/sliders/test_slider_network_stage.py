"""Learned networks of sliders on stages: authored, read, evaluated, checked, and from files of training code."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import done, exit_code, failed
from facepipe_onnx import Deformer
from network_faces import SLIDERS, network, networked, save_network
from oracle import bake_all
from pxr import Usd
from slider_faces import random_values

import facepipe
from facepipe.checks import validate
from facepipe.core.errors import FacepipeError, InputError, SchemaError
from facepipe.importers.slider_network import read_network
from facepipe.parts import FaceParts, SliderNetwork
from facepipe.performing import read_kept
from facepipe.rig import build, slide
from facepipe.stage import Face, save_parts
from facepipe.stage.values import same
from facepipe.verbs.sliders import AuthorNetwork, AuthorSliders, SetSliders, SlidersOfFace, read_table

TOLERANCE = 1e-5
JOINTS, SHAPES = ("root", "root/jaw", "root/jaw/lip"), ("jawOpen", "mouthSmileLeft")


def without_scales(own: SliderNetwork) -> SliderNetwork:
    """SkelAnimation holds scales as half floats."""
    return replace(own, channels=(("root/jaw", "rx"), ("root/jaw", "tz"), ("root/jaw/lip", "rz")))


@pytest.mark.parametrize("hidden", [(), (7,), (5, 9, 4)])
def test_stage_gives_back_what_was_authored(hidden: tuple[int, ...], tmp_path: Path) -> None:
    own = network(hidden, "relu")
    save_parts(networked(own), tmp_path / "face.usda")
    assert validate(tmp_path / "face.usda") == ()
    face = facepipe.open(tmp_path / "face.usda")
    assert same(face.slider_network, own)
    assert same(face.parts().slider_network, own)
    assert Face.from_parts(networked(None)).slider_network is None


def test_usdskel_shows_what_sliders_and_network_make() -> None:
    """Random vectors: the face's evaluation, the pose that setting authors, and UsdSkel's skinning of it."""
    sliders = tuple(one for one in SLIDERS if one.name != "straight")
    parts = replace(networked(without_scales(network((12, 8), size=0.3))), sliders=sliders)
    face, rig, random = Face.from_parts(parts), build(parts), np.random.default_rng(0)
    poses, found = [], []
    for _ in range(30):
        values = random_values(parts, random)
        coefficients, weights = slide(sliders, rig.joints, values, parts.slider_network)
        poses.append((weights, rig.local_transforms(coefficients)))
        found.append(face.evaluate(sliders=values))
    errors = np.linalg.norm(np.stack(found) - bake_all(face, poses), axis=-1)
    assert errors.max() < TOLERANCE * face.head_height


def test_setting_poses_what_the_network_moves(tmp_path: Path) -> None:
    """Joints and shapes that no slider drives by itself are in the pose too."""
    sliders = tuple(replace(one, channels=(), shapes=(), channel_curves=(), shape_curves=()) for one in SLIDERS)
    save_parts(replace(networked(network()), sliders=sliders), tmp_path / "face.usda")
    values = {"jaw": 0.75, "smile": 0.25}
    with facepipe.open(tmp_path / "face.usda").deriving(tmp_path / "posed.usda") as face:
        report = SetSliders(values=values)(face)
    assert (report.joints, report.shapes) == (2, 2)
    posed = facepipe.open(tmp_path / "posed.usda")
    (pose,) = (animation for animation in posed.animations if animation.name == "sliders")
    coefficients, weights = slide(posed.sliders, posed.skeleton.joints, None, posed.slider_network)
    assert pose.coefficients is not None
    assert np.allclose(pose.coefficients[0], coefficients[[1, 2]], atol=1e-6)
    assert pose.shape_weights is not None
    assert np.allclose(pose.shape_weights[0], [weights[name] for name in pose.shapes], atol=1e-6)
    assert same(posed.slider_network, network())


def test_a_network_is_authored_replaced_and_gone_with_its_sliders(tmp_path: Path) -> None:
    save_parts(networked(None), tmp_path / "face.usda")
    paths = [tmp_path / name for name in ("one.usda", "two.usda", "kept.usda", "gone.usda")]
    for source, path, seed in ((tmp_path / "face.usda", paths[0], 1), (paths[0], paths[1], 2)):
        with facepipe.open(source).deriving(path) as face:
            report = AuthorNetwork(network=network(seed=seed))(face)
        assert report.replaced == (seed == 2)
        assert report.layers == (4, 16, 5)
        assert same(facepipe.open(path).slider_network, network(seed=seed))
    (tmp_path / "table.csv").write_text("slider,target,gain\nbrow,root:tx,0.1\n", encoding="utf-8")
    table = read_table(tmp_path / "table.csv")
    for path, drop in ((paths[2], False), (paths[3], True)):
        with facepipe.open(paths[1]).deriving(path) as face:
            warnings = AuthorSliders(table=table, drop=drop)(face).warnings
        assert any("network" in line for line in warnings) == drop
        assert (facepipe.open(path).slider_network is None) == drop
        assert validate(path) == ()


def test_a_file_holds_the_network_whatever_the_order_of_its_outputs(tmp_path: Path) -> None:
    own = network((6, 5))
    found = read_network(save_network(tmp_path / "net.npz", own), JOINTS, SHAPES)
    values = np.random.default_rng(0).normal(size=4)
    by_name = []
    for one in (own, found):
        x: Any = values
        for number, (weight, bias) in enumerate(zip(one.weights, one.biases, strict=True)):
            x = weight @ (np.tanh(x) if number else x) + bias
        by_name.append(dict(zip([*one.channels, *one.shapes], x, strict=True)))
    assert by_name[0].keys() == by_name[1].keys()
    for key, amount in by_name[0].items():
        assert by_name[1][key] == pytest.approx(amount)
    assert (found.activation, dict(found.info)) == ("tanh", {"trained_on": "nothing"})


_BAD: dict[str, dict[str, Any]] = {
    "no shape 'sneer'": {"outputs": ["shape:sneer", "shape:jawOpen", "jaw:rx", "jaw:tz", "lip:sy"]},
    "JOINT:CHANNEL": {"outputs": ["shape:jawOpen", "shape:mouthSmileLeft", "jaw:qx", "jaw:tz", "lip:sy"]},
    "a channel twice": {"outputs": ["shape:jawOpen", "shape:mouthSmileLeft", "jaw:rx", "root/jaw:rx", "lip:sy"]},
    "each of 4": {"outputs": ["shape:jawOpen", "jaw:rx", "jaw:tz", "lip:sy"]},
    "activation 'gelu'": {"activation": "gelu"},
    "layer1.bias": {"layer1.bias": None},
    "0 layers": {"layer0.weight": None, "layer0.bias": None, "layer1.weight": None, "layer1.bias": None},
    "layer0.weight": {"layer0.weight": np.full((16, 4), np.nan)},
    "array 'other'": {"other": [1.0]},
    "info": {"info": "[1]"},
    "sliders": {"sliders": [1.0, 2.0, 3.0, 4.0]},
}


@pytest.mark.parametrize("message", _BAD)
def test_damaged_files_are_refused(message: str, tmp_path: Path) -> None:
    path = save_network(tmp_path / "net.npz", network(), **_BAD[message])
    with pytest.raises(InputError, match=message) as caught:
        read_network(path, JOINTS, SHAPES)
    assert "net.npz" in str(caught.value)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match=r"net\.npz"):
        read_network(path, JOINTS, SHAPES)


def _stage_faults() -> dict[str, Callable[[Usd.Prim], None]]:
    def put(name: str, value: Any) -> Callable[[Usd.Prim], None]:
        return lambda prim: prim.GetAttribute(f"facepipe:sliderNetwork:{name}").Set(value)

    return {
        "slider 'gone'": put("sliders", ["smile", "jaw", "still", "gone"]),
        "layer 0": put("sliders", ["smile", "jaw", "still"]),
        "joints and": put("joints", ["root"]),
        "weights and": put("weights", [0.0, 1.0]),
        "expected 2 numbers": put("layers", [4]),
        "expected 2 numbers or more": put("layers", [4, 0, 5]),
        "activation": put("activation", "gelu"),
        "NaN": put("biases", [float("nan")] * 21),
        "JSON object": put("info", "[]"),
    }


@pytest.mark.parametrize("message", _stage_faults())
def test_damage_on_a_stage_is_found(message: str, tmp_path: Path) -> None:
    path = tmp_path / "face.usda"
    save_parts(networked(network()), path)
    stage = Usd.Stage.Open(str(path))
    _stage_faults()[message](stage.GetDefaultPrim())
    stage.Save()
    assert "facepipe:SliderNetwork" in {one.check for one in validate(path)}
    with pytest.raises((SchemaError, InputError), match=message):
        facepipe.open(path).parts()


def test_import_keeps_the_network(tmp_path: Path) -> None:
    save_parts(networked(network()), tmp_path / "face.usda")
    assert exit_code("import", "usd", tmp_path / "face.usda", tmp_path / "again.usda") == 0
    assert same(facepipe.open(tmp_path / "again.usda").slider_network, network())


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    face, learned, posed, model = (tmp_path / name for name in ("f.usda", "l.usda", "p.usda", "s.onnx"))
    save_parts(networked(None), face)
    file = save_network(tmp_path / "net.npz", network())
    assert "4 -> 16 -> 5" in done(capsys, "sliders", face, "--from-network", file, "-o", learned)
    assert json.loads(done(capsys, "sliders", learned, "--json"))["network"]["layers"] == [4, 16, 5]
    values = read_kept(learned, SlidersOfFace).values
    assert (values["network"], values["table"]) == (file, None)
    done(capsys, "sliders", learned, "--set", "jaw=0.5", "-o", posed)
    done(capsys, "export", posed, "--sliders", "--points", "-o", model)
    found, expected = Deformer(model).evaluate()["points"], facepipe.open(posed).evaluate(sliders={})
    assert np.abs(found - expected).max() < TOLERANCE * facepipe.open(posed).head_height
    for words in (
        [file],
        [face, "-o", tmp_path / "x.usda"],
        [file, "--set", "jaw=1", "-o", tmp_path / "x.usda"],
        [tmp_path / "none.npz", "-o", tmp_path / "x.usda"],
    ):
        failed(capsys, "sliders", face, "--from-network", *words, folder=tmp_path)


def test_parts_without_its_sliders_are_not_authored() -> None:
    parts: FaceParts = replace(networked(network()), sliders=SLIDERS[1:])
    with pytest.raises(FacepipeError, match="no slider 'jaw'"):
        Face.from_parts(parts)
