"""What may move when a face is fitted to photos: sliders, expressions and poses; and what a fit found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import suggestion
from facepipe.parts import FaceParts, Slider
from facepipe.photo.renderer.camera import Camera, rotation_matrices
from facepipe.rig import Rig, build
from facepipe.rig.conventions import ARKIT_SHAPES
from facepipe.rig.sliders import check_network, independent, shape_changes

NUMBERS = 7  # rotation vector (3), middle of the head in pixels (2), log pixels per unit there, log distance
FOCAL = 2.6  # of the photo's larger side, about 94 mm on a 36 mm frame: portraits have long lenses, and are cropped
Stopped = Literal["iterations", "loss-threshold", "not-finite"]
_SEEN = 0.01  # change of a shape's weight from which a learned network's slider drives it: less is noise of training


@dataclass(frozen=True, kw_only=True)
class PoseSpace:
    """How seven numbers stand for the camera of one photo.

    A head's middle in pixels, its size there and its turn are what a photo shows; how near it was taken is nearly
    hidden, and is the last number alone.
    """

    middle: FloatArray  # (3,) of the head in the world, stage units
    size: float  # head height, stage units
    center: tuple[float, float]  # principal point, pixels
    side: float  # larger side of the photo, pixels

    def camera(self, pose: Tensor) -> Camera:
        """The cameras of (..., 7) poses."""
        rotation = pose[..., :3]
        distance = self.size * torch.exp(pose[..., 6])
        focal = distance / self.size * torch.exp(pose[..., 5]) * self.side
        center = pose.new_tensor(self.center)
        offset = (pose[..., 3:5] * self.side - center) * (distance / focal)[..., None]
        place = torch.stack([offset[..., 0], -offset[..., 1], -distance], dim=-1)
        turned = (rotation_matrices(rotation) @ pose.new_tensor(self.middle)[:, None])[..., 0]
        return Camera(
            rotation=rotation, translation=place - turned, focal=focal, center=center.expand(*pose.shape[:-1], 2)
        )

    def log_focal(self, pose: FloatArray) -> FloatArray:
        """(...,) logarithms of the focal lengths over `side`."""
        return np.asarray(pose[..., 5] + pose[..., 6])

    def guess(self, points: FloatArray, pixels: FloatArray) -> FloatArray:
        """(7,) pose at which world points (n, 3) fall near pixels (n, 2), seen from far away.

        The affine camera in least squares, then the rotation next to it (DeMenthon and Davis, "Model-Based Object
        Pose in 25 Lines of Code", IJCV 1995, first step).
        """
        from scipy.spatial.transform import Rotation

        local = points - self.middle
        rows = np.column_stack([local, np.ones(len(local))])
        upright = np.column_stack([pixels[:, 0], -pixels[:, 1]])
        affine = np.linalg.lstsq(rows, upright, rcond=None)[0]
        x, y = affine[:3].T
        scale = float(np.sqrt(np.linalg.norm(x) * np.linalg.norm(y)))
        u, _, vt = np.linalg.svd(np.stack([x, y, np.cross(x, y) / max(scale, 1e-12)]))
        turn = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt
        log_scale = np.log(max(scale, 1e-12) * self.size / self.side)
        at = affine[3] * (1, -1) / self.side
        return np.array([*Rotation.from_matrix(turn).as_rotvec(), *at, log_scale, np.log(FOCAL) - log_scale])


@dataclass(frozen=True, kw_only=True)
class FittedCamera:
    """A pinhole camera: ``camera point = R(rotation) world point + translation``, as the renderer's."""

    rotation: FloatArray  # (3,) rotation vector, radians
    translation: FloatArray  # (3,) stage units
    focal: float  # pixels of the photo
    center: tuple[float, float]  # principal point, pixels of the photo from its top left corner


@dataclass(frozen=True, kw_only=True)
class FittedView:
    """One photo as the fit sees it."""

    expressions: Mapping[str, float]  # shape -> weight, of the shapes that were free
    camera: FittedCamera
    light: FloatArray  # (9, 3) spherical harmonics in camera coordinates, as `facepipe.photo.renderer.light`
    key: FloatArray  # (8,) a lamp beside them, as `facepipe.photo.renderer.light.KeyLight`; black where there is none
    landmarks: FloatArray  # (68, 2) of the fitted face, pixels of the photo
    targets: FloatArray  # (68, 2) that the fit was given
    landmark_error: float  # mean distance of the two, pixels; contour points count across the contour
    pupils: FloatArray | None = None  # (2, 3) x, y, and the error to expect: pixels of the photo, the left eye's first


@dataclass(frozen=True, kw_only=True)
class PhotoFit:
    """A person in terms of a face's sliders, and what each photo adds to that."""

    sliders: Mapping[str, float]  # name -> value in the slider's range, of the sliders that were free
    views: tuple[FittedView, ...]
    tint: Mapping[str, tuple[float, float, float]]  # material -> linear factor of its colour
    history: tuple[Mapping[str, float], ...]  # by step: "total" and each weighted term of the joint loss
    kept: int  # step that the result is of: the best since shadows were last made anew
    steps: int  # of gradient descent that were made
    stopped: Stopped
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A face with its free controls: `sliders` are who a person is, `expressions` what a photo adds to that."""

    parts: FaceParts
    rig: Rig
    sliders: tuple[int, ...]  # into parts.sliders
    expressions: tuple[int, ...]  # into rig.shapes

    @classmethod
    def of(cls, parts: FaceParts, expressions: Sequence[str] | None = None) -> Subject:
        """The face's own controls.

        Sliders that drive expressions, themselves or through the face's learned network, stay as they are: a person's
        sliders must not contain the photo's smile. So do mixes of others, and sides of what a slider does on both.

        :param expressions: shapes that are expressions; None: those with ARKit's names
        :raises InputError: a shape that the face lacks, a network that doesn't fit it, or no slider to fit
        """
        rig = build(parts)
        unknown = [name for name in expressions or () if name not in rig.shapes]
        if unknown:
            near = suggestion(unknown[0], rig.shapes)
            raise InputError(f"{parts.name} -> expression {unknown[0]}", f"no such shape{near}")
        names = set(rig.shapes) & ARKIT_SHAPES if expressions is None else set(expressions)
        learned: dict[str, dict[str, float]] = {}  # slider -> shape -> what the face's network changes by it
        if parts.slider_network is not None:
            check_network(parts.slider_network, {slider.name for slider in parts.sliders}, rig.joints)
            learned = shape_changes(parts.slider_network, parts.sliders)
        free = []
        for i, slider in enumerate(parts.sliders):
            driven = {shape for shape, _ in slider.shapes}
            acts = bool(driven or slider.channels or slider.name in learned)
            driven |= {shape for shape, change in learned.get(slider.name, {}).items() if change > _SEEN}
            # modes are fitted as such (`PersonModel`)
            if acts and not slider.modes and slider.maximum > slider.minimum and not driven & names:
                free.append(i)
        needed = independent([parts.sliders[i] for i in free])
        free = [i for i, own in zip(free, needed, strict=True) if own or parts.sliders[i].name in learned]
        if not free:
            raise InputError(
                f"{parts.name} -> sliders", "none that shape a person, expected some (`facepipe sliders FACE --help`)"
            )
        shapes = tuple(i for i, name in enumerate(rig.shapes) if name in names)
        return cls(parts=parts, rig=rig, sliders=tuple(free), expressions=shapes)

    @property
    def free_sliders(self) -> tuple[Slider, ...]:
        """The sliders that may move."""
        return tuple(self.parts.sliders[i] for i in self.sliders)

    def slider_values(self, shares: FloatArray) -> FloatArray:
        """(..., s) values of all sliders from the free ones' shares 0..1 of their ranges (..., f)."""
        own = [slider.default if slider.value is None else slider.value for slider in self.parts.sliders]
        values = np.broadcast_to(np.array(own), (*shares.shape[:-1], len(own))).copy()
        values[..., list(self.sliders)] = self.lower + shares * (self.upper - self.lower)
        return values

    @property
    def lower(self) -> FloatArray:
        """(f,) least values of the free sliders."""
        return np.array([slider.minimum for slider in self.free_sliders])

    @property
    def upper(self) -> FloatArray:
        """(f,) largest values of the free sliders."""
        return np.array([slider.maximum for slider in self.free_sliders])

    @property
    def default_shares(self) -> FloatArray:
        """(f,) where the defaults of the free sliders lie in their ranges, 0..1."""
        default = np.array([slider.default for slider in self.free_sliders])
        return np.asarray((default - self.lower) / (self.upper - self.lower))

    def shape_weights(self, expressions: FloatArray) -> FloatArray:
        """(..., shapes) weights of all shapes from those of the expressions (..., e)."""
        weights = np.zeros((*expressions.shape[:-1], len(self.rig.shapes)))
        weights[..., list(self.expressions)] = expressions
        return weights
