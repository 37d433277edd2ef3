"""Graphs of sliders that a small network has learned, against the exact graphs: bytes, microseconds, millimetres.

usage: python benchmarks/distilled_sliders.py [--runs 3000] [--widths 8 32 128] [--json out.json] [--data FOLDER]

onnxruntime on one thread, medians, exact and learned in turn. Faces: the sample (two curved sliders), MakeHuman with 60
sliders over the joints of its head, half of them curves of four knots over 72 channels each, and the sample with a
network of three layers of 256 units over eight of its sliders. Above 1 a ratio speaks for the learned graph.
"""

# ruff: noqa: E402  (threads are pinned before numpy is imported)
from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import itertools
import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from arguments import positive
from facepipe_onnx import Options, export_parts
from onnx_timing import median, start
from slider_graphs import driven
from tables import aligned

from facepipe.heads import make
from facepipe.importers import load
from facepipe.parts import FaceParts, SliderNetwork
from facepipe.verbs.sliders import DistilSliders

_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
LARGE = (256, 256, 256)


@dataclass(frozen=True, kw_only=True)
class Row:
    """One learned graph beside the exact one of its face."""

    face: str
    width: int
    exact_kb: float
    learned_kb: float
    exact_us: float
    learned_us: float
    mean_mm: float
    p95_mm: float
    max_mm: float

    def cells(self) -> tuple[str, ...]:
        """For people."""
        sizes = [f"{self.exact_kb:.0f}", f"{self.learned_kb:.0f}", f"{self.exact_kb / self.learned_kb:.2f}"]
        times = [f"{self.exact_us:.1f}", f"{self.learned_us:.1f}", f"{self.exact_us / self.learned_us:.2f}"]
        errors = [f"{one:.2g}" for one in (self.mean_mm, self.p95_mm, self.max_mm)]
        return (self.face, str(self.width), *sizes, *times, *errors)


HEAD = (
    *("face", "width", "exact KB", "learned KB", "ratio"),
    *("exact us", "learned us", "ratio", "mean mm", "p95", "max"),
)


def main() -> None:
    """Learn, measure, print the table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=positive, default=3000, help="timed evaluations (default 3000)")
    parser.add_argument("--widths", type=positive, nargs="+", default=[8, 32, 128], help="of the learned networks")
    parser.add_argument("--steps", type=positive, default=6000, help="of training (default 6000)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    parser.add_argument("--data", type=Path, default=_DATA, help="folder of the source faces")
    arguments = parser.parse_args()
    rows = [
        measured(name, parts, width, arguments)
        for name, parts in faces(arguments.data).items()
        for width in arguments.widths
    ]
    print("\n".join(aligned([HEAD, *(row.cells() for row in rows)])))
    if arguments.json:
        text = json.dumps([asdict(row) for row in rows], indent=2, sort_keys=True)
        arguments.json.write_text(text, encoding="utf-8")


def faces(data: Path) -> dict[str, FaceParts]:
    """The faces by name."""
    sample = make(0, controls="bones")
    found = {"sample": sample}
    file = data / "makehuman" / "makehuman_head.npz"
    if file.is_file():
        parts = load("makehuman", file).parts
        found["makehuman curves"] = driven(parts, [name for name in parts.skeleton.joints if "/head" in name])
    found["sample, large network"] = replace(sample, slider_network=large(sample))
    return found


def large(parts: FaceParts) -> SliderNetwork:
    """A network that bends the face smoothly by some millimetres."""
    random = np.random.default_rng(0)
    moved = sorted({(joint, channel) for slider in parts.sliders for joint, channel, _ in slider.channels})
    taken = tuple(slider.name for slider in parts.sliders)[:: len(parts.sliders) // 8][:8]
    sizes = (len(taken), *LARGE, len(moved))
    weights = [random.normal(size=(out, into)) / np.sqrt(into) for into, out in itertools.pairwise(sizes)]
    size = [0.1 if channel.startswith("t") else 0.02 for _, channel in moved]
    weights[-1] *= np.array(size)[:, None]
    return SliderNetwork(
        sliders=taken,
        channels=tuple(moved),
        weights=tuple(weights),
        biases=tuple(np.zeros(out) for out in sizes[1:]),
    )


def activation_of(parts: FaceParts) -> Literal["relu", "tanh"]:
    """What suits a face."""
    return "relu" if parts.slider_network is None else "tanh"


def measured(name: str, parts: FaceParts, width: int, arguments: argparse.Namespace) -> Row:
    """Both graphs of a face, in turn."""
    distilled, report = DistilSliders(width=width, activation=activation_of(parts), steps=arguments.steps)(parts)
    random = np.random.default_rng(1)
    values = [[random.uniform(slider.minimum, slider.maximum) for slider in parts.sliders]]
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / "exact.onnx", Path(folder) / "learned.onnx"]
        sizes = [
            export_parts(one, file, Options(sliders=True)).bytes
            for one, file in zip((parts, distilled), files, strict=True)
        ]
        sessions = [start(file) for file in files]
    feeds = {"sliders": np.array(values, np.float32)}
    shapes = [one for one in sessions[0].get_inputs() if one.name == "weights"]
    feeds |= {shape.name: np.zeros(shape.shape, np.float32) for shape in shapes}
    exact, learned = fastest(sessions, feeds, arguments.runs)
    points = report.points_mm
    assert points is not None
    return Row(
        face=name,
        width=width,
        exact_kb=sizes[0] / 1e3,
        learned_kb=sizes[1] / 1e3,
        exact_us=exact,
        learned_us=learned,
        mean_mm=points.mean,
        p95_mm=points.p95,
        max_mm=points.max,
    )


def fastest(sessions: Sequence[Any], feeds: dict[str, Any], runs: int) -> list[float]:
    """Microseconds of each session: the least of five medians, in turn, so that other work disturbs neither alone."""
    times = [[1e3 * median(partial(own.run, None, feeds), max(1, runs // 5)) for own in sessions] for _ in range(5)]
    return [min(column) for column in zip(*times, strict=True)]


if __name__ == "__main__":
    main()
