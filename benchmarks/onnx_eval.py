"""Milliseconds per evaluation of the ONNX deformer: onnxruntime, numpy doing the same, and the bandwidth bound.

usage: python benchmarks/onnx_eval.py [--runs 300] [--json out.json] [--data FOLDER]

All on one thread. Faces: ICT-FaceKit (26,719 points, 53 shapes), MakeHuman (77 joints) and a made-up face of 20,000
points, 100 joints and 52 shapes that move every point. Columns:

  onnx        onnxruntime `run`, model in the caches of the processor after the evaluations before it
  onnx cold   the same after reading 256 MB of something else, as in a frame that does other work
  dense       numpy float32: all targets as one dense matrix, skin weights as one dense matrix
  rig         facepipe's own evaluation: numpy float64, sparse
  bound       bytes of the graph's non-zero stored numbers / read bandwidth of an array of that size
  bound cold  the same bytes / read bandwidth of an array of 512 MB

Read bandwidth is the best of three numpy reductions. The graph stores some zeros: `stored` counts them too. A face of
few bytes, like MakeHuman without targets, is bound by its nodes and arithmetic, not by bandwidth.

A second table, in microseconds, is of graphs of sliders (`facepipe export --sliders`); aim: 100 on one thread.

  moving  joints that some slider moves; the others are constants in the graph
  onnx    onnxruntime `run`: coefficients, skinning matrices and morph weights
  points  the same and the points
  rig     facepipe's own coefficients and skinning matrices: numpy float64
"""

# ruff: noqa: E402  (threads are pinned before numpy is imported)
from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import json
import platform
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from facepipe_onnx import Deformer, export_parts
from onnx_timing import median, start
from slider_graphs import SliderRow, slider_ratios, slider_rows, slider_table

from facepipe.importers import load
from facepipe.parts import Blendshape, FaceParts, Mesh, Skeleton, Skin
from facepipe.rig import Rig, build, rest_coefficients

LARGE = 512 << 20
OTHER_WORK = 256 << 20
SOURCES = {"ict": "ict_facekit/ict_facekit.npz", "makehuman": "makehuman/makehuman_head.npz"}


@dataclass(frozen=True, kw_only=True)
class Row:
    """One face's figures, times in milliseconds."""

    face: str
    points: int
    shapes: int
    joints: int
    file_mb: float
    stored_mb: float
    nonzero_mb: float
    onnx: float
    onnx_cold: float
    dense: float
    rig: float
    bound: float
    bound_cold: float
    error: float  # largest difference to the rig, in head heights


