"""A face and photos of it on disk, and `facepipe fit-photo` on them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import exit_code
from PIL import Image

from facepipe.parts import FaceParts
from facepipe.pictures import PictureOptions, picture
from facepipe.pictures.camera import Camera
from facepipe.pictures.lighting import Light, Studio
from facepipe.rig import build, slide

SLIDERS = {"jawWidth": -0.7, "eyeSpacing": 0.6, "mouthWidth": 0.7}
EXPRESSION = {"jawOpen": 0.5}
YAWS = {"front": 0.0, "side": 0.25}  # radians
SIZE = 144
OFF = ("--content", "0", "--identity", "0", "--attributes", "0")  # image terms that need networks
FAST = ("--iterations", "8", "--size", "96", "--landmark-sigma", "0.005", *OFF)  # landmarks are nearly exact
SOON = ("--iterations", "0", "--size", "64", *OFF)


def photograph(parts: FaceParts, yaw: float) -> tuple[Image.Image, np.ndarray]:
    """A portrait of the person, and where its landmarks are, (68, 2) pixels."""
    rig = build(parts)
    coefficients, weights = slide(parts.sliders, rig.joints, SLIDERS)
    points = rig.evaluate({**weights, **EXPRESSION}, coefficients=coefficients)
    backward = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    right = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    head = points[: len(parts.meshes[0].points)]
    middle, height = (head.min(axis=0) + head.max(axis=0)) / 2, np.ptp(head[:, 1])
    focal = 1.9 * SIZE
    axes = np.stack([right, (0.0, 1.0, 0.0), backward])
    eye = middle + 1.35 * height * focal / SIZE * backward
    camera = Camera(axes=axes, eye=eye, focal=focal, center=(SIZE / 2, SIZE / 2))
    lamp = Light(direction=(0.3, 0.4, 0.87), color=(0.9, 0.9, 0.9))
    studio = Studio(lights=(lamp,), sky=(0.4, 0.4, 0.4), ground=(0.2, 0.2, 0.2))
    image = picture(parts, points, PictureOptions(size=SIZE, samples=2, camera=camera, studio=studio))
    index = np.asarray(parts.meshes[0].landmarks["multipie68"].indices)
    x, y, _, depth = camera.project(points[index]).T
    return image, np.stack([x / depth, y / depth], axis=1)


def write_photos(parts: FaceParts, folder: Path) -> None:
    """front.png and side.png, and their landmarks as front.json and side.json."""
    for name, yaw in YAWS.items():
        image, landmarks = photograph(parts, yaw)
        image.save(folder / f"{name}.png")
        (folder / f"{name}.json").write_text(json.dumps({"multipie68": landmarks.tolist()}))


def fit_photo(*words: str | Path) -> int:
    """The exit code of the command."""
    return exit_code("fit-photo", *words)


def fit_json(capsys: pytest.CaptureFixture[str], *words: str | Path) -> dict[str, Any]:
    """What the command prints with --json; it must succeed."""
    capsys.readouterr()
    code = fit_photo(*words, "--json")
    out, err = capsys.readouterr()
    assert code == 0, err
    found = json.loads(out)
    assert isinstance(found, dict)
    return found


def contents(folder: Path, but: Sequence[str] = ()) -> dict[str, bytes]:
    """Every file below a folder."""
    files = (one for one in sorted(folder.rglob("*")) if one.is_file())
    return {one.relative_to(folder).as_posix(): one.read_bytes() for one in files if one.name not in but}
