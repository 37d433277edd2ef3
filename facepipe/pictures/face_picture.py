"""One picture of a face."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.atomic import replacing
from facepipe.core.errors import InputError
from facepipe.parts import FaceParts
from facepipe.pictures import overlay
from facepipe.pictures.camera import Camera, View, portrait
from facepipe.pictures.draw import draw
from facepipe.pictures.lighting import Portrait, Studio
from facepipe.pictures.overlay import HeatMap, RegionColors, draw_landmarks, draw_legend, legend_width
from facepipe.pictures.scene import Scene, build_scene, world_points
from facepipe.pictures.shade import Shader

if TYPE_CHECKING:
    from PIL.Image import Image

Color = tuple[float, float, float]

SMALLEST_WITH_TEXT = 128  # pixels a side; below, bar and numbers are left out
LIGHT_GREY = ((0.93, 0.935, 0.94), (0.70, 0.72, 0.745))  # sRGB, middle and corners


@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """How a picture is taken.

    :raises InputError: both a heat map and regions
    """

    size: int = 800  # pixels a side, 16 to 4096
    view: View = "front"  # or yaw and pitch of the camera, radians; yaw turns to the subject's left
    background: Color | tuple[Color, Color] = LIGHT_GREY  # sRGB 0..1: one colour, or middle and corners
    samples: int = 3  # per pixel and direction, 1 to 8
    heatmap: HeatMap | None = None
    bar: bool = True  # what the colours of a heat map mean, at the right side
    regions: RegionColors | None = None  # instead of a heat map
    landmarks: str | None = None  # scheme whose points get dots with their number in the scheme, from 0
    framing: FloatArray | None = None  # (n, 3) points that set the camera, as for `picture`; None: those drawn
    camera: Camera | None = None  # of a picture `size` pixels a side, in the Y-up world; instead of view and framing
    studio: Studio | Portrait | None = None  # lights; None: portrait light, or even light where colours must be read
    backdrop: FloatArray | None = None  # (size, size, 3) sRGB 0..1 picture behind the face, instead of `background`
    weights: Mapping[str, float] = field(default_factory=dict)  # of the shapes in the points: what wrinkles skin

    def __post_init__(self) -> None:
        if self.heatmap is not None and self.regions is not None:
            raise InputError("regions", "given with a heat map, expected only one of them")

    @property
    def written(self) -> bool:
        """Whether the picture is large enough for text."""
        return self.size >= SMALLEST_WITH_TEXT


def picture(parts: FaceParts, points: FloatArray | None, options: PictureOptions) -> Image:
    """A shaded picture of a face.

    :param points: (n, 3) posed world-space points of all meshes in mesh order, stage units; None: the neutral
    :raises InputError: points that don't fit or aren't finite, an unknown landmark scheme, a broken texture
    """
    return pictures(parts, points, [options])[0]


def pictures(parts: FaceParts, points: FloatArray | None, several: Sequence[PictureOptions]) -> list[Image]:
    """Several shaded pictures of a face, quicker than one `picture` after the other."""
    scene = build_scene(parts, points, max(options.size for options in several))
    return [_picture(parts, scene, options) for options in several]


def poses(parts: FaceParts, several: Sequence[FloatArray | None], options: PictureOptions) -> list[Image]:
    """Pictures of a face at several points, quicker than one `picture` after the other."""
    images: list[Image] = []
    first: Scene | None = None
    for points in several:
        scene = build_scene(parts, points, options.size, first)
        images.append(_picture(parts, scene, options))
        first = first or scene
    return images


def _picture(parts: FaceParts, scene: Scene, options: PictureOptions) -> Image:
    from PIL import Image

    paint = None if options.regions is None else options.regions.colors
    camera = options.camera
    if camera is None:
        used, right = np.zeros(len(scene.points), bool), 0  # pixels that a legend or a colour bar takes
        used[scene.triangles] = True
        if options.regions is not None and options.written:
            right = legend_width(options.regions, options.size)
        elif options.heatmap is not None and options.bar and options.written:
            right = overlay.bar_width(options.size)
        points = scene.points if options.framing is None else world_points(parts, options.framing, "framing")
        camera = portrait(points[used], options.view, options.size, options.size, right)
    shader = Shader(scene, camera, options.heatmap, paint, options.studio, options.weights)
    if options.backdrop is not None:
        behind = np.asarray(options.backdrop, dtype=np.float32)
    else:
        middle, corner = np.broadcast_to(np.array(options.background, dtype=np.float32), (2, 3))
        across = (np.arange(options.size, dtype=np.float32) + 0.5) / options.size * 2 - 1
        distance = np.sqrt((across[None, :] ** 2 + across[:, None] ** 2) / 2)
        outward = distance**2 * (3 - 2 * distance)
        behind = np.stack([low + (high - low) * outward for low, high in zip(middle, corner, strict=True)], axis=-1)
    image = Image.fromarray(draw(shader, options.size, behind, options.samples, 1000 * parts.meters_per_unit))
    if options.landmarks is not None:
        draw_landmarks(image, parts, scene, camera, options.landmarks, numbered=options.written)
    if options.heatmap is not None and options.bar and options.written:
        overlay.color_bar(image, options.heatmap)
    if options.regions is not None and options.written:
        draw_legend(image, options.regions)
    return image


def save_png(image: Image, path: str | os.PathLike[str]) -> None:
    """Write a picture as PNG: whole or not at all, the same bytes for the same pixels.

    :raises InputError: the folder does not exist or can't be written
    """
    with replacing(path) as temporary:
        image.save(temporary, format="PNG", compress_level=3)  # a twelfth larger than with 6, in half the time