def main() -> None:
    """Measure, print the table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=300, help="timed evaluations of each kind (default 300)")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--data", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "data")
    arguments = parser.parse_args()
    faces, skipped = gather(arguments.data)
    large = bandwidth(LARGE)
    rows = [measure(name, parts, arguments.runs, large) for name, parts in faces.items()]
    sliders = slider_rows(faces.get("makehuman"), arguments.runs, np.ones(OTHER_WORK // 4, np.float32))
    print(f"{table(rows)}\n\n{slider_table(sliders)}")
    print(f"\nread bandwidth of {LARGE >> 20} MB: {large / 1e9:.1f} GB/s; medians of {arguments.runs} evaluations")
    for line in skipped:
        print(line)
    if arguments.json:
        arguments.json.write_text(
            json.dumps(document(rows, sliders, skipped, large, arguments.runs), indent=2, sort_keys=True)
        )


def gather(data: Path) -> tuple[dict[str, FaceParts], list[str]]:
    """Faces to measure by name, and what is missing."""
    faces, skipped = {}, []
    for name, source in SOURCES.items():
        if (data / source).is_file():
            faces[name] = load(name, data / source).parts
        else:
            skipped.append(f"skipped {name}: {source} is not in the data folder")
    if "ict" not in faces:
        faces["like ict"] = made_up(26719, 0, 53, reach=0.29)
    faces["made up"] = made_up(20000, 100, 52, reach=1.0)
    return faces, skipped


def made_up(points: int, joints: int, shapes: int, *, reach: float) -> FaceParts:
    """A face of random numbers whose shapes move `reach` of its points each, with up to 4 of its joints a point."""
    rng = np.random.default_rng(0)
    count = int(points * reach)
    starts = rng.integers(0, points - count + 1, shapes)
    blendshapes = tuple(
        Blendshape(
            name=f"shape{i}",
            point_indices=np.arange(start, start + count, dtype=np.int32),
            offsets=rng.normal(size=(count, 3)).astype(np.float32),
        )
        for i, start in enumerate(starts)
    )
    skin, skeleton = None, Skeleton()
    if joints:
        weights = rng.random((points, 4))
        first = np.arange(points) * (joints - 3) // points
        indices = (first[:, None] + np.arange(4)).astype(np.int32)
        skin = Skin(joint_indices=indices, joint_weights=weights / weights.sum(axis=1, keepdims=True))
        names = ["j0", *(f"j0/j{i}" for i in range(1, joints))]
        rest = np.tile(np.eye(4), (joints, 1, 1))
        rest[:, :3, 3] = rng.normal(size=(joints, 3))
        binds = rest.copy()
        binds[1:] = rest[0] @ rest[1:]
        skeleton = Skeleton(joints=tuple(names), bind_transforms=binds, rest_transforms=rest)
    mesh = Mesh(
        name="Head",
        points=10 * rng.normal(size=(points, 3)),
        face_vertex_counts=np.array([3], np.int32),
        face_vertex_indices=np.arange(3, dtype=np.int32),
        skin=skin,
        blendshapes=blendshapes,
    )
    return FaceParts(meshes=(mesh,), skeleton=skeleton)


def measure(name: str, parts: FaceParts, runs: int, large: float) -> Row:
    """All figures of one face."""
    rig = build(parts)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "face.onnx"
        export_parts(parts, path)
        model, size, deformer = onnx.load(path), path.stat().st_size, Deformer(path)
        session = start(path)
    rng = np.random.default_rng(1)
    weights = rng.random(len(rig.shapes))
    coefficients = rest_coefficients(len(rig.joints)) + 0.1 * rng.normal(size=(len(rig.joints), 9))
    given = coefficients if rig.joints else None
    feeds: dict[str, Any] = {}
    if rig.shapes:
        feeds["weights"] = weights[None].astype(np.float32)
    if rig.joints:
        feeds["coefficients"] = coefficients[None].astype(np.float32)
    expected = rig.evaluate(weights, coefficients=given)
    difference = np.abs(deformer.run(feeds)["points"][0] - expected).max()
    stored, nonzero = tensor_bytes(model)
    other = np.ones(OTHER_WORK // 4, np.float32)

    def evaluate() -> object:
        return session.run(None, feeds)

    return Row(
        face=name,
        points=len(rig.points),
        shapes=len(rig.shapes),
        joints=len(rig.joints),
        file_mb=size / 1e6,
        stored_mb=stored / 1e6,
        nonzero_mb=nonzero / 1e6,
        onnx=median(evaluate, runs),
        onnx_cold=median(evaluate, max(5, runs // 10), before=lambda: other.sum()),
        dense=median(dense(rig, weights, given), max(5, runs // 3)),
        rig=median(lambda: rig.evaluate(weights, coefficients=given), max(5, runs // 10)),
        bound=1e3 * nonzero / bandwidth(nonzero),
        bound_cold=1e3 * nonzero / large,
        error=float(difference / np.ptp(rig.evaluate()[:, 1])),
    )


def tensor_bytes(model: Any) -> tuple[int, int]:
    """Bytes of the stored float tensors, and of their numbers that are not zero."""
    tensors = [onnx.numpy_helper.to_array(one) for one in model.graph.initializer if one.data_type == 1]
    return sum(tensor.nbytes for tensor in tensors), sum(4 * int(np.count_nonzero(tensor)) for tensor in tensors)


def dense(rig: Rig, weights: np.ndarray, coefficients: np.ndarray | None) -> Callable[[], object]:
    """The same evaluation in float32 numpy, with the targets and the skin weights as dense matrices."""
    offsets = rig.deltas.toarray().T.astype(np.float32)
    neutral = rig.points.ravel().astype(np.float32)
    if coefficients is None:
        own = rig.activations(weights).astype(np.float32)
        return lambda: np.tensordot(own, offsets, 1) + neutral
    skin = rig.influences.toarray().astype(np.float32)

    def evaluate() -> object:
        points = neutral
        if rig.targets:
            points = np.tensordot(rig.activations(weights).astype(np.float32), offsets, 1) + neutral
        matrices = rig.skinning_matrices(rig.local_transforms(coefficients))[:, :3].astype(np.float32)
        blended = (skin @ matrices.reshape(-1, 12)).reshape(-1, 3, 4)
        return np.einsum("nij,nj->ni", blended[:, :, :3], points.reshape(-1, 3)) + blended[:, :, 3]

    return evaluate


def bandwidth(size: int) -> float:
    """Bytes a second at which one thread reads an array of `size` bytes over and over."""
    array = np.ones(max(size // 4, 64), np.float32)
    rows = array[: len(array) // 16 * 16].reshape(16, -1)
    few = np.ones(16, np.float32)
    runs = int(np.clip((1 << 30) // array.nbytes, 4, 300))
    calls: tuple[Callable[[], object], ...] = (array.sum, lambda: array @ array, lambda: few @ rows)
    return array.nbytes / (1e-3 * min(median(call, runs) for call in calls))


def table(rows: list[Row]) -> str:
    """The figures for people."""
    head = "face       points shapes joints  file MB stored MB non-zero MB   onnx  cold  dense    rig  bound  cold"
    lines = [f"{head}  onnx/bound cold/cold dense/onnx rig/onnx    error"]
    for one in rows:
        over = ratios(one)
        lines.append(
            f"{one.face:10} {one.points:6} {one.shapes:6} {one.joints:6} {one.file_mb:8.2f} {one.stored_mb:9.2f} "
            f"{one.nonzero_mb:11.2f} {one.onnx:6.3f} {one.onnx_cold:5.2f} {one.dense:6.3f} {one.rig:6.3f} "
            f"{one.bound:6.3f} {one.bound_cold:5.2f} {over['onnx / bound']:11.2f} "
            f"{over['onnx cold / bound cold']:9.2f} {over['dense / onnx']:10.2f} {over['rig / onnx']:8.2f} "
            f"{one.error:8.1e}"
        )
    return "\n".join([*lines, "times in milliseconds"])


def ratios(one: Row) -> dict[str, float]:
    """What the times are worth; aims for ICT: onnx below 2 ms, and below 3 times its bound."""
    return {
        "onnx / bound": one.onnx / one.bound,
        "onnx cold / bound cold": one.onnx_cold / one.bound_cold,
        "dense / onnx": one.dense / one.onnx,
        "rig / onnx": one.rig / one.onnx,
    }


def document(rows: list[Row], sliders: list[SliderRow], skipped: list[str], large: float, runs: int) -> dict[str, Any]:
    """The figures as JSON."""
    return {
        "faces": [asdict(row) | {"ratios": ratios(row)} for row in rows],
        "machine": {"processor": platform.processor() or platform.machine(), "read_bandwidth_large": large},
        "runs": runs,
        "skipped": skipped,
        "sliders": [asdict(slider) | {"ratios": slider_ratios(slider)} for slider in sliders],
        "versions": {"numpy": np.__version__, "onnx": onnx.__version__, "onnxruntime": onnxruntime.__version__},
    }


if __name__ == "__main__":
    main()
