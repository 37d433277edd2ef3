"""Mitsuba's side of `photo_fit.py`, run by an interpreter that has mitsuba: SCENE.npz SETTINGS.json REPORT.json.

One mesh a material, with bitmaps of the same texels, a constant light plus a linear part as an environment map, and the
projective integrator of direct light (Zhang et al., "Projective Sampling for Differentiable Rendering of Geometry",
2023). Shadows' edges take no samples; ours has no shadows.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

ENVIRONMENT = (64, 128)  # pixels
Arrays = dict[str, Any]


def main() -> None:
    """Measure the settings' calls and write the report."""
    data, settings, out = dict(np.load(sys.argv[1])), json.loads(Path(sys.argv[2]).read_text()), Path(sys.argv[3])
    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(settings["threads"])
    scene = MitsubaScene(data, settings["spp"])
    forward = measured(lambda: scene.forward(), settings["runs"])
    both = measured(lambda: scene.gradient(data["weights"][0]), settings["runs"])
    report: dict[str, Any] = {"version": mi.__version__, "forward": forward, "both": both}
    if settings.get("check"):
        report |= check(scene, data, settings)
    out.write_text(json.dumps(report), encoding="utf-8")


def check(scene: MitsubaScene, data: Arrays, settings: dict[str, Any]) -> dict[str, Any]:
    """By direction, slopes of the losses as gradients have them and as central differences of fine images do."""
    slopes, differences, step = [], [], float(data["step"])
    for along, weights in zip(data["directions"], data["weights"], strict=True):
        slopes.append([float((scene.gradient(weights) * along).sum()) for _ in range(settings["repeats"])])
    for along, weights in zip(data["directions"], data["weights"], strict=True):
        ends = [scene.fine(data["points"] + sign * step * along, settings["fine_spp"]) for sign in (1, -1)]
        differences.append(float(((ends[0] - ends[1]) * weights).sum() / (2 * step)))
    return {"slopes": slopes, "differences": differences}


class MitsubaScene:
    """The scene in mitsuba, and its loss."""

    def __init__(self, data: Arrays, spp: int) -> None:
        self.spp, self.count = spp, len(data["points"])
        meshes, self.numbers = [], []
        for number in np.unique(data["materials"]):
            mesh, points = made_mesh(data, int(number))
            meshes.append(mesh)
            self.numbers.append(points)
        description = {
            "type": "scene",
            "integrator": {"type": "direct_projective", "sppi": 0, "hide_emitters": True},
            "sensor": made_sensor(data),
            "light": made_light(data),
            **{f"mesh{i}": mesh for i, mesh in enumerate(meshes)},
        }
        self.scene = mi.load_dict(description)
        self.parameters = mi.traverse(self.scene)
        self.keys = [f"mesh{i}.vertex_positions" for i in range(len(meshes))]
        self.seed = 0

    def place(self, points: Any) -> None:
        """Move the points (n, 3)."""
        for key, numbers in zip(self.keys, self.numbers, strict=True):
            self.parameters[key] = mi.Float(points[numbers].astype(np.float32).ravel())
        self.parameters.update()

    def render(self, spp: int) -> Any:
        """The image, evaluated."""
        self.seed += 1
        image = mi.render(self.scene, spp=spp, seed=self.seed)
        dr.eval(image)
        dr.sync_thread()
        return image

    def forward(self) -> None:
        """One image, the points placed first as in a fit."""
        self.touch(gradients=False)
        self.render(self.spp)

    def touch(self, *, gradients: bool) -> None:
        """Mark the points as changed, so that what depends on them is built anew."""
        for key in self.keys:
            value = dr.detach(self.parameters[key])
            self.parameters[key] = type(value)(value)
            if gradients:
                dr.enable_grad(self.parameters[key])
        self.parameters.update()

    def gradient(self, weights: Any) -> Any:
        """(n, 3) gradient of the sum of the image times weights (size, size, 3) with respect to the points."""
        self.touch(gradients=True)
        self.seed += 1
        image = mi.render(self.scene, self.parameters, spp=self.spp, seed=self.seed)
        dr.backward(dr.sum(image * mi.TensorXf(weights), axis=None))
        total = np.zeros((self.count, 3))
        for key, numbers in zip(self.keys, self.numbers, strict=True):
            own = np.asarray(dr.grad(self.parameters[key])).reshape(-1, 3)
            np.add.at(total, numbers, own)
        return total

    def fine(self, points: Any, spp: int) -> Any:
        """(size, size, 3) float64 image with the points elsewhere and many samples, always the same ones."""
        self.place(points)
        self.seed = 0
        return np.asarray(self.render(spp), dtype=np.float64)


def made_mesh(data: Arrays, number: int) -> tuple[Any, Any]:
    """The triangles of one material, points split where texture coordinates differ; the points (v,) of its vertices."""
    chosen = data["materials"] == number
    pairs = np.stack([data["triangles"][chosen].ravel(), data["uv_corners"][chosen].ravel()], axis=1)
    vertices, faces = np.unique(pairs, axis=0, return_inverse=True)
    texels = data.get(f"texels{number}")
    if texels is None:
        color = {"type": "rgb", "value": data["colors"][number].tolist()}
    else:
        bitmap = mi.Bitmap(np.ascontiguousarray(texels.astype(np.float32)))
        color = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "repeat"}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "nested": {"type": "diffuse", "reflectance": color}})
    name = f"mesh{number}"
    mesh = mi.Mesh(
        name, len(vertices), int(chosen.sum()), properties, has_vertex_normals=True, has_vertex_texcoords=True
    )
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(data["points"][vertices[:, 0]].astype(np.float32).ravel())
    parameters["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
    uv = data["uv"][vertices[:, 1]] * (1, -1) + (0, 1)  # v down
    parameters["vertex_texcoords"] = mi.Float(uv.astype(np.float32).ravel())
    parameters.update()
    return mesh, vertices[:, 0]


def made_sensor(data: Arrays) -> Any:
    """A pinhole camera with a square film and box filter."""
    size, eye, axes = int(data["size"]), data["eye"], data["axes"]
    world = mi.ScalarTransform4f().look_at(eye.tolist(), (eye - axes[2]).tolist(), axes[1].tolist())
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(np.degrees(2 * np.arctan(size / 2 / float(data["focal"])))),
        "near_clip": 1.0,
        "to_world": world,
        "film": {
            "type": "hdrfilm",
            "width": size,
            "height": size,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "independent"},
    }


def made_light(data: Arrays) -> Any:
    """Radiance from each direction: constant and linear."""
    height, width = ENVIRONMENT
    theta = (np.arange(height) + 0.5) / height * np.pi
    phi = (np.arange(width) + 0.5) / width * 2 * np.pi
    sine = np.sin(theta)[:, None]
    towards = np.stack(
        [sine * np.sin(phi), np.broadcast_to(np.cos(theta)[:, None], (height, width)), -sine * np.cos(phi)], axis=-1
    )
    light = data["radiance"] + towards @ data["slope"]
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(light.astype(np.float32)))}


def measured(call: Callable[[], object], runs: int) -> dict[str, float]:
    """Median wall and processor seconds after two calls that compile."""
    wall, processor = [], []
    for number in range(2 + runs):
        began = time.perf_counter(), time.process_time()
        call()
        if number >= 2:
            wall.append(time.perf_counter() - began[0])
            processor.append(time.process_time() - began[1])
    return {"wall_s": statistics.median(wall), "processor_s": statistics.median(processor), "best_wall_s": min(wall)}


if __name__ == "__main__":
    main()
