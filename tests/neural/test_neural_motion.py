"""Examples of rigs: what is sampled, how it is split, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from neural_training import FEW, chewing_face

from facepipe.core.errors import InputError, TopologyError
from facepipe.neural import SampleMotion, SampleMotionOptions
from facepipe.neural.motion import controls_of
from facepipe.verbs.whole_faces import whole_face, whole_points


def test_controls_are_sliders_and_the_shapes_that_none_of_them_drives() -> None:
    assert [control.name for control in controls_of(chewing_face())] == ["chew", "smile"]
    assert (controls_of(chewing_face())[0].minimum, controls_of(chewing_face())[1].maximum) == (-0.5, 1.0)
    with pytest.raises(InputError, match="has neither sliders nor shapes"):
        SampleMotion()(replace(chewing_face(), sliders=(), meshes=chewing_face().meshes[1:]), "head.usda")


def test_frames_are_what_the_rig_makes_of_the_controls() -> None:
    """Millimetres, Y up; straight in the shape, and a turn about the jaw's axis keeps distances from the joint."""
    motion = SampleMotion(options=FEW)(chewing_face(), "head.usda")
    assert motion.points.shape == (20 + 2 * 5 + 30, len(whole_points(chewing_face())), 3)
    assert np.allclose(motion.rest, whole_points(chewing_face()))
    smile = whole_face(chewing_face(), "head").deltas["smile"]
    alone = np.flatnonzero((motion.values[:, 0] == 0.0) & (motion.values[:, 1] != 0.0))
    assert len(alone) >= 4
    for frame in alone:
        assert np.allclose(motion.points[frame], motion.rest + motion.values[frame, 1] * smile, atol=1e-4)


def test_a_stage_in_other_units_and_axes_gives_the_same_frames() -> None:
    one = SampleMotion(options=FEW)(chewing_face(), "head.usda")
    parts = chewing_face()
    slid = replace(parts, meters_per_unit=parts.meters_per_unit * 10.0)
    other = SampleMotion(options=FEW)(slid, "head.usda")
    assert np.array_equal(one.values, other.values)
    assert np.allclose(other.points, 10.0 * one.points, rtol=1e-5, atol=1e-3)


def test_the_spread_is_even_in_each_control() -> None:
    motion = SampleMotion(options=SampleMotionOptions(spread=50, busy=1.0, sweep=0, together=0))(
        chewing_face(), "head.usda"
    )
    for column, (low, high) in zip(motion.values.T, ((-0.5, 1.0), (0.0, 1.0)), strict=True):
        assert np.array_equal(np.sort(((column - low) / (high - low) * 50).astype(int)), np.arange(50))
    again = SampleMotion(options=SampleMotionOptions(spread=50, busy=1.0, sweep=0, together=0, seed=1))(
        chewing_face(), "head.usda"
    )
    assert not np.array_equal(motion.values, again.values)


def test_blocks_stay_together_when_frames_are_held_out() -> None:
    motion = SampleMotion(options=FEW)(chewing_face(), "head.usda")
    learned, checked = motion.split(0.25, seed=3)
    assert len(learned.values) + len(checked.values) == len(motion.values)
    assert not set(learned.blocks.tolist()) & set(checked.blocks.tolist())
    assert 0.1 < len(checked.values) / len(motion.values) < 0.4
    with pytest.raises(InputError, match="one block of frames, expected two or more"):
        motion.frames(np.flatnonzero(motion.blocks == 0)).split(0.25, seed=3)


def test_controls_that_no_frame_moves_are_named_and_left_out() -> None:
    motion = SampleMotion(options=FEW)(chewing_face(), "head.usda")
    still = motion.frames(np.flatnonzero(motion.values[:, 1] == 0.0))
    assert still.constant == ("smile",)
    assert [control.name for control in still.without(still.constant).controls] == ["chew"]


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda one: {"values": one.values[:-1]}, TopologyError, "points: shape .* expected"),
        (lambda one: {"points": one.points[:, :-1]}, TopologyError, "points: shape .* expected"),
        (lambda one: {"values": np.where(one.values == one.values.max(), np.nan, one.values)}, InputError, "NaN"),
        (lambda one: {"values": one.values + 0.7}, InputError, "head.usda -> chew: .* expected -0.5 to 1"),
        (lambda one: {"controls": (one.controls[0],) * 2}, InputError, "two controls of this name"),
        (lambda one: {"controls": (), "values": one.values[:, :0]}, InputError, "frames of 0 controls"),
    ],
)
def test_examples_that_do_not_fit_are_refused(change: object, error: type[Exception], message: str) -> None:
    motion = SampleMotion(options=FEW)(chewing_face(), "head.usda")
    with pytest.raises(error, match=message):
        replace(motion, **change(motion))  # type: ignore[operator]


def test_nothing_asked_for_is_reported() -> None:
    with pytest.raises(InputError, match="no frame, expected some of spread, sweep or together"):
        SampleMotion(options=SampleMotionOptions(spread=0, sweep=0, together=0))(chewing_face(), "head.usda")
