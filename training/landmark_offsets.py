"""Measures how far the landmark network is off the head in the box as a rule: ``python training/landmark_offsets.py``.

Random people in expressions, lights and views of the training; on each picture the network's places are those that a
search would give. The offsets in space are least squares over all pictures, mirrored ones too, drawn to 0 as by
`_RIDGE` of them. OUT is `facepipe/learn/networks/landmark_offsets.json`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import head_sources
import numpy as np
import numpy.typing as npt
import pictures
import scenes
import torch

from facepipe.core.atomic import write_bytes
from facepipe.geometry.colors import from_srgb
from facepipe.geometry.landmarks import MIRRORED
from facepipe.heads.asset import asset
from facepipe.learn.networks import landmark_model
from facepipe.learn.networks.face_search import judged_face
from facepipe.learn.networks.files import LandmarkSession
from facepipe.pictures.draw import draw
from facepipe.pictures.scene import build_scene
from facepipe.pictures.shade import Shader

FloatArray = npt.NDArray[np.floating]

_VIEWS = 2  # a person
_RIDGE = 1.0
_MIRROR = np.array([-1.0, 1.0, 1.0])


def measured(seed: int, people: int, network: LandmarkSession) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Of each picture in which the face is found, how (2, 3) it shows space, and (68, 2) how far landmarks are off.

    Both in pixels over the distance of the outer eye corners in space.
    """
    for number in range(people):
        rng = np.random.default_rng([seed, number])
        who = head_sources.Person(rng, by_sliders=False)
        subject = who.dressed(who.look, rng)
        for _ in range(_VIEWS):
            points = subject.pose(rng)
            scene = build_scene(subject.face, points, scenes.SIZE)
            head = scene.points[: asset().parts["Head"].points.stop]
            camera, marks = scenes.random_camera(head, scenes.near_placement(rng), rng)
            shader = Shader(scene, camera, lights=scenes.random_light(who.look, rng))
            behind = from_srgb(pictures.background(scenes.SIZE, rng)).astype(np.float32)
            image = pictures.photographed(draw(shader, scenes.SIZE, behind, 2, 10.0) / 255, rng)
            found = judged_face(network, torch.as_tensor(image / np.float32(255)), marks)
            if found is None:
                continue
            places = head[asset().landmarks]
            across = float(np.linalg.norm(places[36] - places[45]))
            scale = camera.focal / float(((camera.eye - places) @ camera.axes[2]).mean())
            yield camera.axes[:2] * [[1], [-1]], (found.landmarks - marks) / (scale * across)


def solved(rows: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """(68, 3) offsets, the same on both sides."""
    hessian, slope = _RIDGE * np.eye(3), np.zeros((68, 3))
    for view, off in rows:
        for axes, each in ((view, off), (view * _MIRROR, off[MIRRORED])):
            hessian = hessian + axes.T @ axes
            slope += each @ axes
    return np.asarray(np.linalg.solve(hessian, slope.T).T)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Measure how far the landmark network is off.")
    parser.add_argument("-o", "--out", type=Path, required=True, help="the JSON file")
    parser.add_argument("--people", type=int, default=100, help=f"with {_VIEWS} pictures each (default 100)")
    parser.add_argument("--seed", type=int, default=0, help="of the people (default 0)")
    options = parser.parse_args()
    rows = list(measured(options.seed, options.people, LandmarkSession(landmark_model())))
    places = asset().points[asset().landmarks].astype(np.float64)
    places = (places - places.mean(axis=0)) / np.linalg.norm(places[36] - places[45])
    content = {
        "command": f"python training/landmark_offsets.py -o OUT --people {options.people} --seed {options.seed}",
        "network": hashlib.sha256(landmark_model().read_bytes()).hexdigest(),
        "pictures": len(rows),
        "places": np.round(places, 4).tolist(),
        "offsets": (np.round(solved(rows), 4) + 0.0).tolist(),
    }
    lines = [f"{json.dumps(key)}: {json.dumps(value)}" for key, value in content.items()]
    write_bytes(options.out, ("{\n" + ",\n".join(lines) + "\n}\n").encode())


if __name__ == "__main__":
    main()
