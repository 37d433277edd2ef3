"""Graphs in onnxruntime's web runtime, against onnxruntime in Python."""

from __future__ import annotations

from pathlib import Path

import node
import numpy as np
import pytest
from facepipe_onnx import Deformer, Options, export_parts
from faces import tiny_face
from slider_faces import random_values, sample_with_sliders

from facepipe.parts import FaceParts

TOLERANCE = 1e-5
VECTORS = 20


def feeds_of(graph: Deformer, parts: FaceParts) -> list[dict[str, np.ndarray]]:
    """Random inputs with batch axis, values of sliders beyond their ranges among them."""
    rng = np.random.default_rng(0)
    feeds = []
    for _ in range(VECTORS):
        values = random_values(parts, rng)
        own = {"sliders": np.array([[values[name] for name in graph.sliders]])} if graph.sliders else {}
        own["weights"] = rng.uniform(0, 1, (1, len(graph.shapes)))
        feeds.append({name: array.astype(np.float32) for name, array in own.items()})
    return feeds


@pytest.mark.parametrize("points", [pytest.param(False, marks=pytest.mark.slow), True])
def test_sliders_of_the_sample(points: bool, tmp_path: Path) -> None:
    parts = sample_with_sliders()
    export_parts(parts, tmp_path / "sliders.onnx", Options(sliders=True, points=points))
    graph = Deformer(tmp_path / "sliders.onnx")
    feeds = feeds_of(graph, parts)
    for own, found in zip(feeds, node.onnx_run(graph.path, feeds), strict=True):
        expected = graph.run(own)
        assert set(found) == set(expected)
        for name, values in expected.items():
            assert found[name].shape == values.shape
            assert np.abs(found[name] - values).max() < TOLERANCE * max(np.ptp(values), 1.0), name


def test_a_deformer_with_normals(tmp_path: Path) -> None:
    """The operators beyond the list too: coefficients are at rest unless given."""
    parts = tiny_face()
    export_parts(parts, tmp_path / "face.onnx", Options(normals=True, joint_matrices=True))
    graph = Deformer(tmp_path / "face.onnx")
    coefficients = np.tile(np.array([0.1, 0, -0.2, 0.3, 0.2, -0.4, 1.1, 1, 0.9], np.float32), (1, 3, 1))
    feeds = [{**own, "coefficients": coefficients} for own in feeds_of(graph, parts)]
    for own, found in zip(feeds, node.onnx_run(graph.path, feeds), strict=True):
        for name, values in graph.run(own).items():
            assert np.abs(found[name] - values).max() < TOLERANCE * np.ptp(values), name
