"""Graphs of sliders whose gains and networks are stored in fewer bytes."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import node
import numpy as np
import onnx
import pytest
from command_line import failed
from facepipe_onnx import Deformer, Options, export_parts, validate
from facepipe_onnx.packed_weights import rounded
from network_faces import network, networked
from neural_faces import face, neural_rig
from slider_faces import jointless, random_values, sample_with_sliders

from facepipe.core.errors import ExportError, InputError
from facepipe.neural import with_neural_rig
from facepipe.parts import FaceParts, Slider
from facepipe.rig import build, slide
from facepipe.stage import save_parts


def neural() -> FaceParts:
    """A face with a neural rig of some size."""
    parts = face()
    return with_neural_rig(parts, neural_rig(parts, bones=True, shapes=12, units=96), "face")


FACES: dict[str, Callable[[], FaceParts]] = {
    "network": lambda: networked(network((16, 9))),
    "neural rig": neural,
    "sample": sample_with_sliders,
    "no joints": lambda: rigless(),
}


def rigless() -> FaceParts:
    """Sliders of shapes alone."""
    sliders = (
        Slider(name="open", minimum=-0.3, shapes=(("jawOpen", 0.7), ("mouthSmileLeft", -0.2))),
        Slider(name="smile", shapes=(("mouthSmileLeft", 0.9),)),
    )
    return replace(jointless(sample_with_sliders()), sliders=sliders)


def errors(parts: FaceParts, graph: Deformer, rows: list[dict[str, float]]) -> tuple[float, float]:
    """Largest distance of a point from the rig's, and how far points move, both in millimetres."""
    rig, off, moved = build(parts), 0.0, 0.0
    rest = rig.evaluate()
    for values in rows:
        coefficients, weights = slide(parts.sliders, rig.joints, values, parts.slider_network)
        expected = rig.evaluate(weights, coefficients=coefficients)
        found = graph.evaluate(sliders=values)["points"]
        off = max(off, float(np.linalg.norm(found - expected, axis=1).max()))
        moved = max(moved, float(np.linalg.norm(expected - rest, axis=1).max()))
    return 1e3 * parts.meters_per_unit * off, 1e3 * parts.meters_per_unit * moved


@pytest.mark.parametrize("name", FACES)
@pytest.mark.parametrize(("weights", "share"), [("float16", 2e-3), ("int8", 3e-2)])
def test_points_are_off_by_little_as_reported(name: str, weights: Any, share: float, tmp_path: Path) -> None:
    parts, path = FACES[name](), tmp_path / "packed.onnx"
    report = export_parts(parts, path, Options(sliders=True, points=True, pose="rest", weights=weights))
    assert validate(path) == ()
    graph, random = Deformer(path), np.random.default_rng(3)
    off, moved = errors(parts, graph, [random_values(parts, random) for _ in range(40)])
    assert 0.0 < off < share * moved
    packed = json.loads((tmp_path / "packed.onnx.json").read_text())["packed_weights"]
    assert packed == graph.metadata["packed_weights"]
    assert (packed["type"], packed["error_mm"]) == (weights, report.error_mm)
    assert off < 4.0 * packed["error_mm"]
    assert packed["error_mm"] < share * moved


@pytest.mark.parametrize("name", FACES)
@pytest.mark.parametrize("weights", ["float16", "int8"])
def test_defaults_are_as_they_were(name: str, weights: Any, tmp_path: Path) -> None:
    parts = FACES[name]()
    export_parts(parts, tmp_path / "packed.onnx", Options(sliders=True, points=True, pose="rest", weights=weights))
    defaults = {slider.name: slider.default for slider in parts.sliders}
    off, _ = errors(parts, Deformer(tmp_path / "packed.onnx"), [defaults])
    height = 1e3 * parts.meters_per_unit * np.ptp(build(parts).points, axis=0).max()
    assert off < 1e-5 * height


