"""Neural rigs as an engine runs them: the graph of their controls, and their basis in a GLB."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from command_line import done, failed
from facepipe_onnx import Deformer, Options, export_parts, validate
from gltf_export import Writing, writing, written
from neural_faces import CONTROLS, face, neural_rig, random_values
from neural_graphs import TOLERANCE, Made, skinned

import facepipe
from facepipe.neural import load_neural_rig, save_neural_rig, with_neural_rig
from facepipe.rig import build
from facepipe.rig.neural_rig import NeuralRig
from facepipe.stage import save_parts
from facepipe.verbs.whole_faces import MILLIMETRES, world_to_world

__all__ = ["writing", "written"]

KINDS = ("bones", "points", "points without joints")


def made(kind: str, up_axis: Literal["Y", "Z"], unit: float, folder: Path, **options: Any) -> Made:
    parts = face(up_axis, unit, joints=kind != "points without joints")
    rig = neural_rig(parts, bones=kind == "bones")
    attached = with_neural_rig(parts, rig, "face")
    graphs = []
    for points in (False, True):
        path = folder / f"{points}.onnx"
        export_parts(attached, path, Options(sliders=True, points=points, pose="rest", **options))
        assert validate(path) == ()
        graphs.append(Deformer(path))
    return Made(attached, rig, *graphs)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("up_axis", "unit"), [("Y", 0.01), ("Z", 1.0)])
def test_matrices_on_the_glb_are_the_points_are_the_rig(
    kind: str, up_axis: Literal["Y", "Z"], unit: float, tmp_path: Path, writing: Writing
) -> None:
    one = made(kind, up_axis, unit, tmp_path)
    glb, _ = writing(one.parts, pose="rest")
    to = world_to_world(unit, up_axis, MILLIMETRES)
    values = random_values(one.rig, 12)
    worst = 0.0
    for row, expected in zip(values, one.rig.points(values), strict=True):
        points = one.points.evaluate(sliders=one.fed(row))["points"] @ to[:3, :3].T
        engine = 1e3 * skinned(one, glb, one.matrices.evaluate(sliders=one.fed(row)))
        worst = max(worst, np.abs(points - expected).max(), np.abs(engine - expected).max())
    assert worst < TOLERANCE * one.height


@pytest.mark.needs_torch
def test_torch_is_onnxruntime(tmp_path: Path) -> None:
    from with_torch import torch

    from facepipe.rig.torch.rig import DifferentiableRig

    one = made("bones", "Y", 0.01, tmp_path)
    learned = DifferentiableRig(
        build(one.parts), one.parts.sliders, dtype=torch.float64, network=one.parts.slider_network
    )
    values = random_values(one.rig, 8)
    expected = learned(torch.tensor(in_order(one.rig, values, learned.sliders.names))).numpy()
    found = np.array([one.points.evaluate(sliders=one.fed(row))["points"] for row in values])
    assert 10.0 * np.abs(found - expected).max() < TOLERANCE * one.height


@pytest.mark.parametrize("far", [1e1, 1e6])
def test_controls_beyond_their_limits_are_held_there(far: float, tmp_path: Path) -> None:
    one = made("bones", "Y", 0.01, tmp_path)
    for end, beyond in ((CONTROLS[1].maximum, far), (CONTROLS[1].minimum, -far)):
        held, there = (one.matrices.evaluate(sliders={"lip": value}) for value in (beyond, end))
        for name, expected in there.items():
            assert np.array_equal(held[name], expected), name


def test_the_metadata_shows_names_ranges_and_defaults(tmp_path: Path) -> None:
    one = made("bones", "Y", 0.01, tmp_path)
    beside = json.loads((tmp_path / "False.onnx.json").read_text())
    for metadata in (one.matrices.metadata, beside):
        given = metadata["inputs"][0]
        assert given["names"] == [*(control.name for control in CONTROLS), "old"]  # a slider that is no control stays
        assert given["range"][:3] == [[control.minimum, control.maximum] for control in CONTROLS]
        assert given["default"][:3] == [control.default for control in CONTROLS]
        network = metadata["slider_network"]
        assert network["info"] == {"kind": "neural rig", "topology": one.rig.topology}
        assert network["layers"] == [3, 6, 9]


def many(count: int) -> Callable[[NeuralRig], NeuralRig]:
    """A rig of as many controls as that."""

    def change(rig: NeuralRig) -> NeuralRig:
        times = -(-count // len(rig.controls))
        return replace(
            rig,
            controls=tuple(replace(one, name=f"{one.name}{i}") for i in range(times) for one in rig.controls),
            linear=np.tile(rig.linear, (times, 1)) / times,
            hidden=np.tile(rig.hidden, (1, times)) / times,
        )

    return change


def test_many_gains_are_in_the_graph_alone(tmp_path: Path) -> None:
    parts = face()
    rig = many(1500)(neural_rig(parts, bones=True))
    attached = with_neural_rig(parts, rig, "face")
    export_parts(attached, tmp_path / "rig.onnx", Options(sliders=True, points=True, pose="rest", batch=2))
    graph = Deformer(tmp_path / "rig.onnx")
    assert {one["channels"] for one in graph.metadata["sliders"]} == {None}
    gains = next(initializer for initializer in _initializers(tmp_path / "rig.onnx") if initializer.name == "gains")
    assert list(gains.dims) == [1506, 5]  # nothing for channels that don't move
    values = random_values(rig, 2)
    found = graph.run({"sliders": in_order(rig, values, graph.sliders)})["points"] * 10.0
    assert np.abs(found - rig.points(values)).max() < TOLERANCE * np.ptp(rig.rest[:, 1])


def in_order(rig: NeuralRig, values: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """(f, s) values of sliders; those that are no controls stay at 0."""
    columns = {one.name: values[:, number] for number, one in enumerate(rig.controls)}
    return np.stack([columns.get(name, np.zeros(len(values))) for name in names], axis=1)


def _initializers(path: Path) -> Any:
    import onnx

    return onnx.load(str(path)).graph.initializer


def test_the_commands_write_what_an_applied_stage_gives(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    head, file = tmp_path / "head.usda", tmp_path / "head.fpnr"
    save_parts(face(), head)
    save_neural_rig(neural_rig(facepipe.open(head).parts(), bones=True), file, {})
    neural = tmp_path / "neural.usda"
    for words in (
        ("neural-rig", "apply", head, file, "-o", neural),
        ("export", head, "--neural", file, "-o", tmp_path / "rig.onnx", "--points", "--pose", "rest"),
        ("export", neural, "--sliders", "--points", "-o", tmp_path / "same.onnx", "--pose", "rest"),
        ("export", head, "--neural", file, "-o", tmp_path / "rig.glb"),
        ("export", neural, "-o", tmp_path / "same.glb"),
        ("eval", tmp_path / "rig.onnx", "--slider", "jaw=0.6", "--slider", "brow=-20", "-o", tmp_path / "points.npz"),
        ("eval", tmp_path / "same.onnx", "--slider", "jaw=0.6", "--slider", "brow=-20", "-o", tmp_path / "same.npz"),
    ):
        out = done(capsys, *words, quiet=False)
        if "--neural" in words:
            assert "points are off by at most 0.0000 mm for offsets that its shapes leave out" in out
    rig, found, same = load_neural_rig(file), np.load(tmp_path / "points.npz"), np.load(tmp_path / "same.npz")
    expected = rig.points(rig.values({"jaw": 0.6, "brow": -20.0, "lip": 0.5}))  # lip as set on the face
    assert np.abs(10.0 * found["points"] - expected).max() < TOLERANCE * np.ptp(rig.rest[:, 1])
    assert np.abs(found["points"] - same["points"]).max() < TOLERANCE * np.ptp(same["points"][:, 1])
    assert abs((tmp_path / "rig.glb").stat().st_size - (tmp_path / "same.glb").stat().st_size) < 100


def test_flags_that_do_not_go_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    head, file = tmp_path / "head.usda", tmp_path / "head.fpnr"
    save_parts(face(), head)
    save_neural_rig(neural_rig(face(), bones=True), file, {})
    for words, message in (
        (("--neural", file, "--sliders", "--distil"), "--neural: given with --distil, expected one of them"),
        (("--offset-tolerance-mm", 0.1), "--offset-tolerance-mm: given without --neural, expected both"),
    ):
        assert message in failed(capsys, "export", head, *words, "-o", tmp_path / "rig.onnx", folder=tmp_path)


def test_what_shapes_leave_out_makes_a_smaller_file_and_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    head, file, out = tmp_path / "head.usda", tmp_path / "head.fpnr", tmp_path / "rig.glb"
    save_parts(face(), head)
    save_neural_rig(neural_rig(face(), bones=True), file, {})
    found = []
    for tolerance in (0.0, 1.0):
        words = ("export", head, "--neural", file, "--offset-tolerance-mm", tolerance, "-o", out, "--force", "--json")
        text = done(capsys, *words, quiet=False)
        found.append(json.loads(text))
    assert found[1]["bytes"] < found[0]["bytes"]
    assert 0.0 == found[0]["dropped_mm"] < found[1]["dropped_mm"]
