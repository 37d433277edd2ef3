"""Where a person's joints rest and how shapes go, against what the points alone give: section 12 of a payload."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.payload.small_numbers import decode_numbers, encode_numbers

LARGEST_STEPS = 127  # of a channel of a joint
LARGEST_GROWTH = 3.0  # logarithm of a scale
HALF_TURN = 1.002  # square of its axis in float16, at most
LARGEST_MOVE, LARGEST_TURN = 10.0, 0.1  # millimetres and radians of a step
_CHANNELS = 6
_HEAD = struct.Struct("<6eB")  # shapes, steps of moves and of turns, joints


@dataclass(frozen=True, kw_only=True)
class PersonRig:
    """What blends and scans have beside points; who is drawn has none.

    Turns are coded as what they differ by from the joint before: of a blend all joints turn much alike, which takes 60
    bytes, where each for itself takes 150.
    """

    shapes: FloatArray  # (4,) float16 that offsets of shapes turn and grow by: x y z of a quaternion, log of the scale
    move: float  # float16, millimetres of a step
    turn: float  # float16, radians of a step
    steps: IntArray  # (j, 6) of the basis's first joints: three of moves, three of turns less the joint's before

    def coefficients(self) -> FloatArray:
        """(j, 9) bone coefficients, in millimetres, that take joints from where points have them to where they rest."""
        found = np.ones((len(self.steps), 9))
        found[:, :3] = self.move * self.steps[:, :3]
        found[:, 3:6] = self.turn * np.cumsum(self.steps[:, 3:], axis=0)
        return found


def rig_bytes(rig: PersonRig, where: object) -> bytes:
    """The section.

    :raises InputError: numbers beyond limits
    """
    _check(rig, where)
    head = _HEAD.pack(*np.asarray(rig.shapes, np.float64), rig.move, rig.turn, len(rig.steps))
    return head + encode_numbers(rig.steps)


def read_rig(data: bytes, where: object) -> PersonRig:
    """That of a section.

    :raises InputError: bytes that are too few, or numbers beyond limits
    """
    if len(data) < _HEAD.size:
        raise InputError(where, f"{len(data)} bytes, expected at least {_HEAD.size}")
    *shapes, move, turn, count = _HEAD.unpack_from(data)
    steps = decode_numbers(data[_HEAD.size :], count, _CHANNELS, where)
    rig = PersonRig(shapes=np.array(shapes, np.float16), move=move, turn=turn, steps=steps)
    _check(rig, where)
    return rig


def _check(rig: PersonRig, where: object) -> None:
    shapes = np.asarray(rig.shapes, np.float64)
    if not ((np.abs(shapes) <= [1, 1, 1, LARGEST_GROWTH]).all() and (shapes[:3] ** 2).sum() <= HALF_TURN):
        numbers = " ".join(f"{value:g}" for value in shapes)
        raise InputError(f"{where} -> shapes", f"{numbers}, expected part of a quaternion, a scale")
    for what, step, most in (("mm", rig.move, LARGEST_MOVE), ("radians", rig.turn, LARGEST_TURN)):
        if not 0 < step <= most:
            raise InputError(where, f"steps of {step:g} {what}, expected more than 0 and at most {most:g}")
    beyond = np.abs(rig.steps).max(axis=1, initial=0)
    if beyond.max(initial=0) > LARGEST_STEPS:
        joint = int(np.argmax(beyond))
        raise InputError(f"{where} -> joint {joint}", f"{beyond[joint]} steps, expected at most {LARGEST_STEPS}")
