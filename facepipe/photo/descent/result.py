"""What a fit to photos found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from facepipe.core.arrays import FloatArray

Stopped = Literal["iterations", "loss-threshold", "not-finite"]


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
