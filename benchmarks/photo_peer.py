"""The renderer of photo fits beside mitsuba's projective integrator: the same scene, times and slopes."""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from children import ChildError, run_child
from tables import aligned

from facepipe.heads import make
from facepipe.parts import FaceParts
from facepipe.photo.renderer.camera import Camera
from facepipe.photo.renderer.face_model import FaceModel, Look, Surfaces, opaque_surfaces
from facepipe.photo.renderer.light import ambient, distant
from facepipe.pictures.camera import Camera as RenderCamera
from facepipe.pictures.camera import portrait
from facepipe.rig import build, slide

SCRIPT = Path(__file__).with_name("mitsuba_photo.py")
MITSUBA_RUNS = 5  # timed calls
REPEATS = 3  # gradients whose slopes are compared: they are noisy
FINE_SPP = 256  # samples per pixel of images that differences are taken of
Slopes = dict[str, dict[str, list[float]]]
FloatArray = npt.NDArray[np.floating]
YAW, PITCH = 0.3, 0.1
AMBIENT = (0.55, 0.5, 0.45)  # radiance from all sides
SLOPE = np.array([[0.12, 0.10, 0.08], [0.14, 0.14, 0.14], [0.20, 0.18, 0.16]])  # what it grows by to right, up, viewer
AWAY = 0.15  # cm, or units of a slider: how far off the targets of the losses are
STEP = 0.03  # of central differences
SUPERSAMPLES = 4  # in each direction, of fine images
SLIDERS = ("noseDepth", "jawWidth", "chinLength", "cheekFullness")  # whose directions are checked
WARM_UP = 3


def measured(call: Callable[[], object], runs: int) -> dict[str, float]:
    """Median wall and processor seconds of a call, after `WARM_UP` that are not counted."""
    wall, processor = [], []
    for number in range(WARM_UP + runs):
        began = time.perf_counter(), time.process_time()
        call()
        if number >= WARM_UP:
            wall.append(time.perf_counter() - began[0])
            processor.append(time.process_time() - began[1])
    return {"wall_s": statistics.median(wall), "processor_s": statistics.median(processor), "best_wall_s": min(wall)}


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


@dataclass(frozen=True, kw_only=True)
class PhotoScene:
    """What both renderers draw, the sample's head, textured, in soft light, on black, and the losses to check.

    For each direction in which the points can move, the loss is that of a fit whose target lies `AWAY` in it: the slope
    of the summed squared difference, with the difference held, is that of the sum of the image times `weights`.
    """

    parts: FaceParts
    model: FaceModel
    own: RenderCamera
    look: Look
    size: int
    points: torch.Tensor  # (n, 3)
    directions: dict[str, torch.Tensor]  # (n, 3) movements of the points by a unit of camera translation or of a slider

    def image(self, points: torch.Tensor, factor: int = 1, camera: Camera | None = None) -> torch.Tensor:
        """(size, size, 3); with a factor, the mean of that many times as many pixels in each direction."""
        camera = camera or self.look.camera
        fine = Camera(
            rotation=camera.rotation,
            translation=camera.translation,
            focal=camera.focal * factor,
            center=camera.center * factor,
        )
        look = Look(camera=fine, light=self.look.light, background=self.look.background)
        image = self.model.image(points, look, height=self.size * factor, width=self.size * factor)[..., :3]
        return image.reshape(self.size, factor, self.size, factor, 3).mean(dim=(1, 3)) if factor > 1 else image

    @cached_property
    def weights(self) -> dict[str, torch.Tensor]:
        """By direction, (size, size, 3) how the image differs from the one `AWAY`."""
        here = self.fine(self.points)
        return {name: here - self.fine(self.points + AWAY * along) for name, along in self.directions.items()}

    def fine(self, points: torch.Tensor) -> torch.Tensor:
        """A supersampled image without gradients."""
        with torch.no_grad():
            return self.image(points, SUPERSAMPLES)

    def slopes(self) -> dict[str, tuple[float, float]]:
        """By direction, the slope of its loss as the gradient has it, and as central differences of fine images do."""
        result = {}
        for name, along in self.directions.items():
            points = self.points.clone().requires_grad_()
            (self.image(points) * self.weights[name]).sum().backward()
            assert points.grad is not None
            ends = [self.fine(self.points + sign * STEP * along).double() for sign in (1, -1)]
            difference = ((ends[0] - ends[1]) * self.weights[name]).sum() / (2 * STEP)
            result[name] = float((points.grad.double() * along).sum()), float(difference)
        return result

    def save(self, path: Path) -> None:
        """The scene as arrays, for a renderer in another environment."""
        texels = {name: texture.numpy() for name, texture in self.model.colors.textures.items()}
        surfaces = opaque_surfaces(self.parts)
        np.savez(
            path,
            axes=self.own.axes,
            eye=self.own.eye,
            focal=self.own.focal,
            size=self.size,
            points=self.points.numpy(),
            triangles=surfaces.triangles,
            materials=surfaces.materials,
            colors=surfaces.colors,
            uv=surfaces.uv,
            uv_corners=surfaces.uv_corners,
            radiance=np.array(AMBIENT),
            slope=1.5 * self.own.axes.T @ SLOPE,  # a matt surface receives 2/3 of what light grows by
            weights=np.stack([value.numpy() for value in self.weights.values()]),
            directions=np.stack([value.numpy() for value in self.directions.values()]),
            step=STEP,
            **{f"texels{i}": texels[name] for i, name in enumerate(surfaces.names) if _textured(surfaces, i)},
        )


def photo_scene(size: int, *, dtype: torch.dtype = torch.float32) -> PhotoScene:
    """The sample at rest, seen at an angle."""
    parts = make(0, controls="bones")
    model = FaceModel(parts, dtype=dtype)
    points = model.rig().detach()
    own = portrait(points.double().numpy(), (YAW, PITCH), size, size)
    light = ambient(torch.tensor(AMBIENT, dtype=dtype))
    for towards, color in zip(torch.eye(3, dtype=dtype), torch.as_tensor(SLOPE, dtype=dtype), strict=True):
        one = distant(towards, color)
        one[0], one[4:] = 0, 0  # the linear part alone
        light = light + one * 1.5
    look = Look(
        camera=Camera.at(own.axes, own.eye, own.focal, own.center, dtype=dtype),
        light=light,
        background=torch.zeros(3, dtype=dtype),
    )
    directions = {
        f"camera {name}": torch.as_tensor(-axis, dtype=dtype) for name, axis in zip("xyz", own.axes, strict=True)
    }
    moved = {name: value.expand(len(points), 3).clone() for name, value in directions.items()}
    moved |= {name: torch.as_tensor(_slid(parts, name), dtype=dtype) for name in SLIDERS}
    return PhotoScene(
        parts=parts,
        model=model,
        own=own,
        look=look,
        size=size,
        points=points,
        directions=moved,
    )


def _slid(parts: FaceParts, name: str) -> FloatArray:
    """(n, 3) how the points move per unit of a slider, at rest."""
    rig = build(parts)
    ends = [rig.evaluate(coefficients=slide(parts.sliders, rig.joints, {name: value})[0]) for value in (-0.05, 0.05)]
    return np.asarray((ends[1] - ends[0]) / 0.1)


def _textured(surfaces: Surfaces, number: int) -> bool:
    return surfaces.textures[number] is not None and bool((surfaces.materials == number).any())
