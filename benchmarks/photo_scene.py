"""The scene that both renderers of `photo_fit.py` draw: the sample's head, textured, in soft light, on black."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from facepipe.heads import make
from facepipe.parts import FaceParts
from facepipe.photo.renderer.camera import Camera
from facepipe.photo.renderer.face_model import FaceModel, Look, Surfaces, opaque_surfaces
from facepipe.photo.renderer.light import ambient, distant
from facepipe.pictures.camera import Camera as RenderCamera
from facepipe.pictures.camera import portrait
from facepipe.rig import build, slide

FloatArray = npt.NDArray[np.floating]

YAW, PITCH = 0.3, 0.1
AMBIENT = (0.55, 0.5, 0.45)  # radiance from all sides
SLOPE = np.array([[0.12, 0.10, 0.08], [0.14, 0.14, 0.14], [0.20, 0.18, 0.16]])  # what it grows by to right, up, viewer
AWAY = 0.15  # cm, or units of a slider: how far off the targets of the losses are
STEP = 0.03  # of central differences
SUPERSAMPLES = 4  # in each direction, of fine images
SLIDERS = ("noseDepth", "jawWidth", "chinLength", "cheekFullness")  # whose directions are checked


@dataclass(frozen=True, kw_only=True)
class PhotoScene:
    """What is drawn, and the losses whose slopes are checked.

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
