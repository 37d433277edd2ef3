"""Sides of render.py, a process each: times and memory on one face.

usage: render_sides.py --side sample SEED STAGE REPORT
       render_sides.py --side ict SOURCE STAGE REPORT
       render_sides.py --side command|picture|facepipe|embreex STAGE REPORT

The first two make stages. `command` is `facepipe render` from its start to its file, `picture` draws the face in three
views; the other two do the same work for its front view: what is seen in 9 samples a pixel, and which of 24 directions
of the sky each point sees.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from children import Json, is_side, peak_memory

SIZE, SAMPLES = 800, 3


def sample(seed: str, stage: str) -> Json:
    """A person of the head in the box."""
    import facepipe

    facepipe.sample(stage, seed=int(seed))
    return {}


def ict(source: str, stage: str) -> Json:
    """ICT-FaceKit."""
    from facepipe import importers
    from facepipe.stage import save_parts

    save_parts(importers.load("ict", source).parts, stage)
    return {}


def command(stage: str) -> Json:
    """The whole command."""
    words = [sys.executable, "-m", "facepipe", "render", stage, "-o", f"{stage}.png", "--force", "--size", str(SIZE)]
    before, wall = os.times(), time.perf_counter()
    subprocess.run(words, check=True, capture_output=True)
    wall, after = time.perf_counter() - wall, os.times()
    processor = after.children_user + after.children_system - before.children_user - before.children_system
    return {"command_s": wall, "command_cpu_s": processor}


def picture(stage: str) -> Json:
    """Three views, one after the other, each as if it were the only one."""
    from facepipe.pictures import PictureOptions
    from facepipe.pictures import picture as draw

    parts, points = _face(stage)
    options = [PictureOptions(size=SIZE, view=view) for view in _VIEWS]
    times = [_timed(partial(draw, parts, points, option)) for option in options]
    return _summary("picture", times) | {"peak_bytes": peak_memory()}


def facepipe(stage: str) -> Json:
    """Our rasteriser and depth maps."""
    from facepipe.geometry.rasterise import rasterise, screen_triangles

    scene, camera = _scene(stage)

    def seen() -> None:
        fine = camera.scaled(SAMPLES).project(scene.points)
        screen = screen_triangles(fine, scene.triangles)
        for top in range(0, SIZE * SAMPLES, 600):
            rasterise(screen, SIZE * SAMPLES, SIZE * SAMPLES, rows=(top, top + 600))

    def sky() -> None:
        scene.__dict__.pop("sky", None)
        _ = scene.sky

    return _both(seen, sky)


def embreex(stage: str) -> Json:
    """Intel Embree by its Python binding: rays, in blocks of rows; a ray from each point to each direction it faces."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene, camera = _scene(stage)

    def built() -> Any:
        found = EmbreeScene()
        TriangleMesh(found, scene.points[scene.triangles].astype(np.float32))
        return found

    def seen() -> None:
        rays, fine = built(), camera.scaled(SAMPLES)
        steps = (np.arange(SIZE * SAMPLES) + 0.5 - fine.center[0]) / fine.focal
        for rows in np.split(-steps, 12):
            x, y = np.meshgrid(steps, rows)
            towards = (np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3) @ fine.axes).astype(np.float32)
            rays.run(np.broadcast_to(fine.eye, towards.shape).astype(np.float32), towards, query="INTERSECT")

    def sky() -> None:
        from facepipe.pictures.occlusion import AMBIENT_DIRECTIONS, sphere_directions

        rays, lifted = built(), scene.points + 1e-3 * np.ptp(scene.points) * scene.normals
        for direction in sphere_directions(AMBIENT_DIRECTIONS):
            start = lifted[scene.normals @ direction > 0].astype(np.float32)
            rays.run(start, np.tile(direction.astype(np.float32), (len(start), 1)), query="OCCLUDED")

    return _both(seen, sky)


_VIEWS = ("front", "three-quarter", "side")


def _face(stage: str) -> tuple[Any, Any]:
    import facepipe

    face = facepipe.open(stage)
    return face.parts(), face.evaluate()


def _scene(stage: str) -> tuple[Any, Any]:
    from facepipe.pictures.camera import portrait
    from facepipe.pictures.scene import build_scene

    parts, points = _face(stage)
    scene = build_scene(parts, points)
    return scene, portrait(scene.points, "front", SIZE, SIZE)


def _both(seen: Callable[[], None], sky: Callable[[], None]) -> Json:
    times = {name: [_timed(call) for _ in range(3)] for name, call in (("seen", seen), ("sky", sky))}
    return _summary("seen", times["seen"]) | _summary("sky", times["sky"])


def _timed(call: Callable[[], object]) -> tuple[float, float]:
    """Wall and processor seconds."""
    processor, wall = time.process_time(), time.perf_counter()
    call()
    return time.perf_counter() - wall, time.process_time() - processor


def _summary(name: str, times: list[tuple[float, float]]) -> Json:
    wall, processor = np.median(times, axis=0).tolist()
    return {f"{name}_s": wall, f"{name}_cpu_s": processor}


if __name__ == "__main__":
    is_side({one.__name__: one for one in (sample, ict, command, picture, facepipe, embreex)})
