"""Where the eyes of a head in the box look, and what of an eyeball comes through its lids there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from contacts import Subject, eye_sheets, worst

from facepipe.geometry.contacts import Contact, Sheet
from facepipe.parts import FaceParts
from facepipe.rig.rig import build
from facepipe.rig.sliders import slide

AROUND = 30.0  # mm from the middle of an eyeball: no skin that is farther hides it
BOUND = (4, 0.3)  # cells and mm that a pose may have
_ENDS = (-1.0, 1.0)
LOOKS: Mapping[str, Mapping[str, float]] = {
    f"{slider} {value:+.0f}": {slider: value} for slider in ("lookLeft", "lookDown") for value in _ENDS
}
_BETWEEN = {f"half {name}": {slider: value / 2 for slider, value in look.items()} for name, look in LOOKS.items()} | {
    f"lookLeft {left:+.0f}, lookDown {down:+.0f}": {"lookLeft": left, "lookDown": down}
    for left in _ENDS
    for down in _ENDS
}
_LIDS = {"squint": ("eyeSquint", 1.0), "half a blink": ("eyeBlink", 0.5)}  # shape of each side, and its weight


@dataclass(frozen=True)
class Pose:
    """Sliders and shapes of a head, by what it is called."""

    name: str
    sliders: Mapping[str, float]
    weights: Mapping[str, float]


def eye_sliders(parts: FaceParts) -> tuple[str, ...]:
    """The sliders of who a person is that change both eyes."""
    names = [slider.name for slider in parts.sliders if slider.group == "eyes" and not slider.name.startswith("look")]
    return tuple(name for name in names if not name.endswith(("Left", "Right")))


def poses(parts: FaceParts) -> Iterator[Pose]:
    """Rest and looks to the sides, up and down: alone, with a squint, with half a blink, and with each slider of eyes
    at both its ends; then looks half as far, and those to corners, alone."""
    for look, sliders in {"rest": {}, **LOOKS}.items():
        yield Pose(look, sliders, {})
        for name, (shape, weight) in _LIDS.items():
            yield Pose(f"{look}, {name}", sliders, {f"{shape}{side}": weight for side in ("Left", "Right")})
        for slider in eye_sliders(parts):
            for end in _ENDS:
                yield Pose(f"{look}, {slider} {end:+.0f}", {**sliders, slider: end}, {})
    for look, sliders in _BETWEEN.items():
        yield Pose(look, sliders, {})


def gaze_sheets(average: Subject) -> tuple[Sheet, ...]:
    """Both eyeballs of the average head with the skin around them alone."""
    found = []
    for sheet in eye_sheets(average):
        middle = average.neutral[sheet.hard].mean(axis=(0, 1))
        near = [
            rows[np.linalg.norm(average.neutral[rows].mean(axis=1) - middle, axis=1) < AROUND]
            for rows in (sheet.skin, sheet.outer)
        ]
        found.append(replace(sheet, skin=near[0], outer=near[1]))
    return tuple(found)


class Poser:
    """Points in millimetres of a head in any pose."""

    def __init__(self, parts: FaceParts) -> None:
        self._parts, self._rig = parts, build(parts)
        self._defaults = {slider.name: slider.default for slider in parts.sliders}

    def points(self, pose: Pose) -> npt.NDArray[np.float64]:
        """(n, 3) of all meshes one after another."""
        values = {**self._defaults, **pose.sliders}
        coefficients, weights = slide(self._parts.sliders, self._rig.joints, values, self._parts.slider_network)
        for name, weight in pose.weights.items():
            weights[name] = weights.get(name, 0.0) + weight
        moved = self._rig.evaluate(weights, coefficients=coefficients)
        return np.asarray(moved * 1000.0 * self._parts.meters_per_unit)


def through_lids(points: npt.NDArray[np.float64], sheets: tuple[Sheet, ...]) -> Contact:
    """The worst of both eyes."""
    return worst(sheet.through(points) for sheet in sheets)
