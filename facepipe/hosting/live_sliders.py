"""A face whose sliders move: read once, then its points, or its person as a payload, for any values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.parts import FaceParts, Slider
from facepipe.rig.sliders import mode_weights
from facepipe.stage import Face, open_face

_MM = 1e3  # of a metre


class LiveSliders:
    """The sliders of a face stage; values that are not given are those authored there."""

    def __init__(self, path: Path) -> None:
        """:raises SchemaError: a stage without a face"""
        self._face, self._where = open_face(path), str(path)
        # what sliders of modes make of the neutral takes a second, all others milliseconds: the last one is kept
        self._neutral: tuple[Mapping[int, float], Face] = (mode_weights(self.sliders), self._face.with_identity())

    @cached_property
    def base(self) -> FaceParts:
        """The face as it is authored."""
        return self._face.parts()

    @property
    def sliders(self) -> tuple[Slider, ...]:
        """All sliders of the face."""
        return self._face.sliders

    @cached_property
    def _start(self) -> FloatArray:
        return self._face.evaluate(pose="set")

    def offsets(self, values: Mapping[str, float]) -> FloatArray:
        """(n, 3) millimetres in glTF space from the points that the face is set to, meshes one after another.

        :param values: by slider
        :raises InputError: no such slider, or a value out of its range
        """
        turn = self.base.gltf_axes[:3, :3]
        return (self._points(self._checked(values)) - self._start) @ turn.T * _MM

    def payload(self, values: Mapping[str, float]) -> bytes:
        """The person that the values make, as `facepipe person` writes it.

        :raises InputError: as `offsets` does, or a face without a basis
        """
        from facepipe.verbs.person import encoded_person

        values = self._checked(values)
        sliders = tuple(replace(one, value=values.get(one.name, one.value)) for one in self.sliders)
        return encoded_person(replace(self.base, sliders=sliders, person=None), self._where)[0]

    def _points(self, values: Mapping[str, float]) -> FloatArray:
        """(n, 3) world points of the stage."""
        modes = mode_weights(self.sliders, values)
        if modes != self._neutral[0]:
            self._neutral = (modes, self._face.with_identity(values))
        return self._neutral[1].evaluate(sliders=values)

    def _checked(self, values: Mapping[str, float]) -> Mapping[str, float]:
        known = {slider.name: slider for slider in self.sliders}
        for name, value in values.items():
            if name not in known:
                raise InputError("sliders", unknown(name, known, "slider"))
            low, high = known[name].minimum, known[name].maximum
            if not (isinstance(value, int | float) and low <= value <= high):  # NaN too
                raise InputError(f"slider {name}", f"value {str(value)[:20]}, expected {low:g} to {high:g}")
        return values
