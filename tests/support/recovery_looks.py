"""Cameras, lights, colours and backgrounds of random portraits."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from facepipe.parts import FaceParts, Material, Mesh, TextureInput
from facepipe.pictures.camera import Camera
from facepipe.pictures.lighting import Light, Studio

FloatArray = npt.NDArray[np.floating]
Color = tuple[float, float, float]

YAW, PITCH, ROLL = np.radians((25.0, 12.0, 8.0))
LENS_MM = (35.0, 105.0)  # equal to these on full frame: the same diagonal view angle
DIAGONAL_MM = float(np.hypot(36.0, 24.0))
HEAD_SHARE = (0.60, 0.85)  # of the picture's side, the longer side of the head without neck
SKINS = ((0.70, 0.45, 0.36), (0.55, 0.30, 0.19), (0.38, 0.19, 0.11), (0.19, 0.085, 0.05))  # linear
SKIN = np.array((0.60, 0.335, 0.225))  # of the sample's texture
HAIR = ((0.01, 0.009, 0.009), (0.06, 0.03, 0.015), (0.25, 0.16, 0.07), (0.30, 0.07, 0.02), (0.35, 0.34, 0.33))


@dataclass(frozen=True, kw_only=True)
class Pose:
    """How a camera stands before a face."""

    yaw: float  # radians; the camera turns to the subject's left
    pitch: float  # and up
    roll: float
    lens_mm: float
    share: float  # of the picture that the head fills
    place: tuple[float, float]  # of the head's middle in the room that is left, -1..1 right and down


def random_pose(rng: np.random.Generator) -> Pose:
    """A camera of a portrait."""
    yaw, pitch, roll = (float(rng.uniform(-limit, limit)) for limit in (YAW, PITCH, ROLL))
    lens, share = float(rng.uniform(*LENS_MM)), float(rng.uniform(*HEAD_SHARE))
    x, y = rng.uniform(-0.8, 0.8, 2)
    return Pose(yaw=yaw, pitch=pitch, roll=roll, lens_mm=lens, share=share, place=(float(x), float(y)))


def camera_of(pose: Pose, head: FloatArray, size: int) -> Camera:
    """The camera of a square picture that sees the points of a head (n, 3), Y up, as the pose says."""
    axes = pose_axes(pose)
    focal = size * np.sqrt(2.0) * pose.lens_mm / DIAGONAL_MM
    local = head @ axes.T
    at = np.append((local.min(axis=0) + local.max(axis=0))[:2] / 2, local[:, 2].max())  # eye in camera axes
    at[2] += focal * np.ptp(local, axis=0)[:2].max() / (pose.share * size)
    room = size * (1 - pose.share) / 2
    for _ in range(30):  # a contraction: distance and shift hardly depend on each other
        depth = (at[2] - local[:, 2])[:, None]
        seen = focal * (local[:, :2] - at[:2]) / depth
        middle, extent = (seen.max(axis=0) + seen.min(axis=0)) / 2, np.ptp(seen, axis=0).max()
        wanted = room * np.array([pose.place[0], -pose.place[1]])
        at[:2] += (middle - wanted) * np.median(depth) / focal
        at[2] += (extent / (pose.share * size) - 1) * np.median(depth)
    return Camera(axes=axes, eye=at @ axes, focal=float(focal), center=(size / 2, size / 2))


def pose_axes(pose: Pose) -> FloatArray:
    """(3, 3) rows right, up, backward."""
    yaw, pitch = pose.yaw, pose.pitch
    backward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    right = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    up = np.cross(backward, right)
    cosine, sine = np.cos(pose.roll), np.sin(pose.roll)
    return np.stack([cosine * right + sine * up, cosine * up - sine * right, backward])


def random_studio(rng: np.random.Generator) -> Studio:
    """A key light that casts shadows, up to two others, sky and ground."""
    key = _light(rng, azimuth=75, heights=(-5, 60), strengths=(0.7, 1.5), tint=0.15)
    others = [
        _light(rng, azimuth=170, heights=(-20, 50), strengths=(0.05, 0.6), tint=0.25) for _ in range(rng.integers(3))
    ]
    sky = rng.uniform(0.15, 0.45) * rng.uniform(0.85, 1.15, 3)
    ground = rng.uniform(0.05, 0.25) * rng.uniform(0.8, 1.2, 3)
    return Studio(lights=(key, *others), sky=_color(sky), ground=_color(ground), shadows=True)


def _light(
    rng: np.random.Generator,
    *,
    azimuth: float,
    heights: tuple[float, float],
    strengths: tuple[float, float],
    tint: float,
) -> Light:
    """A lamp up to `azimuth` degrees to a side of the camera, and at a height in degrees."""
    around, up = np.radians(rng.uniform(-azimuth, azimuth)), np.radians(rng.uniform(*heights))
    direction = np.array([np.sin(around) * np.cos(up), np.sin(up), np.cos(around) * np.cos(up)])
    color = rng.uniform(*strengths) * rng.uniform(1 - tint, 1 + tint, 3)
    wrap = rng.uniform(0.0, 0.4) * np.array([1.0, 0.6, 0.45])
    return Light(
        direction=_color(direction), color=_color(color), wrap=_color(wrap), highlight=float(rng.uniform(0.3, 1.2))
    )


def recolored(parts: FaceParts, rng: np.random.Generator) -> FaceParts:
    """The face with other skin, brows, hair and eyes."""
    between = rng.uniform(0, len(SKINS) - 1)
    low = min(int(between), len(SKINS) - 2)
    skin = np.array(SKINS[low]) * (low + 1 - between) + np.array(SKINS[low + 1]) * (between - low)
    factors = skin * rng.uniform(0.92, 1.08, 3) / SKIN
    hair = np.array(HAIR[rng.integers(len(HAIR))]) * rng.uniform(0.7, 1.3)
    brows = np.minimum(0.6 * hair + 0.4 * skin * 0.4, 1.0)
    eyes = rng.uniform(0.85, 1.1, 3)
    dyes = {"Hair": hair, "Lashes": hair, "Brows": brows}  # of meshes with colours of their points
    tints: dict[str, FloatArray] = {"Skin": factors, "Sclera": eyes, "Iris": eyes * rng.uniform(0.5, 2.0)}
    roughness = float(rng.uniform(0.4, 0.7))

    def dyed(material: Material) -> Material:
        source = material.diffuse_color
        if material.name in tints and isinstance(source, TextureInput):
            tinted = replace(source, scale=(*_color(tints[material.name]), 1.0))
            return replace(material, diffuse_color=tinted, roughness=roughness if material.name == "Skin" else 0.15)
        return material

    return replace(
        parts,
        materials=tuple(dyed(material) for material in parts.materials),
        meshes=tuple(_dyed(mesh, dyes[mesh.name]) if mesh.name in dyes else mesh for mesh in parts.meshes),
    )


def _dyed(mesh: Mesh, color: FloatArray) -> Mesh:
    """The mesh with another mean colour; its points keep their differences."""
    if mesh.colors is None:
        return replace(mesh, colors=np.tile(color, (len(mesh.points), 1)))
    return replace(mesh, colors=np.clip(mesh.colors * (color / mesh.colors.mean(axis=0)), 0.0, 1.0))


def random_backdrop(rng: np.random.Generator, size: int) -> FloatArray:
    """(size, size, 3) sRGB picture: plain, a gradient, soft blots, or blots with rectangles and bars."""
    kind = rng.integers(4)
    color = np.clip(rng.uniform(0.15, 0.85) + rng.normal(0.0, 0.12, 3), 0.0, 1.0)
    image = np.broadcast_to(color, (size, size, 3)).copy()
    if kind >= 1:
        across = np.linspace(-0.5, 0.5, size)
        turn = rng.uniform(0, 2 * np.pi)
        slope = np.cos(turn) * across[None, :] + np.sin(turn) * across[:, None]
        image += slope[..., None] * (rng.uniform(-0.5, 0.5) + rng.normal(0.0, 0.1, 3))
    if kind >= 2:
        image += _blots(rng, size)
    if kind >= 3:
        for _ in range(rng.integers(3, 9)):
            top, left = rng.integers(0, size, 2)
            height, width = rng.integers(size // 24, size // 2, 2)
            image[top : top + height, left : left + width] = rng.uniform(0.05, 0.95) + rng.normal(0.0, 0.1, 3)
    return np.clip(image, 0.0, 1.0)


def _blots(rng: np.random.Generator, size: int) -> FloatArray:
    """(size, size, 3) smooth noise of three scales."""
    from scipy.ndimage import zoom

    total = np.zeros((size, size, 3))
    for cells, strength in ((4, 0.25), (10, 0.15), (32, 0.06)):
        coarse = rng.normal(0.0, strength, (cells, cells, 1)) + rng.normal(0.0, strength / 3, (cells, cells, 3))
        total += zoom(coarse, (size / cells, size / cells, 1), order=1, grid_mode=True, mode="nearest")
    return total


def _color(values: FloatArray) -> Color:
    return (float(values[0]), float(values[1]), float(values[2]))
