"""What may move when a face is fitted to photos: its sliders, and its expressions beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import suggestion
from facepipe.parts import FaceParts, Slider
from facepipe.rig import Rig, build
from facepipe.rig.conventions import ARKIT_SHAPES
from facepipe.rig.slider_network import check_network, shape_changes
from facepipe.rig.sliders import independent

_SEEN = 0.01  # change of a shape's weight from which a learned network's slider drives it: less is noise of training


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
        learned = _learned(parts, rig)
        free = [i for i, one in enumerate(parts.sliders) if _of_a_person(one, names, learned.get(one.name))]
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


def _learned(parts: FaceParts, rig: Rig) -> dict[str, dict[str, float]]:
    """What the face's network changes by each slider, by shape."""
    if parts.slider_network is None:
        return {}
    check_network(parts.slider_network, {slider.name for slider in parts.sliders}, rig.joints)
    return shape_changes(parts.slider_network, parts.sliders)


def _of_a_person(slider: Slider, expressions: set[str], learned: Mapping[str, float] | None) -> bool:
    """:param learned: how much a network of the face changes shapes by the slider; None: it has none for that"""
    driven = {shape for shape, _ in slider.shapes}
    acts = bool(driven or slider.channels or learned is not None)
    driven |= {shape for shape, change in (learned or {}).items() if change > _SEEN}
    return acts and slider.maximum > slider.minimum and not driven & expressions
