"""The viewer in headless Chromium: what the page's face does, against onnxruntime in Python."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import browser
import numpy as np
import pytest
from browser import DRAWN, READY, browse, run
from facepipe_onnx import Deformer, Options, export_parts
from slider_faces import random_values, sample_with_sliders

from facepipe.stage import save_parts

pytestmark = [pytest.mark.gate, pytest.mark.slow]

TOLERANCE = 1e-5  # of the head height
CANVAS = "#view > canvas"


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    browser.chromium()
    path = tmp_path_factory.mktemp("web") / "sample.usda"
    save_parts(sample_with_sliders(), path)
    return path


@pytest.fixture(scope="module")
def url(sample: Path) -> Iterator[str]:
    with browser.viewing(sample) as url:
        yield url


@pytest.fixture(scope="module")
def reference(sample: Path) -> Deformer:
    """The same sliders in onnxruntime, with points."""
    path = sample.with_name("reference.onnx")
    export_parts(sample_with_sliders(), path, Options(sliders=True, points=True))
    return Deformer(path)


def expected(reference: Deformer, sliders: dict[str, float], shapes: dict[str, float]) -> np.ndarray:
    """(n, 3) points of all meshes, metres."""
    metadata = reference.metadata
    values = dict(zip(metadata["inputs"][0]["names"], metadata["inputs"][0]["values"], strict=True)) | sliders
    feeds = {
        "sliders": np.array([list(values.values())], np.float32),
        "weights": np.array([[shapes.get(name, 0.0) for name in metadata["inputs"][1]["names"]]], np.float32),
    }
    return np.asarray(reference.run(feeds)["points"])[0].astype(np.float64) * metadata["face"]["meters_per_unit"]


def head_height(reference: Deformer) -> float:
    face = reference.metadata["face"]
    return float(face["head_height"] * face["meters_per_unit"])


POINTS = run("return page.own.details.meshes.flatMap((mesh) => Array.from(face.points(mesh.name)))")


def test_a_slider_moved_in_the_page(url: str, reference: Deformer) -> None:
    """By hand: points are those of onnxruntime in Python, and the picture changes and comes back."""
    number = '.row[data-name="noseWidth"] input[type="number"]'
    unfold = run('document.querySelectorAll("details").forEach((one) => (one.open = true))')
    reset = {"click": 'button[aria-label="Reset sliders"]'}
    steps = [READY, unfold, DRAWN, {"hash": CANVAS}, {"fill": [number, "0.8"]}, {"press": "Tab"}, DRAWN]
    steps += [POINTS, {"hash": CANVAS}, reset, DRAWN, {"hash": CANVAS}, POINTS]
    results, problems = browse(url, *steps)
    assert problems == []
    before, moved, after = results[3], results[8], results[11]
    assert before == after != moved
    for found, sliders in ((results[7], {"noseWidth": 0.8}), (results[12], {})):
        error = np.reshape(found, (-1, 3)) - expected(reference, sliders, {})
        assert np.abs(error).max() < TOLERANCE * head_height(reference)


def test_random_poses(url: str, reference: Deformer) -> None:
    """All sliders and shapes at once; values beyond ranges are clamped as in Python."""
    rng, parts = np.random.default_rng(5), sample_with_sliders()
    poses = []
    for _ in range(4):
        shapes = {name: float(np.float32(rng.uniform(0, 1))) for name in reference.shapes}
        poses.append((random_values(parts, rng), shapes))
    steps = [READY]
    for sliders, shapes in poses:
        set_both = f"await face.setSliders({json.dumps(sliders)}); await face.setShapes({json.dumps(shapes)});"
        steps += [run(set_both), POINTS]
    results, problems = browse(url, *steps)
    assert problems == []
    for found, (sliders, shapes) in zip(results[2::2], poses, strict=True):
        error = np.reshape(found, (-1, 3)) - expected(reference, sliders, shapes)
        assert np.abs(error).max() < TOLERANCE * head_height(reference)


@pytest.mark.parametrize(
    ("flags", "backend"),
    [([], "wasm"), (["--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader"], "webgpu")],
)
def test_webgpu_where_there_is_one(url: str, flags: list[str], backend: str) -> None:
    """Both ways to evaluate the graph, and more threads, give the same points; without a device WebAssembly does."""
    other = """
        const { glb, onnx } = page.own.entry, pose = { noseWidth: 0.8, smile: 0.5 };
        const found = [];
        await face.setSliders(pose);
        for (const options of [{ backend: "webgpu" }, { threads: 2 }]) {
          const other = await facepipe.loadFace(glb, onnx, options);
          await other.setSliders(pose);
          const [a, b] = [other.points("Head"), face.points("Head")];
          found.push(other.network.backend, Math.max(...a.map((value, i) => Math.abs(value - b[i]))));
        }
        return found;"""
    results, problems = browse(url, READY, run(other), flags=flags, webgpu=True)
    assert problems == []
    used, far, plain, threads_far = results[1]
    assert (used, plain) == (backend, "wasm")
    assert max(far, threads_far) < TOLERANCE * 0.28  # metres: the sample's head


def test_values_set_at_once_end_at_the_last(url: str) -> None:
    """Without waiting: the graph runs once at a time, and the face ends where it was sent last."""
    hurry = "const all = [0.1, 0.9, 0.4].map((value) => face.setSliders({ smile: value })); await Promise.all(all);"
    results, problems = browse(url, READY, run(hurry), POINTS, run("await face.setSliders({ smile: 0.4 })"), POINTS)
    assert problems == []
    assert results[2] == results[4]
