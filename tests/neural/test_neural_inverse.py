"""Controls found for points: the inverse of neural rigs."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from neural_faces import FRAMES, frames, moving, untrained_rig
from neural_training import turning_face

from facepipe.core.errors import InputError, TopologyError
from facepipe.neural import InvertNeuralRig, InvertNeuralRigOptions, load_neural_rig, save_neural_rig
from facepipe.neural.invert import ShapeData, SkinnedData
from facepipe.rig import Rig, build
from facepipe.rig.neural_rig import (
    Control,
    NeuralRig,
    SkinnedPoints,
    bones_in,
    from_default,
    output_derivatives,
    share_limits,
    values_of,
    with_orthonormal_shapes,
)


def bones() -> Rig:
    """Of the face, in millimetres."""
    rig = build(turning_face())
    return bones_in(rig, np.diag([10.0, 10.0, 10.0, 1.0]))


@pytest.fixture(scope="module", params=["points", "bones"])
def rig(request: pytest.FixtureRequest) -> NeuralRig:
    return untrained_rig(bones() if request.param == "bones" else None)


def test_derivatives_are_finite_differences(rig: NeuralRig) -> None:
    random = np.random.default_rng(2)
    x = from_default(rig.controls, frames(rig)[:3])
    outputs, by_control = output_derivatives(rig, x)
    assert np.allclose(outputs, rig.outputs(frames(rig)[:3]))
    way, step = random.normal(size=x.shape[1]), 1e-6
    ahead, behind = (output_derivatives(rig, x + sign * step * way)[0] for sign in (1.0, -1.0))
    assert np.allclose((ahead - behind) / (2 * step), by_control @ way, atol=1e-4)
    if rig.bones is None:
        return
    skinned = SkinnedPoints(rig, rig.bones)
    by_output = skinned.derivatives(outputs[0])
    for number, size in enumerate([1.0] * len(rig.shapes) + [1e-3] * len(rig.channels)):
        turn = np.zeros(len(outputs[0]))
        turn[number] = 1e-3 * size
        found = (rig.deformed(outputs[0] + turn) - rig.deformed(outputs[0] - turn)) / (2e-3 * size)
        assert np.allclose(found.T, by_output[number], atol=1e-3)
    pull = random.normal(size=rig.rest.shape)
    assert np.allclose(skinned.gradient(outputs[0], pull), np.einsum("oin,ni->o", by_output, pull))


def test_slopes_are_those_of_the_cost(rig: NeuralRig) -> None:
    targets = rig.points(frames(rig)[:4])
    data = SkinnedData(rig, targets, 40) if rig.bones else ShapeData.from_targets(rig, targets)
    x, numbers = from_default(rig.controls, frames(rig, 5)[:4]), np.arange(4)
    slope, curved = data.normal(x, numbers)
    assert np.allclose(data.cost(from_default(rig.controls, frames(rig)[:4]), numbers), 0.0, atol=1e-12)
    for control in range(x.shape[1]):
        way = np.eye(x.shape[1])[control] * 1e-5
        found = (data.cost(x + way, numbers) - data.cost(x - way, numbers)) / 2e-5
        assert np.allclose(found, slope[:, control], rtol=1e-4, atol=1e-4)
    assert (np.linalg.eigvalsh(curved) > -1e-9).all()


def test_some_points_stand_for_all() -> None:
    """Second derivatives of a tenth of the points are near those of all."""
    rig = untrained_rig(bones())
    targets = rig.points(frames(rig)[:1])
    x = from_default(rig.controls, frames(rig, 5)[:1])
    some, everything = (SkinnedData(rig, targets, count).normal(x, np.array([0]))[1][0] for count in (100, 10**6))
    assert len(rig.rest) > 900
    shares = np.linalg.eigvals(np.linalg.solve(everything, some)).real
    assert shares.min() > 0.6
    assert shares.max() < 1.6


def test_own_frames_are_found_again(rig: NeuralRig) -> None:
    values = frames(rig)
    found = InvertNeuralRig()(rig, rig.points(values))
    print(found.report)
    assert np.abs(found.values - values).max() < 1e-3
    assert found.report.error_max_mm < 0.01
    assert found.report.not_identifiable == ()


def test_shapes_need_not_be_orthonormal() -> None:
    """Those of a rig that was carried to another face are not, and one may be the sum of others."""
    rig = untrained_rig(None)
    mix = np.random.default_rng(7).normal(size=(10, 10))
    mix[9] = mix[0] + mix[1]
    shapes = np.tensordot(mix, rig.shapes, axes=1)
    other = replace(rig, shapes=shapes, linear=0.3 * rig.linear, last=0.3 * rig.last, last_bias=0.3 * rig.last_bias)
    values = frames(rig)
    same = with_orthonormal_shapes(other)
    assert len(same.shapes) == 9
    assert np.allclose(same.points(values), other.points(values))
    assert with_orthonormal_shapes(rig) is rig
    found = InvertNeuralRig()(other, other.points(values))
    assert np.abs(found.values - values).max() < 1e-3


def test_limits_hold_whatever_the_targets_are(rig: NeuralRig) -> None:
    far = rig.rest + 3.0 * (rig.points(frames(rig)) - rig.rest)
    found = InvertNeuralRig()(rig, far, start=10.0 * frames(rig)).values
    assert np.isfinite(found).all()
    for column, control in zip(found.T, rig.controls, strict=True):
        assert column.min() >= control.minimum
        assert column.max() <= control.maximum
    ends = [(control.minimum, control.maximum) for control in rig.controls]
    assert any(end in column for column, pair in zip(found.T, ends, strict=True) for end in pair)


def test_bad_targets_give_one_line() -> None:
    rig = untrained_rig(None)
    good = rig.points(frames(rig))
    bad = good.copy()
    bad[3, 7, 1] = np.nan
    for points, start, error, what in (
        (good[:, :-1], None, TopologyError, r"target points: shape .*, expected \(frames, \d+, 3\) as the rig has"),
        (good[0], None, TopologyError, "target points: shape"),
        (good[:0], None, InputError, "target points: no frames"),
        (bad, None, InputError, "target points -> frame 3: NaN or infinity"),
        (good, frames(rig)[:2], InputError, r"start: shape \(2, 5\), expected \(24, 5\)"),
    ):
        with pytest.raises(error, match=what):
            InvertNeuralRig()(rig, points, start=start)
    with pytest.raises(InputError, match=r"blocks: shape \(2,\), expected \(24,\)"):
        InvertNeuralRig()(rig, good, blocks=np.zeros(2, int))
    with pytest.raises(InputError, match="option starts"):
        InvertNeuralRigOptions(starts=0)


def test_smoothness_calms_what_noise_shakes_and_leaves_the_motion(rig: NeuralRig) -> None:
    values = moving(rig)[:30]
    noise = np.random.default_rng(3).normal(size=(len(values), *rig.rest.shape))
    jerks, errors = [], []
    for smoothness in (0.0, 10.0):
        found = InvertNeuralRig(options=InvertNeuralRigOptions(smoothness=smoothness))
        clip = np.zeros(len(values), int)
        shaken = found(rig, rig.points(values) + 2.0 * noise, blocks=clip).values
        jerks.append(np.abs(np.diff(shaken - values, 3, axis=0)).mean())
        errors.append(np.abs(shaken - values).mean())
        assert np.abs(found(rig, rig.points(values), blocks=clip).values - values).max() < 0.01
    print(jerks, errors)
    assert jerks[1] < 0.4 * jerks[0]
    assert errors[1] < errors[0]


def test_clips_are_smooth_within_and_not_across(rig: NeuralRig) -> None:
    """Two clips solved at once are the same as each alone."""
    strong = InvertNeuralRig(options=InvertNeuralRigOptions(smoothness=10.0))
    points = rig.points(np.concatenate([moving(rig, 12), frames(rig)[:6]]))
    both = strong(rig, points, blocks=np.repeat([0, 1], [12, 6])).values
    for rows in (slice(12), slice(12, 18)):
        alone = strong(rig, points[rows], blocks=np.zeros(len(points[rows]), int)).values
        assert np.allclose(both[rows], alone, atol=1e-4)


def test_clips_longer_than_a_window_have_no_seam() -> None:
    rig = untrained_rig(None)
    long = moving(rig, 130)  # frames; windows are of 120
    shaken = rig.points(long) + 2.0 * np.random.default_rng(4).normal(size=(130, *rig.rest.shape))
    found = InvertNeuralRig(options=InvertNeuralRigOptions(smoothness=1.0))(rig, shaken, blocks=np.zeros(130, int))
    bent = np.abs(np.diff(found.values - long, 2, axis=0)).max(axis=1)
    assert bent[116:122].max() < 2.0 * np.sort(bent)[-20]


def test_a_price_on_controls_leaves_those_that_do_nothing_at_rest(rig: NeuralRig) -> None:
    idle = replace(
        rig,
        controls=(*rig.controls, Control(name="idle", minimum=-1.0)),
        linear=np.concatenate([rig.linear, np.zeros((1, rig.linear.shape[1]))]),
        hidden=np.concatenate([rig.hidden, np.zeros((len(rig.hidden), 1))], axis=1),
    )
    values = np.concatenate([frames(rig), np.zeros((FRAMES, 1))], axis=1)
    start = np.where(np.arange(6) == 5, 0.7, values)
    found = InvertNeuralRig()(idle, idle.points(values), start=start)
    assert np.array_equal(found.values[:, 5], np.zeros(FRAMES))
    assert found.report.not_identifiable == ("idle",)
    free = InvertNeuralRig(options=InvertNeuralRigOptions(l1=0.0))(idle, idle.points(values), start=start)
    assert np.allclose(free.values[:, 5], 0.7)


def test_two_controls_that_do_the_same_are_found_out(rig: NeuralRig) -> None:
    twin = replace(
        rig,
        controls=(*rig.controls, Control(name="twin")),
        linear=np.concatenate([rig.linear, rig.linear[2:3]]),
        hidden=np.concatenate([rig.hidden, rig.hidden[:, 2:3]], axis=1),
    )
    values = np.concatenate([0.5 * frames(rig), np.full((FRAMES, 1), 0.2)], axis=1)
    report = InvertNeuralRig()(twin, twin.points(values)).report
    assert report.error_max_mm < 0.01
    assert set(report.not_identifiable) == {"smile", "twin"}
    assert report.controls["twin"].own_share < 1e-3
    assert report.controls["twin"].std > 0.28
    assert report.controls["look"].own_share > 0.1


def test_what_is_reported_of_controls_is_least_squares() -> None:
    """Under even noise on all that a straight rig can do, controls are off by their standard errors."""
    rig = untrained_rig(None)
    rig = replace(rig, hidden=rig.hidden * 1e-9, linear=rig.linear * np.linspace(0.2, 1.0, 5)[:, None])
    random, values = np.random.default_rng(6), np.full((400, 5), 0.4)
    shaken = rig.points(values) + np.tensordot(3.0 * random.normal(size=(400, 10)), rig.shapes, axes=1)
    found = InvertNeuralRig(options=InvertNeuralRigOptions(l1=0.0))(rig, shaken)
    off = (found.values - values).std(axis=0) / [control.maximum - control.minimum for control in rig.controls]
    reported = np.array([one.std for one in found.report.controls.values()])
    assert np.allclose(reported, off, rtol=0.25)


@pytest.mark.needs_torch
@pytest.mark.parametrize("rig", [pytest.param("points", marks=pytest.mark.slow), "bones"], indirect=True)
def test_the_documents_mode_finds_own_frames_and_takes_more_steps(rig: NeuralRig, tmp_path: Path) -> None:
    values = frames(rig)[:8]
    points = rig.points(values)
    adam = InvertNeuralRig(options=InvertNeuralRigOptions(mode="adam", adam_steps=300))
    save_neural_rig(rig, tmp_path / "one.fpnr", {})
    with warnings.catch_warnings():  # arrays of files can't be written to, of which torch would warn
        warnings.simplefilter("error")
        adam(load_neural_rig(tmp_path / "one.fpnr"), points[:1])
    first, again = adam(rig, points), adam(rig, points)
    assert np.array_equal(first.values, again.values)
    assert np.median(np.abs(first.values - values).max(axis=1)) < 0.02
    own = InvertNeuralRig(options=InvertNeuralRigOptions(steps=20, starts=1))(rig, points).report
    assert own.error_mean_mm <= first.report.error_mean_mm
    assert own.steps < 0.1 * first.report.steps


def test_frames_in_a_poor_valley_are_started_again() -> None:
    """From a start at the far ends some frames are stuck; further starts bring them home."""
    rig = untrained_rig(None, seed=2)
    rig = replace(rig, last=4.0 * rig.last, hidden=3.0 * rig.hidden)
    values = frames(rig)
    low, high = share_limits(rig.controls)
    far = values_of(rig.controls, np.where(from_default(rig.controls, values) < (low + high) / 2.0, high, low))
    costs = [
        InvertNeuralRig(options=InvertNeuralRigOptions(starts=starts))(rig, rig.points(values), start=far).report
        for starts in (1, 6)
    ]
    print([cost.worst_frame_mm for cost in costs])
    assert costs[0].worst_frame_mm > 0.05
    assert costs[1].worst_frame_mm < 0.01
