"""Milliseconds per image of the differentiable face, forward and forward with backward, on one thread and on two.

usage: python benchmarks/photo_fit.py [--runs 20] [--size 256] [--threads 1 2] [--fits 2] [--mitsuba PYTHON]
       [--mitsuba-spp 4 16] [--json out.json]

The face is the built-in sample: about 48,000 triangles, seen at an angle, in float32. Steps:

  rig       sliders and shape weights to points
  image     points to an image: normals, rasterising, textures, spherical-harmonics light, blended outlines
  whole     both

`backward` brings gradients to sliders, shape weights, pose, focal length, light and tints. Medians of `--runs` calls
after 3 that are not counted. Wall time is worth something on a quiet machine only; processor time is of all threads.

Then the renderer alone, against mitsuba's projective integrator on the same scene: gradients to all points and to the
camera's translation. Slopes off: how far the slope of a loss along a movement of the camera or of a slider is from
central differences of each renderer's own supersampled images. Last, seconds per fit of a portrait and microseconds per
evaluation of the sliders' ONNX graph.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import support_modules  # noqa: F401  (finds the modules of tests/support)
import torch
from arguments import positive
from photo_peer import compare, measured, peer_table
from slider_graphs import slider_rows
from tables import aligned

from facepipe.heads import make
from facepipe.parts import FaceParts
from facepipe.photo.renderer.camera import Camera
from facepipe.photo.renderer.face_model import FaceModel, Look
from facepipe.photo.renderer.light import ambient, distant
from facepipe.pictures.camera import portrait


def main() -> None:
    """Measure, print the table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=positive, default=20, help="timed calls of each kind (default 20)")
    parser.add_argument("--size", type=positive, default=256, help="pixels a side (default 256)")
    parser.add_argument("--threads", type=positive, nargs="+", default=[1, 2], help="torch's threads (default 1 2)")
    parser.add_argument("--fits", type=int, default=2, help="portraits to fit (default 2)")
    parser.add_argument("--mitsuba", metavar="PYTHON", help="an interpreter with mitsuba 3.9 and numpy")
    spp = "mitsuba's samples per pixel (default 4 16)"
    parser.add_argument("--mitsuba-spp", type=positive, nargs="+", default=[4, 16], metavar="N", help=spp)
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    parts = make(0, controls="bones")
    model = FaceModel(parts)
    calls = steps(parts, model, arguments.size)
    rows: list[dict[str, Any]] = []
    for threads in arguments.threads:
        torch.set_num_threads(threads)
        rows += [{"threads": threads, "step": name, **measured(call, arguments.runs)} for name, call in calls.items()]
    peer = compare(arguments.size, arguments.threads, arguments.runs, arguments.mitsuba, arguments.mitsuba_spp)
    fits = fit_seconds(arguments.fits, arguments.size)
    graph = slider_rows(None, max(arguments.runs, 5), np.zeros(1 << 25))[0]
    triangles = len(model.outline.triangles)
    print(table(rows))
    print(f"\n{triangles:,} triangles, {arguments.size} x {arguments.size} pixels, medians of {arguments.runs} calls\n")
    print(peer_table(peer))
    for what, reason in peer.skipped.items():
        print(f"skipped: {what}: {reason}")
    if fits:
        print(f"\nseconds per fit, one thread: {', '.join(f'{one:.1f}' for one in fits)}")
    print(
        f"\nsliders to skinning matrices in onnxruntime, one thread: {graph.onnx:.1f} us, cold {graph.onnx_cold:.0f} us"
    )
    if arguments.json:
        result = {
            "rows": rows,
            "peer": dataclasses.asdict(peer),
            "fit_s": fits,
            "sliders_us": {"warm": graph.onnx, "cold": graph.onnx_cold},
            "runs": arguments.runs,
            "size": arguments.size,
            "triangles": triangles,
            "versions": {"torch": torch.__version__, "numpy": np.__version__, "python": platform.python_version()},
        }
        arguments.json.write_text(json.dumps(result, indent=2, sort_keys=True), encoding="utf-8")


def fit_seconds(count: int, size: int) -> list[float]:
    """Wall seconds of fits to portraits with expressions, on one thread."""
    if count < 1:
        return []
    from recovery_fit import fitted
    from recovery_targets import targets

    torch.set_num_threads(1)
    return [fitted(target).seconds for target in targets(count, 0, size=size)]


def steps(parts: FaceParts, model: FaceModel, size: int) -> dict[str, Callable[[], None]]:
    """What is timed, by name."""
    points = model.rig().numpy()
    own = portrait(points, (0.3, 0.1), size, size)
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


def table(rows: list[dict[str, Any]]) -> str:
    """The figures for people."""
    cells = [("threads", "step", "wall ms", "best", "processor ms")]
    for row in rows:
        figures = (f"{1e3 * row[key]:.1f}" for key in ("wall_s", "best_wall_s", "processor_s"))
        cells.append((str(row["threads"]), row["step"], *figures))
    return "\n".join(aligned(cells))


if __name__ == "__main__":
    main()
