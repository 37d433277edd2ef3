"""Renders of one head as a network sees it: camera, light, labels and landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from head_sources import contour_rows
from labels import pixel_classes
from scipy.spatial.transform import Rotation

from facepipe.geometry.face_crops import TEMPLATE
from facepipe.heads.asset import asset
from facepipe.heads.people import Look
from facepipe.pictures.camera import Camera
from facepipe.pictures.draw import draw
from facepipe.pictures.lighting import Portrait, Softbox
from facepipe.pictures.scene import Scene
from facepipe.pictures.shade import Shader

FloatArray = npt.NDArray[np.floating]

SIZE = 160  # pixels a side of a crop
_SAMPLES = 2  # per pixel and direction
_MM = 10.0  # a centimetre


@dataclass(frozen=True)
class View:
    """One picture of a head."""

    image: FloatArray  # (S, S, 3) sRGB 0..1
    labels: npt.NDArray[np.uint8]  # (S, S)
    landmarks: FloatArray  # (68, 2) pixels
    present: float  # 1 a face; 0 none, misplaced by far; 0.5 between
    camera: Camera


@dataclass(frozen=True)
class Placement:
    """Where a crop lies beside the one that the landmarks ask for."""

    scale: float
    turn: float
    shift: FloatArray

    @property
    def present(self) -> float:
        """1 where a network shall find the face, 0 where it shall not, 0.5 between."""
        far, size = float(np.hypot(*self.shift)), abs(np.log2(self.scale))
        if far < 0.24 and size < 0.48 and abs(self.turn) < 0.45:
            return 1.0
        return 0.0 if far > 0.42 or size > 1.1 else 0.5


def near_placement(rng: np.random.Generator) -> Placement:
    """Beside the aligned crop, as a search finds it."""
    return Placement(
        float(2 ** rng.uniform(np.log2(0.75), np.log2(1.35))), rng.uniform(-0.35, 0.35), rng.uniform(-0.15, 0.15, 2)
    )


def far_placement(rng: np.random.Generator) -> Placement:
    """Off the face, or far too large or small."""
    way = rng.uniform(0, 2 * np.pi)
    if rng.random() < 0.6:
        shift = rng.uniform(0.45, 0.9) * np.array([np.cos(way), np.sin(way)])
        return Placement(rng.uniform(0.6, 1.6), rng.uniform(-0.4, 0.4), shift)
    scale = rng.uniform(0.2, 0.42) if rng.random() < 0.5 else rng.uniform(2.3, 4)
    return Placement(scale, rng.uniform(-0.4, 0.4), rng.uniform(-0.2, 0.2, 2) * max(scale, 1))


def random_light(look: Look, rng: np.random.Generator) -> Portrait:
    """A dome and one to three lamps, exposed for the skin as photos are, some too dark or too bright."""
    tint = rng.uniform(0.85, 1.15, 3)
    dome = rng.uniform(0.15, 0.9) * tint
    boxes = []
    for number in range(rng.integers(1, 4)):
        way = rng.normal(0, 1, 3) * (1, 0.8, 1) + (0, 0.4, 0.5)
        way[2] = abs(way[2]) if number == 0 else way[2]
        color = rng.uniform(0.2, 1.8) * rng.uniform(0.85, 1.15, 3)
        half = np.exp(rng.uniform(np.log(0.05), np.log(0.7), 2))
        boxes.append(Softbox(direction=tuple(way), color=tuple(color), size=tuple(half), glare=rng.uniform(0.3, 1)))
    arriving = dome.mean() + sum(np.mean(box.color) * max(float(box.axes[2, 2]), 0.1) for box in boxes)
    skin = float(look.skin.mean()) ** 0.6  # photos of dark skin are exposed longer, and yet darker
    return Portrait(
        boxes=tuple(boxes),
        sky=tuple(dome * rng.uniform(1.0, 1.4)),
        ground=tuple(dome * rng.uniform(0.3, 0.9)),
        exposure=float(np.exp(rng.uniform(np.log(0.16), np.log(0.9))) / (arriving * skin)),
    )


def random_camera(
    points: FloatArray, placement: Placement, size: int, rng: np.random.Generator
) -> tuple[Camera, FloatArray]:
    """A camera in front of a head (n, 3), and the landmarks (68, 2) in pixels of its picture, `size` a side."""
    yaw, pitch = np.radians(np.clip(rng.normal(0, 19), -45, 45)), np.radians(np.clip(rng.normal(0, 9), -24, 24))
    distance = float(np.exp(rng.uniform(np.log(32), np.log(220))))
    axes = Rotation.from_euler("XY", [pitch, yaw]).as_matrix()
    eye = points[asset().landmarks].mean(axis=0) + distance * axes[2]
    camera = Camera(axes=axes, eye=eye, focal=1.0, center=(0.0, 0.0))
    marks = landmarks_seen(camera, points) @ (1, 1j)
    target = ((TEMPLATE @ (1, 1j) - 0.5 - 0.5j) * placement.scale * np.exp(1j * placement.turn)) + 0.5 + 0.5j
    target = (target + placement.shift @ (1, 1j)) * size
    spread = marks - marks.mean()
    turn = np.vdot(spread, target - target.mean()) / np.vdot(spread, spread).real
    center = target.mean() - turn * marks.mean()
    cos, sin = turn.real / abs(turn), turn.imag / abs(turn)
    rolled = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) @ axes
    found = turn * marks + center
    return (
        Camera(axes=rolled, eye=eye, focal=abs(turn), center=(center.real, center.imag)),
        np.stack([found.real, found.imag], axis=-1),
    )


def landmarks_seen(camera: Camera, points: FloatArray) -> FloatArray:
    """(68, 2) landmarks of a head (n, 3) in the picture; the contour's are where its outline is."""
    screen = camera.project(points)
    flat = screen[:, :2] / np.maximum(screen[:, 3:], 1.0)
    marks = flat[asset().landmarks].copy()
    center = marks[27:36].mean(axis=0)
    for i, row in enumerate(contour_rows()):
        marks[i] = flat[row[np.argmax(flat[row] @ (marks[i] - center))]]
    return marks


def render(scene: Scene, look: Look, placement: Placement, behind: FloatArray, rng: np.random.Generator) -> View:
    """A random camera and light.

    :param behind: (S, S, 3) sRGB
    """
    head = scene.points[: asset().parts["Head"].points.stop]
    size = len(behind)
    camera, marks = random_camera(head, placement, size, rng)
    shader = Shader(scene, camera, lights=random_light(look, rng))
    image = draw(shader, size, behind.astype(np.float32), _SAMPLES, _MM) / 255
    return View(image, pixel_classes(shader, size), marks, placement.present, camera)
