"""Where a face is and how it stands, from landmarks in space; views of it from there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.pinhole import Pinhole

RIGHT_EYE, LEFT_EYE, MOUTH = slice(36, 42), slice(42, 48), slice(48, 68)
# In the crops that the network knows, shares of a side: between the eyes, from eyes to mouth, and from the eyes down to
# the middle of the crop.
_EYES, _EYES_TO_MOUTH, _EYES_TO_MIDDLE = 0.279, 0.295, 0.18
_TILT = 0.27  # radians that the mouth stands before the eyes, on ICT-FaceKit's mean
_INSIDE = 0.22  # of a side: what views turn about lies behind the surface


@dataclass(frozen=True, kw_only=True)
class FaceFrame:
    """A face in space."""

    middle: FloatArray  # (3,) of the crop, on the surface
    axes: FloatArray  # (3, 3) rows: the person's left, up, forward
    side: float  # of the crop

    def view(self, yaw: float, pitch: float, size: int, margin: float) -> Pinhole:
        """A view turned to the person's left and up, radians; `margin` crops' sides wide."""
        backward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
        right = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
        turned = np.stack([right, np.cross(backward, right), backward]) @ self.axes
        centre = self.middle - _INSIDE * self.side * self.axes[2]
        shown = centre + _INSIDE * self.side * turned[2] * np.cos(yaw) * np.cos(pitch)
        return Pinhole.around(shown, turned, margin * self.side / 2, size, distance=10.0)


def face_frame(landmarks: FloatArray) -> FaceFrame | None:
    """The frame of landmarks (68, 3), rows of NaN where unknown; None where they are too few or don't fit a face."""
    eyes_and_mouth = [landmarks[part] for part in (RIGHT_EYE, LEFT_EYE, MOUTH)]
    if any(np.isfinite(one[:, 0]).sum() < 2 for one in eyes_and_mouth):
        return None
    right, left, mouth = (np.nanmean(one, axis=0) for one in eyes_and_mouth)
    between, down = left - right, mouth - (left + right) / 2
    across = np.linalg.norm(between)
    x = between / max(across, np.finfo(np.float64).tiny)
    drop = down - (down @ x) * x
    height = np.linalg.norm(drop)
    if not (0.3 * across < height < 3.0 * across):
        return None
    y = -drop / height
    z = np.cross(x, y)
    y, z = np.cos(_TILT) * y + np.sin(_TILT) * z, np.cos(_TILT) * z - np.sin(_TILT) * y
    side = float(max(across / _EYES, height / _EYES_TO_MOUTH))
    middle = (left + right) / 2 - _EYES_TO_MIDDLE * side * y
    middle = middle + ((mouth - middle) @ z) * z
    return FaceFrame(middle=middle, axes=np.stack([x, y, z]), side=side)
