"""The renderer of photo fits beside mitsuba's projective integrator: the same scene, times and slopes."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from call_times import measured
from children import ChildError, run_child
from photo_scene import PhotoScene, photo_scene
from tables import aligned

from facepipe.photo.renderer.camera import Camera

SCRIPT = Path(__file__).with_name("mitsuba_photo.py")
MITSUBA_RUNS = 5  # timed calls
REPEATS = 3  # gradients whose slopes are compared: they are noisy
FINE_SPP = 256  # samples per pixel of images that differences are taken of
Slopes = dict[str, dict[str, list[float]]]


@dataclass(frozen=True, kw_only=True)
class Peer:
    """Both sides' figures."""

    rows: list[dict[str, Any]]  # threads, side, forward and both with seconds
    slopes: Slopes  # side -> direction -> relative errors of gradients
    skipped: dict[str, str] = field(default_factory=dict)


def compare(size: int, threads: Sequence[int], runs: int, python: str | None, spps: Sequence[int]) -> Peer:
    """Measure facepipe and, where there is an interpreter with mitsuba, mitsuba with samples per pixel `spps`."""
    scene = photo_scene(size)
    rows = []
    for count in threads:
        torch.set_num_threads(count)
        rows.append({"threads": count, "side": "facepipe", **_own_times(scene, runs)})
    slopes: Slopes = {"facepipe": {}}
    for name, (slope, difference) in scene.slopes().items():
        slopes["facepipe"][name] = [slope / difference - 1]
    if python is None:
        return Peer(rows=rows, slopes=slopes, skipped={"mitsuba": "no interpreter given with --mitsuba"})
    try:
        for spp in spps:
            for count in threads:
                report = _mitsuba(scene, python, spp, count, check=count == threads[0])
                side = f"mitsuba {report['version']}, {spp} spp"
                rows.append({"threads": count, "side": side, "forward": report["forward"], "both": report["both"]})
                if count == threads[0]:
                    slopes[side] = _errors(scene, report)
    except ChildError as error:
        return Peer(rows=rows, slopes=slopes, skipped={"mitsuba": str(error)})
    return Peer(rows=rows, slopes=slopes)


def _own_times(scene: PhotoScene, runs: int) -> dict[str, Any]:
    """Images, and images with gradients to all points and to the camera's translation."""
    seen = scene.look.camera
    points = scene.points.clone().requires_grad_()
    translation = seen.translation.clone().requires_grad_()
    weights = next(iter(scene.weights.values()))

    def image() -> torch.Tensor:
        camera = Camera(rotation=seen.rotation, translation=translation, focal=seen.focal, center=seen.center)
        return scene.image(points, camera=camera)

    def forward() -> None:
        with torch.no_grad():
            image()

    return {
        "forward": measured(forward, runs),
        "both": measured(lambda: (image() * weights).sum().backward(), runs),
    }


def _mitsuba(scene: PhotoScene, python: str, spp: int, threads: int, *, check: bool) -> dict[str, Any]:
    settings = {
        "threads": threads,
        "spp": spp,
        "runs": MITSUBA_RUNS,
        "check": check,
        "repeats": REPEATS,
        "fine_spp": FINE_SPP,
    }
    with tempfile.TemporaryDirectory() as folder:
        arrays, wanted, report = (Path(folder) / name for name in ("scene.npz", "settings.json", "report.json"))
        scene.save(arrays)
        wanted.write_text(json.dumps(settings), encoding="utf-8")
        return run_child(python, SCRIPT, arrays, wanted, report)


def _errors(scene: PhotoScene, report: dict[str, Any]) -> dict[str, list[float]]:
    pairs = zip(scene.directions, report["slopes"], report["differences"], strict=True)
    return {name: [slope / difference - 1 for slope in slopes] for name, slopes, difference in pairs}


def peer_table(peer: Peer) -> str:
    """The figures for people."""
    cells = [("threads", "renderer", "forward ms", "ratio", "with backward ms", "ratio", "processor ms")]
    for row in sorted(peer.rows, key=lambda one: int(one["threads"])):
        own = next(one for one in peer.rows if one["side"] == "facepipe" and one["threads"] == row["threads"])
        forward, both = row["forward"]["wall_s"], row["both"]["wall_s"]
        figures = (f"{1e3 * forward:,.1f}", f"{forward / own['forward']['wall_s']:.1f}x")
        figures += (f"{1e3 * both:,.1f}", f"{both / own['both']['wall_s']:.1f}x")
        cells.append((str(row["threads"]), row["side"], *figures, f"{1e3 * row['both']['processor_s']:,.1f}"))
    names = list(peer.slopes["facepipe"])
    slopes = [("slopes off", "renderer", *names)]
    for side, errors in peer.slopes.items():
        slopes.append(("", side, *(_spread(errors[name]) for name in names)))
    return "\n".join([*aligned(cells), "", *aligned(slopes)])


def _spread(errors: Sequence[float]) -> str:
    """Percent, from the least to the largest where there are several."""
    least, largest = (f"{100 * end:+.0f}" for end in (min(errors), max(errors)))
    return f"{least} %" if least == largest else f"{least} to {largest} %"
