"""Weights of a performance that mean sliders: what these do, as motion of joints and weights of shapes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import FaceParts
from facepipe.rig.bone_coefficients import coefficient_matrices, matrix_coefficients, rest_coefficients
from facepipe.rig.sliders import slide


class Driven(NamedTuple):
    """What sliders do on top of the person."""

    coefficients: FloatArray  # (T, j, 9) of all joints
    weights: dict[str, FloatArray]  # shape -> (T,)


def driven(
    parts: FaceParts, tracks: Mapping[str, FloatArray], frames: int, done: Callable[[], object] = lambda: None
) -> Driven:
    """What the sliders of `tracks` do, all others at their defaults.

    :param tracks: slider -> (T,) weights: 0 is its default, 1 its maximum
    :param done: called after every frame
    """
    joints = parts.skeleton.joints
    at_rest = np.tile(rest_coefficients(len(joints)), (frames, 1, 1))
    if not tracks:
        return Driven(at_rest, {})
    needed = {*tracks, *(() if parts.slider_network is None else parts.slider_network.sliders)}
    sliders = [replace(one, value=None) for one in parts.sliders if one.name in needed]
    values = {
        one.name: one.default + tracks[one.name] * (one.maximum - one.default) for one in sliders if one.name in tracks
    }
    still, weights_still = slide(sliders, joints, network=parts.slider_network)
    coefficients, weights = at_rest, np.zeros((frames, len(names := _shapes(parts))))
    for frame in range(frames):
        now = {name: float(track[frame]) for name, track in values.items()}
        coefficients[frame], own = slide(sliders, joints, now, parts.slider_network)
        weights[frame] = [own.get(name, 0.0) - weights_still.get(name, 0.0) for name in names]
        done()
    if (still != rest_coefficients(len(joints))).any():  # a network that is not quite 0 there
        matrices = np.linalg.inv(coefficient_matrices(still)) @ coefficient_matrices(coefficients)
        coefficients = matrix_coefficients(matrices)
    moved = np.asarray(weights.any(axis=0))
    return Driven(coefficients, {name: weights[:, i] for i, name in enumerate(names) if moved[i]})


def _shapes(parts: FaceParts) -> Sequence[str]:
    return list(dict.fromkeys(shape.name for mesh in parts.meshes for shape in mesh.blendshapes))


def turned(first: FloatArray, then: FloatArray) -> FloatArray:
    """(T, 9) coefficients of the motion `then` within the turn `first`, both (T, 9)."""
    return matrix_coefficients(coefficient_matrices(first) @ coefficient_matrices(then))
