"""Milliseconds per image of the differentiable face, forward and forward with backward, on one thread and on two.

usage: python benchmarks/photo_fit.py [--runs 20] [--size 256] [--threads 1 2] [--json out.json]

The face is the built-in sample: about 20,000 triangles with textures, seen at an angle, in float32. Steps:

  rig       sliders and shape weights to points
  image     points to an image: normals, rasterising, textures, spherical-harmonics light, blended outlines
  whole     both

`backward` brings gradients to sliders, shape weights, pose, focal length, light and tints. Medians of `--runs` calls
after 3 that are not counted. Wall time is worth something on a quiet machine only; processor time is of all threads.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from arguments import positive
from tables import aligned

from facepipe.learn.camera import Camera
from facepipe.learn.face_model import FaceModel, Look
from facepipe.learn.light import ambient, distant
from facepipe.parts import FaceParts
from facepipe.render.camera import Frame, portrait
from facepipe.sample import make

WARM_UP = 3


def main() -> None:
    """Measure, print the table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=positive, default=20, help="timed calls of each kind (default 20)")
    parser.add_argument("--size", type=positive, default=256, help="pixels a side (default 256)")
    parser.add_argument("--threads", type=positive, nargs="+", default=[1, 2], help="torch's threads (default 1 2)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    parts = make(0)
    model = FaceModel(parts)
    calls = steps(parts, model, arguments.size)
    rows: list[dict[str, Any]] = []
    for threads in arguments.threads:
        torch.set_num_threads(threads)
        rows += [{"threads": threads, "step": name, **measured(call, arguments.runs)} for name, call in calls.items()]
    triangles = len(model.outline.triangles)
    print(table(rows))
    print(f"\n{triangles:,} triangles, {arguments.size} x {arguments.size} pixels, medians of {arguments.runs} calls")
    if arguments.json:
        result = {
            "rows": rows,
            "runs": arguments.runs,
            "size": arguments.size,
            "triangles": triangles,
            "versions": {"torch": torch.__version__, "numpy": np.__version__, "python": platform.python_version()},
        }
        arguments.json.write_text(json.dumps(result, indent=2, sort_keys=True), encoding="utf-8")


def steps(parts: FaceParts, model: FaceModel, size: int) -> dict[str, Callable[[], None]]:
    """What is timed, by name."""
    points = model.rig().numpy()
    own = portrait(points, (0.3, 0.1), Frame(width=size, height=size))
    seen = Camera.at(own.axes, own.eye, own.focal, own.center)
    towards = torch.nn.functional.normalize(torch.tensor([0.5, 0.5, 1.0]), dim=0)
    free = {
        "sliders": model.rig.sliders.value + 0.1,
        "weights": torch.full((len(model.rig.shapes),), 0.1),
        "rotation": seen.rotation,
        "translation": seen.translation,
        "focal": seen.focal,
        "light": ambient(torch.full((3,), 0.4)) + distant(towards, torch.full((3,), 0.6)),
        "tint": torch.ones((len(model.colors.names), 3)),
    }
    for value in free.values():
        value.requires_grad_()
    placed = model.rig().requires_grad_()

    def image(at: torch.Tensor) -> torch.Tensor:
        camera = Camera(
            rotation=free["rotation"], translation=free["translation"], focal=free["focal"], center=seen.center
        )
        look = Look(camera=camera, light=free["light"], background=torch.zeros(3), tint=free["tint"])
        return model.image(at, look, height=size, width=size)

    def rig() -> torch.Tensor:
        return model.rig(free["sliders"], free["weights"])

    makers = {"rig": rig, "image": lambda: image(placed), "whole": lambda: image(rig())}
    calls: dict[str, Callable[[], None]] = {}
    for name, make_it in makers.items():
        calls[f"{name} forward"] = lambda make_it=make_it: forward(make_it)
        calls[f"{name} forward + backward"] = lambda make_it=make_it: (make_it() ** 2).sum().backward()
    return calls


def forward(make_it: Callable[[], torch.Tensor]) -> None:
    """The result alone."""
    with torch.no_grad():
        make_it()


def measured(call: Callable[[], None], runs: int) -> dict[str, float]:
    """Median wall and processor seconds of a call."""
    wall, processor = [], []
    for number in range(WARM_UP + runs):
        began = time.perf_counter(), time.process_time()
        call()
        if number >= WARM_UP:
            wall.append(time.perf_counter() - began[0])
            processor.append(time.process_time() - began[1])
    return {"wall_s": statistics.median(wall), "processor_s": statistics.median(processor), "best_wall_s": min(wall)}


def table(rows: list[dict[str, Any]]) -> str:
    """The figures for people."""
    cells = [("threads", "step", "wall ms", "best", "processor ms")]
    for row in rows:
        figures = (f"{1e3 * row[key]:.1f}" for key in ("wall_s", "best_wall_s", "processor_s"))
        cells.append((str(row["threads"]), row["step"], *figures))
    return "\n".join(aligned(cells))


if __name__ == "__main__":
    main()
