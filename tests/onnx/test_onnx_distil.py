"""Sliders learned by a small network, as graphs: against the rig, the sliders they learned, and their own words."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from command_line import done, failed, run
from facepipe_onnx import Deformer, Options, export_parts, validate
from faces import with_head
from network_faces import SLIDERS, network, networked
from slider_faces import random_values, sample_with_sliders
from with_torch import torch

from facepipe.core.errors import InputError
from facepipe.parts import FaceParts
from facepipe.rig import build, slide
from facepipe.stage import save_parts
from facepipe.verbs.sliders import DistilReport, DistilSliders
from facepipe.verbs.sliders.distil import LEVER_MM, _driven

pytestmark = pytest.mark.needs_torch

ALLOWED = {"Clip", "Gemm", "MatMul", "Add", "Sub", "Mul", "Relu", "Tanh", "Sin", "Cos"} | {
    "Concat", "Slice", "Reshape", "Transpose", "Gather",
}  # fmt: skip
QUICK = {"steps": 1500}


def learned(parts: FaceParts, **options: Any) -> tuple[FaceParts, DistilReport]:
    return DistilSliders(**{**QUICK, **options})(parts)


def errors_mm(parts: FaceParts, graph: Deformer, seed: int, count: int = 40) -> np.ndarray:
    """(vectors, points) distances of a graph's points to those of the rig, sliders beyond their ranges too."""
    rig, random = build(parts), np.random.default_rng(seed)
    found = []
    for _ in range(count):
        values = random_values(parts, random)
        coefficients, weights = slide(parts.sliders, rig.joints, values, parts.slider_network)
        exact = rig.evaluate(weights, coefficients=coefficients)
        found.append(np.linalg.norm(graph.evaluate(sliders=values)["points"] - exact, axis=1))
    return np.array(found) * parts.meters_per_unit * 1000.0


def graph_of(parts: FaceParts, path: Path) -> Deformer:
    export_parts(parts, path, Options(sliders=True, points=True))
    assert validate(path) == ()
    return Deformer(path)


def test_an_output_counts_by_how_far_it_moves_points() -> None:
    """A shape by its largest offset, or by what is taken for outputs that move none."""
    parts = replace(networked(network()), meters_per_unit=1e-4)
    opened, smile = (replace(blendshape, inbetweens=()) for blendshape in parts.meshes[0].blendshapes)
    parts = with_head(parts, blendshapes=(opened, replace(smile, offsets=0 * smile.offsets)))
    parts = replace(parts, meshes=parts.meshes[:1])
    found = {one.shape: one.mm for one in _driven(build(parts), parts, ()) if one.shape}
    largest = 0.1 * float(np.linalg.norm(opened.offsets, axis=1).max())
    assert found == {"jawOpen": pytest.approx(largest), "mouthSmileLeft": LEVER_MM}


def test_learns_curves_and_says_how_well(tmp_path: Path) -> None:
    """The graph is as far off as the report says, and far nearer than without the network."""
    parts = sample_with_sliders()
    distilled, report = learned(parts)
    graph = graph_of(distilled, tmp_path / "l.onnx")
    found = errors_mm(parts, graph, seed=9)
    without = errors_mm(parts, graph_of(replace(distilled, slider_network=None), tmp_path / "n.onnx"), seed=9)
    assert report.points_mm is not None
    assert found.max() <= 3 * report.points_mm.max
    assert 0.5 < found.mean() / report.points_mm.mean < 2
    assert found.max() < 0.1 * without.max()
    assert graph.metadata["slider_network"]["info"]["distilled"]["points_mm"]["max"] == report.points_mm.max
    assert {node.op_type for node in onnx.load(tmp_path / "l.onnx").graph.node} <= ALLOWED


