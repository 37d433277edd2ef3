"""Inbetweens as shape keys: ``jawOpen@0.5 half`` holds what the inbetween ``half`` adds to half of ``jawOpen``.

A driver gives such a key the activation that USD gives the inbetween, so that Blender shows the sum that USD means:
with the shape at w, offsets D, and inbetweens I_i at w_i of activation a_i(w), the sum ``w D + a_i (I_i - w_i D)`` is
USD's ``a_1 D + a_i I_i``, since piecewise linear interpolation reproduces w itself.
"""

from __future__ import annotations

from typing import NamedTuple

from facepipe.core.names import identifier
from facepipe.hosting.host_face import Curve, curves

_MARK = "@"


class KeyName(NamedTuple):
    """What the name of a shape key says; `weight` None for a shape itself."""

    shape: str
    weight: float | None = None
    inbetween: str = ""


def key_name(shape: str, weight: float, inbetween: str) -> str:
    """The name of the key of an inbetween."""
    return f"{shape}{_MARK}{weight:.7g} {inbetween}"


def read_key_name(name: str) -> KeyName:
    """What a key's name says; one without a weight after the mark is a shape itself."""
    shape, mark, rest = name.rpartition(_MARK)
    number, _, inbetween = rest.partition(" ")
    try:
        weight = float(number)
    except ValueError:
        return KeyName(name)
    if not mark or not shape or weight in (0.0, 1.0) or not abs(weight) < 1e6:
        return KeyName(name)
    return KeyName(shape, weight, inbetween.strip() or identifier(f"at_{number}"))


def expressions(weights: tuple[float, ...], variable: str) -> dict[float, str]:
    """Driver expression of every inbetween weight of a shape, of what Blender evaluates without Python."""
    return {weight: _expression(curve, variable) for weight, curve in curves(weights).items() if weight != 1.0}


def _expression(curve: Curve, variable: str) -> str:
    base, slope, bends = curve.hinges()
    terms = [f"{base:.9g} + {slope:.9g}*{variable}"]
    terms += [f"{change:.9g}*max({variable} - {at:.9g}, 0)" for at, change in bends]
    return " + ".join(terms)
