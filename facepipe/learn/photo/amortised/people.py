"""Random people with random expressions, seen from random places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from facepipe.core.arrays import FloatArray
from facepipe.learn.photo.amortised.pose import CropSpace
from facepipe.learn.photo.pose import FOCAL, PoseSpace
from facepipe.learn.photo.subject import Subject

MOVED = (0.3, 0.9)  # share of the sliders that are not at their default
NEUTRAL, MOST_SHAPES, STRONGEST = 0.25, 6, 0.85  # people without expression, shapes of an expression, weights
BOTH_SIDES = 0.7  # expressions whose left and right go together
TURN = np.radians((13.0, 20.0, 8.0))  # standard deviations of pitch, yaw and roll; at most twice that
SHARE = (0.85, 1.15)  # of the side of the picture that a head with its neck has
OFF = 0.1  # sides of the picture that a face is off its middle at most
LENS_SPREAD = 0.4  # of the logarithm of the focal length


@dataclass(frozen=True, kw_only=True)
class People:
    """Parameters of n people."""

    shares: FloatArray  # (n, f)
    expressions: FloatArray  # (n, e)
    poses: FloatArray  # (n, 7) as `PoseSpace`


def random_people(subject: Subject, space: PoseSpace, count: int, rng: np.random.Generator) -> People:
    """So many people, one a picture of that space."""
    default = subject.default_shares
    moved = rng.random((count, len(default))) < rng.uniform(*MOVED, (count, 1))
    shares = np.where(moved, rng.random(moved.shape), default)
    other = _other_sides(subject)
    expressions = np.stack([_expression(len(subject.expressions), other, rng) for _ in range(count)])
    return People(shares=shares, expressions=expressions, poses=_poses(subject, space, count, rng))


def _other_sides(subject: Subject) -> dict[int, int]:
    """Of expressions with a left and a right shape, the other one."""
    shapes = [subject.rig.shapes[i] for i in subject.expressions]
    return {i: shapes.index(_mirrored(one)) for i, one in enumerate(shapes) if _mirrored(one) in shapes}


def _mirrored(name: str) -> str:
    """The name of the other side's shape; of others nothing that is one."""
    for one, other in (("Left", "Right"), ("Right", "Left")):
        if name.endswith(one):
            return name.removesuffix(one) + other
    return ""


def _expression(count: int, other: dict[int, int], rng: np.random.Generator) -> FloatArray:
    weights = np.zeros(count)
    if not count or rng.random() < NEUTRAL:
        return weights
    for shape in rng.permutation(count)[: rng.integers(1, MOST_SHAPES + 1)]:
        weights[shape] = rng.uniform(0.05, STRONGEST)
        if shape in other and rng.random() < BOTH_SIDES:
            weights[other[int(shape)]] = min(weights[shape] * rng.uniform(0.85, 1.15), STRONGEST)
    return weights


def _poses(subject: Subject, space: PoseSpace, count: int, rng: np.random.Generator) -> FloatArray:
    share = rng.uniform(*SHARE, (count, 1))
    log_focal = np.log(FOCAL) + LENS_SPREAD * rng.standard_normal((count, 1))
    turn = TURN * rng.standard_normal((count, 3)).clip(-2, 2)
    place = 0.5 + rng.uniform(-OFF, OFF, (count, 2))
    relative = np.concatenate([turn, place, np.log(share), log_focal - np.log(share)], axis=1)
    whole = CropSpace(space=space, crop=np.eye(2, 3), side=round(space.side), up_axis=subject.parts.up_axis)
    return np.asarray(whole.to_photo(torch.as_tensor(relative)).numpy())
