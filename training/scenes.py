"""Renders of one head as a network sees it: pose, camera, hair, shoulders, light, labels and landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import dressing
import head_sources as heads
import numpy as np
import numpy.typing as npt
import painting
import torch
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from styles import Style, hair_height

from facepipe.geometry.eye_distance import eye_distance
from facepipe.learn.features.crops import TEMPLATE
from facepipe.learn.light import ambient, distant, shade
from facepipe.learn.rasterise import barycentrics, interpolate, rasterise

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

SIZE = 160  # pixels a side of a crop
_DRAWN = 192  # pixels a side of what is rendered, for smooth edges


@dataclass(frozen=True)
class View:
    """One picture of a head, without a background."""

    color: FloatArray  # (d, d, 3) linear
    coverage: FloatArray  # (d, d)
    labels: IntArray  # (d, d)
    landmarks: FloatArray  # (68, 2) pixels of a picture of `SIZE`
    present: float  # 1 a face; 0 none, misplaced by far; 0.5 between
    camera: FloatArray  # yaw, pitch, roll, focal length over distance, crop's scale, turn, x and y shift
    light: FloatArray  # (9, 3)


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


def random_light(rng: np.random.Generator) -> torch.Tensor:
    """(9, 3) soft light, with a strong side at times."""
    tint = rng.uniform(0.85, 1.15, 3)
    light = ambient(torch.as_tensor(rng.uniform(0.25, 1.1) * tint, dtype=torch.float32))
    for number in range(rng.integers(1, 4)):
        way = rng.normal(0, 1, 3) * (1, 0.8, 1) + (0, 0.4, 0.5)
        way[2] = abs(way[2]) if number == 0 else way[2]
        color = rng.uniform(0.2, 1.8) * rng.uniform(0.85, 1.15, 3)
        numbers = (way / np.linalg.norm(way), color)
        light = light + distant(*(torch.as_tensor(one, dtype=torch.float32) for one in numbers))
    return light


def render(
    subject: heads.Subject,
    style: Style,
    painter: painting.Painter,
    placement: Placement,
    rng: np.random.Generator,
) -> View:
    """A random expression, pose, camera and light."""
    topology = subject.topology
    points = subject.pose(rng)
    normals = topology.normals(points)
    yaw, pitch = np.radians(np.clip(rng.normal(0, 19), -45, 45)), np.radians(np.clip(rng.normal(0, 9), -24, 24))
    roll = np.radians(rng.uniform(-20, 20))
    turned = torch.as_tensor(Rotation.from_euler("ZXY", [roll, pitch, yaw]).as_matrix(), dtype=torch.float32)
    extra = dressing.dressed(topology, points, normals, style)
    everything = torch.cat([points, extra.points]) @ turned.T
    all_normals = torch.cat([normals, extra.normals]) @ turned.T
    center = everything[: len(points)][topology.landmarks].mean(dim=0)
    distance = float(np.exp(rng.uniform(np.log(32), np.log(220))))
    local = everything - center
    depth = (distance - local[:, 2]).clamp(min=1.0)
    flat = (local[:, :2] / depth[:, None] * distance).double().numpy() * (1, -1)
    landmarks = _landmarks(topology, flat[: len(points)])
    flat, marks = _placed(flat, landmarks, placement)
    screen = torch.as_tensor(np.column_stack([flat * _DRAWN, depth.numpy()]), dtype=torch.float32)
    triangles, kinds = _shown(topology, marks, screen)
    triangles, kinds = torch.cat([triangles, extra.triangles]), np.concatenate([kinds, extra.kinds])
    canonical = np.concatenate([topology.canonical, extra.canonical]).astype(np.float32)
    light = random_light(rng)
    color, coverage, labels = _draw(screen, triangles, kinds, canonical, all_normals, style, painter, light)
    numbers = [yaw, pitch, roll, distance, placement.scale, placement.turn, *placement.shift]
    return View(color, coverage, labels, marks * SIZE, placement.present, np.array(numbers), light.numpy())


def _mouth_open(marks: FloatArray) -> bool:
    gap = np.linalg.norm(marks[61:64] - marks[[67, 66, 65]], axis=1).max()
    return bool(gap > 0.02 * eye_distance(marks) + 0.004)


def _shown(topology: heads.Topology, marks: FloatArray, screen: torch.Tensor) -> tuple[torch.Tensor, IntArray]:
    """Triangles and their kinds without what can't be seen: a closed mouth's inside, and the backs of skin."""
    hidden = () if _mouth_open(marks) else (heads.TEETH, heads.MOUTH)
    (x0, x1, x2), (y0, y1, y2) = (screen[:, axis][topology.triangles.T] for axis in (0, 1))
    front = ((x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0) < 0).numpy()  # y points down
    kept = ~np.isin(topology.kinds, hidden) & (front | (topology.kinds != heads.SKIN))
    return topology.triangles[torch.as_tensor(kept)], topology.kinds[kept]


def _landmarks(topology: heads.Topology, flat: FloatArray) -> FloatArray:
    """(68, 2) landmarks of a head on the screen; the contour's are where its outline is."""
    marks = flat[topology.landmarks].copy()
    center = marks[27:36].mean(axis=0)
    for i, row in enumerate(topology.rows):
        outward = marks[i] - center
        marks[i] = flat[row[np.argmax(flat[row] @ outward)]]
    return marks


