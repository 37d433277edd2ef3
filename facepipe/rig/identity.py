"""What sliders do by modes of the face's basis of people: to the neutral, where a face is set.

Dense shapes of a hundred modes would double a stage of 15 MB, and a GLB; the basis has them.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol

from facepipe.parts import FaceParts
from facepipe.rig.sliders import mode_weights

_NEUTRALS = "facepipe.verbs.person_neutral"  # by name: lids, joints and cards follow points by what stands above


class Neutrals(Protocol):
    """What knows the bases of people."""

    def with_section(self, parts: FaceParts, where: str) -> FaceParts:
        """The face with the neutral of its section, which the points then are.

        :raises FacepipeError: a damaged section, or a face or basis that it is not of
        """

    def with_modes(self, parts: FaceParts, weights: Mapping[int, float]) -> FaceParts:
        """The face with a neutral moved by weights of its basis's modes, in standard deviations.

        :raises FacepipeError: a face that is not of that basis
        """


def neutrals() -> Neutrals:
    """The module."""
    found: Neutrals = importlib.import_module(_NEUTRALS)
    return found


def with_identity(parts: FaceParts, values: Mapping[str, float] | None = None) -> FaceParts:
    """The face whose neutral has what its sliders do by modes, which they then have no more; itself if that is nothing.

    :param values: of sliders, in place of the authored ones
    :raises FacepipeError: a face that is not of the basis of its sliders
    """
    weights = mode_weights(parts.sliders, values)
    if not weights:
        return parts
    changed = neutrals().with_modes(parts, weights)
    return replace(changed, sliders=tuple(replace(slider, modes=()) for slider in changed.sliders))
