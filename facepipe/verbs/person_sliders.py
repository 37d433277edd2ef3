"""A person as values of sliders, and the section that is what they leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.heads.assembly import MODE, values_of
from facepipe.heads.asset import IDENTITY_MODES
from facepipe.parts import FaceParts, PersonBasis, Slider
from facepipe.payload.person import decode_person, encode_person
from facepipe.payload.person_rig import PersonRig
from facepipe.verbs.person_basis import head_basis
from facepipe.verbs.person_layers import encode_points
from facepipe.verbs.person_neutral import head_person_basis, mode_moves


@dataclass(frozen=True, kw_only=True)
class PersonSliders:
    """Who somebody is."""

    values: dict[str, float]  # of sliders of measures and of modes
    basis: PersonBasis  # with the section on which they act
    sliders_left: FloatArray  # (n, 3) millimetres: what the sliders leave, which the section has
    left: FloatArray  # (n, 3) what is left with it
    rows: IntArray  # points of the skin that is seen


def shows_people(parts: FaceParts) -> bool:
    """Whether a face has the sliders that are a person of the built-in head's basis."""
    own, named = parts.person_basis, {slider.name for slider in parts.sliders if slider.modes}
    if own is None or own.digest != head_basis().digest.hex():
        return False
    return named >= {name for name in values_of(np.ones(IDENTITY_MODES)) if name.startswith(MODE)}


def person_sliders(
    sliders: Sequence[Slider],
    points: FloatArray,
    *,
    within: float,
    weights: FloatArray | None = None,
    rig: PersonRig | None = None,
) -> PersonSliders:
    """The sliders' own values of a person with points (n, 3) of the built-in head's basis, in millimetres.

    Measures have what the person measures. Sliders of modes take that off again and add the mode, so that all together
    are the sum of modes, and the section the rest: fits of lids and lips, eyeballs, teeth, what is beyond ranges.

    :param weights: (m,) of the identity modes; None: those that come nearest
    :param within: millimetres that a point may be off
    :param rig: of joints and shapes, which the section has too
    """
    basis, ranges = head_basis(), {slider.name: slider for slider in sliders}
    if weights is None:
        weights = basis.mode_fit.nearest(points)[:IDENTITY_MODES]
    values, kept = {}, np.zeros(IDENTITY_MODES)
    for name, value in values_of(np.asarray(weights, np.float64)).items():
        if name in ranges:
            low, high = ranges[name].minimum, ranges[name].maximum
            values[name] = float(np.float32(min(max(value, low), high)))
            if name.startswith(MODE):
                (mode, gain) = ranges[name].modes[0]
                kept[mode] = gain * values[name]
    moves = mode_moves(basis, dict(enumerate(kept)), "sliders")
    # without modes: sliders have them, and those of lids and lips spread what fits change at a few points: 0.0067 mm
    # (mean) in 271 bytes, where none leave 0.0019 in 48
    neutral = points - moves
    data, layers = encode_points(basis, neutral, within=within, weights=np.zeros(0, np.float16))
    return PersonSliders(
        values=values,
        basis=head_person_basis(encode_person(replace(decode_person(data, "sliders"), rig=rig))),
        sliders_left=neutral - basis.mean,
        left=neutral - layers[-1].points,
        rows=basis.fitted,
    )
