"""Animations at whole frames of another rate."""

from __future__ import annotations

import numpy as np

from facepipe.parts import Animation, Skeleton
from facepipe.rig.animation import resampled, whole_frames


def test_times_that_are_frames_but_for_rounding_add_none() -> None:
    for off in (-1e-6, 0.0, 1e-6):
        np.testing.assert_allclose(whole_frames(7 / 30 + off, 9 / 30 + off, 30.0), [7 / 30, 8 / 30, 9 / 30])


def test_a_turn_through_half_a_circle_loses_nothing() -> None:
    """Where w of a quaternion changes its sign, the rotation is the same; frames between go the short way."""
    times = np.array([0.0, 0.51, 1.0])  # 0.51 is no frame
    angles = np.radians(170.0 + 40.0 * times) / 2
    turns = np.stack([0 * angles, 0 * angles, np.sin(angles), np.cos(angles)], axis=1)[:, None]
    still = np.zeros((3, 1, 3))
    skeleton = Skeleton(joints=("head",), bind_transforms=np.eye(4)[None], rest_transforms=np.eye(4)[None])
    clip = Animation(
        name="turn",
        times=times,
        joints=("head",),
        translations=still,
        rotations=turns,
        scales=still + 1,
    )
    found, off = resampled(skeleton, clip, 24.0, 1.0)
    assert off == "nothing"
    assert found.rotations is not None
    np.testing.assert_allclose(np.abs(found.rotations[6, 0]), [0, 0, 1, 0], atol=1e-9)  # half a circle at 0.25 s
