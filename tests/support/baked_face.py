"""A face on a stage with a photo of another person of the same shape in known light: what `bake-photo` starts from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import small_head
from PIL import Image

from facepipe import heads
from facepipe.parts import Animation, Blendshape, FaceParts, KeyLamp, Mesh, PhotoView
from facepipe.pictures import PictureOptions, picture
from facepipe.pictures.camera import Camera
from facepipe.pictures.lighting import Light, Studio
from facepipe.rig import build
from facepipe.stage import save_parts

SIZE = 320
SKY, GROUND = np.array([0.5, 0.5, 0.55]), np.array([0.25, 0.25, 0.22])
LAMP, LAMP_COLOR = (0.5, 0.4, 0.75), (0.7, 0.68, 0.6)
BACKGROUND = (1.0, 0.0, 1.0)
SKIN = ("M_Face", "M_BackHead")
CARDS = ("Brows", "Lashes", "Hair")


@cache
def person(seed: int, textures: int = 256) -> FaceParts:
    """A head with one shape, without sliders, and without brows, lashes and hair, which a skin's texture lacks."""
    return _bald(heads.make(seed, textures=textures))


@cache
def small_person(seed: int, textures: int = 256) -> FaceParts:
    """The same in an eighth of the points, on which no cards lie."""
    return _bald(small_head.make(seed, textures=textures))


def _bald(parts: FaceParts) -> FaceParts:
    bald = (mesh for mesh in parts.meshes if mesh.name not in CARDS)
    meshes = tuple(replace(mesh, blendshapes=tuple(_open(mesh))) for mesh in bald)
    return replace(parts, meshes=meshes, sliders=(), animations=(), played=None)


def with_cards(parts: FaceParts, *names: str) -> FaceParts:
    """The average head with some of its brows, lashes and hair again."""
    cards = (mesh for mesh in _average().meshes if mesh.name in names)
    return replace(parts, meshes=(*parts.meshes, *(replace(mesh, blendshapes=()) for mesh in cards)))


@cache
def _average() -> FaceParts:
    return heads.make(0, textures=16)


def _open(mesh: Mesh) -> Iterator[Blendshape]:
    return (shape for shape in mesh.blendshapes if shape.name == "jawOpen")


def wearing(parts: FaceParts, other: FaceParts) -> FaceParts:
    """The face with the skin of another."""
    skins = {material.name: material for material in other.materials if material.name in SKIN}
    return replace(parts, materials=tuple(skins.get(material.name, material) for material in parts.materials))


def camera_at(points: np.ndarray, yaw: float, size: int) -> Camera:
    """A camera before a head, `yaw` radians to its left."""
    backward = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    axes = np.stack([[np.cos(yaw), 0.0, -np.sin(yaw)], [0.0, 1.0, 0.0], backward])
    middle, height = (points.min(axis=0) + points.max(axis=0)) / 2, np.ptp(points[:, 1])
    focal = 1.9 * size
    eye = middle + 1.15 * height * focal / size * backward
    return Camera(axes=axes, eye=eye, focal=focal, center=(size / 2, size / 2))


def light() -> np.ndarray:
    """(9, 3) of sky and ground, in camera coordinates of a level camera."""
    harmonics = np.zeros((9, 3))
    harmonics[0], harmonics[1] = (SKY + GROUND) / 2 / 0.282095, (SKY - GROUND) / 2 / 0.488603
    return harmonics


def view_of(camera: Camera, name: str, size: int) -> PhotoView:
    """What a stage says of a photo by this camera."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = camera.axes.T, camera.eye
    return PhotoView(
        name=name,
        image=f"{name}.png",
        width=size,
        height=size,
        transform=transform,
        focal=camera.focal,
        center=camera.center,
        clipping=(1.0, 1e4),
        light=light(),
        key=KeyLamp(direction=LAMP, color=LAMP_COLOR),
        animation=name,
    )


def put_fitted(parts: FaceParts, shown: FaceParts, folder: Path, size: int = SIZE, **yaws: float) -> None:
    """fitted.usda: a face with photos, NAME.png, of itself as it is shown."""
    points = build(parts).evaluate()
    studio = Studio(
        lights=(Light(direction=LAMP, color=LAMP_COLOR),), sky=tuple(SKY), ground=tuple(GROUND), compress=False
    )
    views = []
    for name, yaw in yaws.items():
        camera = camera_at(points[: len(parts.meshes[0].points)], yaw, size)
        options = PictureOptions(size=size, samples=2, camera=camera, studio=studio, background=BACKGROUND)
        image: Image.Image = picture(shown, build(shown).evaluate(), options)
        image.save(folder / f"{name}.png")
        views.append(view_of(camera, name, size))
    poses = tuple(Animation(name=name, shapes=("jawOpen",), shape_weights=np.zeros((1, 1))) for name in yaws)
    save_parts(replace(parts, animations=poses, played=None, sliders=(), photos=tuple(views)), folder / "fitted.usda")
