"""The committed samples are good faces on the generator's topology."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import facepipe
from facepipe.validate import validate

FOLDER = Path(__file__).parents[1] / "samples"
FILES = sorted(FOLDER.glob("*.usdz"))


def test_there_are_samples_of_different_people() -> None:
    points = [facepipe.open(file).evaluate() for file in FILES]
    assert len(points) >= 2
    assert np.abs(points[0] - points[1]).max() > 0.1


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_sample_validates(file: Path) -> None:
    assert [finding for finding in validate(file) if finding.severity != "info"] == []


def test_samples_are_what_the_generator_makes() -> None:
    spec = importlib.util.spec_from_file_location("generate_samples", FOLDER / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    generate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generate)
    for seed in generate.SEEDS:
        committed = facepipe.open(FOLDER / f"head{seed}.usdz")
        made = generate.small(generate.make(seed))
        assert [mesh.name for mesh in committed.meshes] == [mesh.name for mesh in made.meshes]
        for one, other in zip(committed.meshes, made.meshes, strict=True):
            np.testing.assert_array_equal(one.face_vertex_indices, other.face_vertex_indices)
            np.testing.assert_allclose(one.points, other.points, atol=1e-4)
        assert set(committed.shapes) == set(generate.SHAPES)