def _placed(flat: FloatArray, marks: FloatArray, placement: Placement) -> tuple[FloatArray, FloatArray]:
    """Points and landmarks in the unit square of a crop beside the aligned one."""
    source, target = marks @ (1, 1j), TEMPLATE @ (1, 1j)
    spread = source - source.mean()
    turn = np.vdot(spread, target - target.mean()) / np.vdot(spread, spread).real
    turn_by = placement.scale * np.exp(1j * placement.turn)
    moved = [
        ((one @ (1, 1j) - source.mean()) * turn + target.mean() - 0.5 - 0.5j) * turn_by + 0.5 + 0.5j
        for one in (flat, marks)
    ]
    return tuple(np.stack([one.real, one.imag], axis=-1) + placement.shift for one in moved)


def _draw(
    screen: torch.Tensor,
    triangles: torch.Tensor,
    kinds: IntArray,
    canonical: FloatArray,
    normals: torch.Tensor,
    style: Style,
    painter: painting.Painter,
    light: torch.Tensor,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Colour, coverage and labels: the head and its clothes first, then the strands of hair in front of it."""
    hair = torch.as_tensor(kinds == dressing.HAIR)
    size = _DRAWN
    shown, number = triangles[~hair], kinds[~hair.numpy()]
    raster = rasterise(screen, shown, size, size)
    weights = barycentrics(screen, shown, raster)
    places = interpolate(torch.as_tensor(canonical, dtype=torch.float32), shown, raster, weights).numpy()
    color, labels, shine = painter(style, places, number[raster.triangles.numpy()])
    normal = torch.nn.functional.normalize(interpolate(normals, shown, raster, weights), dim=1)
    lit = color * shade(normal, light).numpy() + _gloss(normal, light, shine)
    image, mask = np.zeros((size * size, 3), np.float32), np.zeros(size * size, np.float32)
    classes = np.zeros(size * size, np.int64)
    pixels = raster.pixels.numpy()
    image[pixels], mask[pixels], classes[pixels] = lit, 1.0, labels
    nearness = raster.nearness.numpy()
    dark = _crevices(nearness, size)
    image *= dark[:, None]
    if hair.any():
        _strands(screen, triangles[hair], canonical, normals, style, light, nearness, image, mask, classes)
    return image.reshape(size, size, 3), mask.reshape(size, size), classes.reshape(size, size)


def _strands(
    screen: torch.Tensor,
    triangles: torch.Tensor,
    canonical: FloatArray,
    normals: torch.Tensor,
    style: Style,
    light: torch.Tensor,
    nearness: FloatArray,
    image: FloatArray,
    mask: FloatArray,
    classes: IntArray,
) -> None:
    raster = rasterise(screen, triangles, _DRAWN, _DRAWN)
    weights = barycentrics(screen, triangles, raster)
    places = interpolate(torch.as_tensor(canonical, dtype=torch.float32), triangles, raster, weights).numpy()
    pixels = raster.pixels.numpy()
    inside = (hair_height(style, places) > 0) & (raster.nearness.numpy()[pixels] > nearness[pixels])
    pixels, places = pixels[inside], places[inside]
    normal = torch.nn.functional.normalize(interpolate(normals, triangles, raster, weights), dim=1)[inside]
    angle, y = np.arctan2(places[:, 0], places[:, 2] - 1.0), places[:, 1]
    if style.cap:
        color = style.cloth * (0.7 + 0.6 * style.noises[2](angle * 8, y))[:, None]
    else:
        swirl = style.noises[2](angle * 3, y * 0.3) * 6
        strand = style.noises[1](angle * 55 + swirl, y * 0.35) * 0.7 + 0.6 * style.noises[0](
            angle * 18 + swirl, y * 0.2
        )
        color = style.hair * (0.25 + 1.25 * strand)[:, None]
    shine = np.full(len(pixels), 0.0 if style.cap else 0.35)
    image[pixels] = color * shade(normal, light).numpy() + _gloss(normal, light, shine) * style.hair
    mask[pixels], classes[pixels] = 1.0, painting.BACKGROUND if style.cap else painting.HAIR


def _gloss(normal: torch.Tensor, light: torch.Tensor, shine: FloatArray) -> FloatArray:
    """Highlights: light from where the viewer would be mirrored, sharpened."""
    mirrored = torch.stack(
        [2 * normal[:, 2] * normal[:, 0], 2 * normal[:, 2] * normal[:, 1], 2 * normal[:, 2] ** 2 - 1], 1
    )
    from_there = shade(mirrored, light).numpy()
    mean = np.sqrt(1e-6 + (light[0] ** 2).mean().item()) * 0.2821
    return np.asarray(0.25 * shine[:, None] * np.clip(from_there / mean - 1.3, 0, 3) ** 2 * mean)


def _crevices(nearness: FloatArray, size: int) -> FloatArray:
    """(p,) how much light reaches a pixel that lies deeper than its surroundings.

    Source: Luft, Colditz, Deussen, "Image Enhancement by Unsharp Masking the Depth Buffer", SIGGRAPH 2006.
    """
    covered = (nearness > 0).reshape(size, size).astype(np.float32)
    depth = np.where(covered > 0, 1 / np.maximum(nearness, 1e-6).reshape(size, size), 0)
    result = np.ones((size, size), np.float32)
    for share, strength in ((0.012, 1.2), (0.04, 0.45)):
        weight = gaussian_filter(covered, share * size) + 1e-6
        behind = depth - gaussian_filter(depth * covered, share * size) / weight
        result *= np.exp(-strength * np.clip(behind, 0, 1.6) * covered)
    return result.ravel()