def test_what_is_straight_stays_exact() -> None:
    """Channels that no curve and no network drives get what they got."""
    parts = sample_with_sliders()
    distilled, report = learned(parts, steps=100)
    assert distilled.slider_network is not None
    rig, random = build(parts), np.random.default_rng(3)
    taught = {rig.joints.index(joint) for joint, _ in distilled.slider_network.channels}
    others = [i for i in range(len(rig.joints)) if i not in taught]
    assert len(others) > 20
    for _ in range(5):
        values = random_values(parts, random)
        exact, found = (
            slide(one.sliders, rig.joints, values, one.slider_network)[0][others] for one in (parts, distilled)
        )
        assert np.array_equal(exact, found)
    assert set(report.sliders) < {slider.name for slider in parts.sliders}


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_a_larger_network_is_learned_by_a_small_one(activation: str, tmp_path: Path) -> None:
    parts = networked(network((64, 64), size=0.3))
    distilled, report = learned(parts, width=24, activation=activation)
    assert distilled.slider_network is not None
    assert distilled.slider_network.weights[0].shape[0] == 24
    found = errors_mm(parts, graph_of(distilled, tmp_path / "l.onnx"), seed=4)
    bare = errors_mm(parts, graph_of(replace(parts, slider_network=None), tmp_path / "b.onnx"), seed=4)
    assert found.max() < 0.1 * bare.max()
    assert report.coefficients["rotation"].max < 0.05
    assert report.shape_weights is not None
    assert report.shape_weights.mean < 0.05


def test_more_units_learn_more() -> None:
    errors = [learned(networked(None), width=width)[1].points_mm for width in (1, 16)]
    assert errors[0] is not None
    assert errors[1] is not None
    assert errors[1].mean < 0.2 * errors[0].mean


def test_same_face_same_bytes_whatever_the_threads(tmp_path: Path) -> None:
    parts, files = networked(None), []
    before = torch.get_num_threads()
    for name, threads, seed in (("a", 1, 0), ("b", 2, 0), ("c", 1, 1)):
        torch.set_num_threads(threads)
        try:
            distilled, _ = learned(parts, steps=200, seed=seed)
            assert torch.get_num_threads() == threads
        finally:
            torch.set_num_threads(before)
        export_parts(distilled, tmp_path / f"{name}.onnx", Options(sliders=True))
        files.append((tmp_path / f"{name}.onnx").read_bytes())
    assert files[0] == files[1]
    assert files[0] != files[2]


def test_nothing_to_learn_leaves_the_exact_graph(tmp_path: Path) -> None:
    parts = replace(networked(None), sliders=tuple(one for one in SLIDERS if one.name in ("lip", "straight")))
    distilled, report = learned(parts)
    assert distilled is parts
    assert not report.missed
    assert "nothing to learn" in report.warnings[0]


def test_a_face_without_joints(tmp_path: Path) -> None:
    """Its shapes alone are learned; so are they where there are no points to measure on."""
    from slider_faces import jointless

    parts = jointless(replace(networked(None), sliders=(SLIDERS[2],)))
    distilled, report = learned(parts)
    found = errors_mm(parts, graph_of(distilled, tmp_path / "l.onnx"), seed=2)
    assert found.max() < 0.05 * 1000 * parts.meters_per_unit
    assert not report.coefficients
    bare = replace(networked(None), sliders=SLIDERS[:2], meshes=())
    assert learned(bare, steps=100)[1].points_mm is None


@pytest.mark.parametrize(
    ("word", "options"),
    [
        ("width", {"width": 0}),
        ("activation", {"activation": "sigmoid"}),
        ("steps", {"steps": 1}),
        ("seed", {"seed": -1}),
        ("threshold", {"threshold_mm": float("nan")}),
    ],
)
def test_options_out_of_range(word: str, options: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=word):
        DistilSliders(**options)(networked(None))


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 1 and a warning beyond the threshold; the graph is written and sound all the same."""
    stage, model = tmp_path / "face.usda", tmp_path / "learned.onnx"
    save_parts(networked(None), stage)
    words = ("export", stage, "--sliders", "--distil", "--distil-steps", "500", "-o", model, "--json")
    report = json.loads(done(capsys, *words, "--distil-threshold-mm", "1000", quiet=False))
    assert report["distilled"]["points_mm"]["max"] == report["error_mm"] > 0
    assert report["distilled"]["vectors"] == 200
    done(capsys, "validate", model, quiet=False)
    first = model.read_bytes()
    code, _, err = run(capsys, *words, "--distil-threshold-mm", "1e-9", "--force")
    assert (code, "expected at most 1e-09" in err) == (1, True)
    assert len(model.read_bytes()) == pytest.approx(len(first), abs=64)
    for wrong in (
        ["--distil", "-o", tmp_path / "x.onnx"],
        ["--sliders", "--distil-width", "4", "-o", tmp_path / "x.onnx"],
        ["--distil", "-o", tmp_path / "x.glb"],
        ["--sliders", "--distil", "--distil-width", "0", "-o", tmp_path / "x.onnx"],
    ):
        failed(capsys, "export", stage, *wrong, folder=tmp_path)
