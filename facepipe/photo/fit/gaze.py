"""Where eyes look in a photo: values of the sliders that turn them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.parts import FaceParts, Slider
from facepipe.stage import Face

if TYPE_CHECKING:
    from facepipe.photo.descent.result import FittedView

SCHEME = "pupils"
_LOOKS = "eyeLook"  # of ARKit's shapes of lids that follow eyes
_STEP, _ROUNDS = 0.02, 3  # of a slider's range, and of Gauss and Newton
_USUAL = 0.5  # standard deviation of a slider


def look_sliders(sliders: tuple[Slider, ...]) -> tuple[Slider, ...]:
    """Sliders that turn the eyes, and of shapes drive those of lids that follow them alone."""
    return tuple(
        one for one in sliders if one.channels and one.shapes and all(name.startswith(_LOOKS) for name, _ in one.shapes)
    )


def pupil_points(parts: FaceParts) -> IntArray:
    """(2,) points of the pupils, meshes concatenated, the person's left first; none without the scheme `SCHEME`."""
    start, found = 0, []
    for mesh in parts.meshes:
        if SCHEME in mesh.landmarks:
            found += [start + int(index) for index in mesh.landmarks[SCHEME].indices]
        start += len(mesh.points)
    return np.array(found if len(found) == 2 else [], np.int64)


def gaze(face: Face, values: Mapping[str, float], view: FittedView) -> dict[str, float]:
    """Values of the look sliders that turn the pupils of a person to where a photo has them; none: it shows none.

    The likeliest, by Gauss-Newton: the pupils' errors are normal, and so are the sliders about their defaults.

    :param values: of the person's sliders
    """
    sliders, points = look_sliders(face.sliders), pupil_points(face.parts())
    seen = view.pupils
    if seen is None or not sliders or len(points) != 2:
        return {}
    rest = np.array([slider.default for slider in sliders])
    lower, upper = (np.array([getattr(slider, name) for slider in sliders]) for name in ("minimum", "maximum"))
    names = [slider.name for slider in sliders]

    def residuals(at: FloatArray) -> FloatArray:
        looking = dict(values) | dict(zip(names, at.tolist(), strict=True))
        marks = _projected(view, face.evaluate(dict(view.expressions), sliders=looking)[points])
        return np.append((marks - seen[:, :2]) / seen[:, 2:], (at - rest) / _USUAL)

    found = rest
    for _ in range(_ROUNDS):
        steps = [np.where(np.arange(len(found)) == i, _STEP, 0.0) for i in range(len(found))]
        slopes = [(residuals(found + step) - residuals(found - step)) / (2 * _STEP) for step in steps]
        change = np.linalg.lstsq(np.stack(slopes, axis=1), -residuals(found), rcond=None)[0]
        # a step inside the range: beyond its end the central difference would halve the slope
        found = np.clip(found + change, lower + _STEP, upper - _STEP)
    return dict(zip(names, found.tolist(), strict=True))


def _projected(view: FittedView, points: FloatArray) -> FloatArray:
    """(n, 2) pixels of world points."""
    from scipy.spatial.transform import Rotation

    camera = view.camera
    local = Rotation.from_rotvec(camera.rotation).apply(points) + camera.translation
    return np.asarray(camera.focal * local[:, :2] * (1, -1) / -local[:, 2:] + camera.center)