def test_files_are_smaller_and_say_what_they_need(tmp_path: Path) -> None:
    parts, sizes = neural(), []
    for weights, kinds in (("float32", {1, 7}), ("float16", {1, 7, 10}), ("int8", {1, 3, 7})):
        path = tmp_path / f"{weights}.onnx"
        export_parts(parts, path, Options(sliders=True, pose="rest", weights=weights))  # type: ignore[arg-type]
        model = onnx.load(str(path))
        assert {one.data_type for one in model.graph.initializer} == kinds
        sizes.append(sum(one.ByteSize() for one in model.graph.initializer))
        assert Deformer(path).metadata["further_operators"] == ([] if weights == "float32" else ["Cast"])
        again = tmp_path / f"{weights} again.onnx"
        export_parts(parts, again, Options(sliders=True, pose="rest", weights=weights))  # type: ignore[arg-type]
        assert path.read_bytes() == again.read_bytes()
    assert "packed_weights" not in Deformer(tmp_path / "float32.onnx").metadata
    assert sizes[2] < sizes[1] < sizes[0]


def test_rows_make_up_for_one_another() -> None:
    random = np.random.default_rng(0)
    samples = random.normal(size=(400, 3)) @ random.normal(size=(3, 30)) + 0.1 * random.normal(size=(400, 30))
    matrix = random.normal(size=(30, 4))
    expected = (samples - samples[0]) @ matrix

    def off(found: np.ndarray) -> float:
        return float(np.sqrt(np.mean(((samples - samples[0]) @ found - expected) ** 2)))

    found = rounded(matrix, samples, np.rint)
    assert np.array_equal(found, np.rint(found))
    assert off(found) < 0.5 * off(np.rint(matrix))


def test_steps_begin_at_the_first_sample() -> None:
    """Both rows always move together: what one loses by rounding goes to the other."""
    samples = np.array([[0.0, 0.0], [1.0, 1.0], [1.0, 1.0]])
    assert rounded(np.array([[0.4], [0.4]]), samples, np.rint).tolist() == [[0.0], [1.0]]


@pytest.mark.parametrize("weights", [pytest.param("float16", marks=pytest.mark.slow), "int8"])
def test_the_web_runtime_gives_the_same(weights: Any, tmp_path: Path) -> None:
    parts = neural()
    export_parts(parts, tmp_path / "packed.onnx", Options(sliders=True, points=True, pose="rest", weights=weights))
    graph, random = Deformer(tmp_path / "packed.onnx"), np.random.default_rng(4)
    feeds = []
    for _ in range(4):
        values = random_values(parts, random)
        feeds.append(
            {
                "sliders": np.array([[values[name] for name in graph.sliders]], np.float32),
                "weights": np.zeros((1, len(graph.shapes)), np.float32),
            }
        )
    for own, found in zip(feeds, node.onnx_run(graph.path, feeds), strict=True):
        for name, values in graph.run(own).items():
            assert np.abs(found[name] - values).max() < 1e-5 * max(np.ptp(values), 1.0), name


def test_what_can_not_be_stored_so_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = networked(None)
    with pytest.raises(InputError, match="option weights: is 'int4', did you mean 'int8'"):
        export_parts(parts, tmp_path / "a.onnx", Options(sliders=True, weights="int4"))  # type: ignore[arg-type]
    far = replace(parts, sliders=(Slider(name="far", channels=(("root/jaw", "tx", 1e5),)),))
    with pytest.raises(ExportError, match="values beyond the range of float16, expected finite numbers"):
        export_parts(far, tmp_path / "a.onnx", Options(sliders=True, weights="float16"))
    save_parts(parts, tmp_path / "head.usda")
    err = failed(
        capsys, "export", tmp_path / "head.usda", "--weights", "int8", "-o", tmp_path / "a.onnx", folder=tmp_path
    )
    assert "option weights: is for graphs of sliders, expected the option sliders too" in err
