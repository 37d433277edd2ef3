"""Expressions of people who are rebuilt from payloads, against those of the stages that these were written of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import facepipe
from facepipe.core.arrays import FloatArray
from facepipe.heads.asset import asset
from facepipe.parts import FaceParts
from facepipe.payload.person import decode_person, encode_person
from facepipe.rig import build, rest_coefficients
from facepipe.rig.conventions import ARKIT_SHAPES

HEAD = slice(0, asset().parts["Head"].points.stop)
_POSES = 50
_SHARE = 0.3  # of the way to the bone limits, at most


class Expressions(NamedTuple):
    """Millimetres between a stage and its person, mean over the head."""

    rest: float
    shapes: FloatArray  # (52,) each at 1
    poses: FloatArray  # (50,) random ones of all joints


def evaluated(parts: FaceParts, weights: dict[str, float], coefficients: FloatArray | None = None) -> FloatArray:
    """(n, 3) millimetres of the head."""
    return np.asarray(10 * build(parts).evaluate(weights, coefficients=coefficients)[HEAD])


def pose(parts: FaceParts, rng: np.random.Generator) -> FloatArray:
    """(j, 9) up to a share of the way to the bone limits."""
    limits, rest = parts.bone_limits, rest_coefficients(len(parts.skeleton.joints))
    assert limits is not None
    ends = np.where(rng.random(rest.shape) < 0.5, limits.lower, limits.upper)
    return np.asarray(rest + _SHARE * rng.random(rest.shape) * (ends - rest))


def against_its_own(face: Path, head: Path, folder: Path, most: int = 10_000) -> dict[str, Expressions]:
    """Of so many bytes of a face on a head, by `with` the rig and `without`."""
    facepipe.person(face, out=folder / "with.fpb", most=most)
    content = decode_person((folder / "with.fpb").read_bytes(), "me")
    (folder / "without.fpb").write_bytes(encode_person(replace(content, rig=None)))
    own, found = facepipe.open(face).parts(), dict[str, Expressions]()
    for name in ("with", "without"):
        facepipe.apply_bones(head, folder / f"{name}.fpb", out=folder / f"{name}.usdc")
        found[name] = _apart(own, facepipe.open(folder / f"{name}.usdc").parts())
    return found


def _apart(own: FaceParts, other: FaceParts) -> Expressions:
    first, second, rng = build(own), build(other), np.random.default_rng(0)

    def off(weights: dict[str, float], coefficients: FloatArray | None = None) -> float:
        one, two = (rig.evaluate(weights, coefficients=coefficients)[HEAD] for rig in (first, second))
        return float(10 * np.linalg.norm(one - two, axis=1).mean())

    shapes = np.array([off({name: 1.0}) for name in ARKIT_SHAPES])
    return Expressions(rest=off({}), shapes=shapes, poses=np.array([off({}, pose(own, rng)) for _ in range(_POSES)]))
