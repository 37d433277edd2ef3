"""Neural rigs carried to other subjects."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from baked_frames import bake
from command_line import done, failed
from neural_training import OPTIONS, SAMPLES, second_face, turning_face
from pxr import Usd

from facepipe.core.errors import InputError, TopologyError
from facepipe.geometry.ridge import Examples
from facepipe.neural import (
    Motion,
    SampleMotion,
    SampleMotionOptions,
    TrainNeuralRig,
    load_neural_rig,
    save_neural_rig,
)
from facepipe.neural.options import RetargetOptions
from facepipe.neural.retarget import RetargetNeuralRig, Subject, carried, with_own_gains
from facepipe.rig.neural_rig import NeuralRig
from facepipe.stage import save_parts

pytestmark = pytest.mark.needs_torch
FRAMES = SampleMotionOptions(spread=60, sweep=0, together=0, seed=3)
OTHERS = replace(FRAMES, seed=4)


@pytest.fixture(scope="module")
def rig() -> NeuralRig:
    return TrainNeuralRig(options=OPTIONS)(SampleMotion(options=SAMPLES)(turning_face(), "head.usda")).rig


def motion(options: SampleMotionOptions) -> Motion:
    return SampleMotion(options=options)(second_face(), "second.usda")


def off(rig: NeuralRig, frames: Motion) -> float:
    return float(np.linalg.norm(rig.points(frames.values) - frames.points, axis=2).mean())


def test_carried_to_its_own_face_a_rig_is_as_it_was(rig: NeuralRig) -> None:
    same = carried(rig, Subject.of(turning_face(), "head.usda"))
    values = motion(FRAMES).values[:5]
    assert np.allclose(same.points(values), rig.points(values), atol=1e-3)


def test_a_larger_face_in_other_units_moves_as_much_more(rig: NeuralRig) -> None:
    """What is twice as large moves twice as far, bones too."""
    parts = turning_face()
    large = carried(rig, Subject.of(replace(parts, meters_per_unit=2.0 * parts.meters_per_unit), "large.usda"))
    values = motion(FRAMES).values[:5]
    assert np.allclose(large.points(values), 2.0 * rig.points(values), atol=2e-3)


def test_frames_of_the_subject_bring_what_is_its_own(rig: NeuralRig) -> None:
    subject, unseen = Subject.of(second_face(), "second.usda"), motion(OTHERS)
    seen = motion(FRAMES)
    found = RetargetNeuralRig()(rig, subject, seen.points, seen.values)
    print(found.report)
    assert off(found.rig, unseen) < 0.5 * off(carried(rig, subject), unseen)
    assert found.report.error_mean_mm < 0.7 * min(found.report.transfer_mean_mm, found.report.copy_mean_mm)
    assert (found.report.frames, found.report.held_out) == (51, 9)
    flat = found.rig.shapes.reshape(len(found.rig.shapes), -1)
    assert np.allclose(flat @ flat.T, np.eye(len(flat)), atol=1e-8)


def test_where_frames_are_silent_the_deformation_is_transferred(rig: NeuralRig) -> None:
    """Frames that never smile leave the smile as it was carried over."""
    subject, seen = Subject.of(second_face(), "second.usda"), motion(FRAMES)
    smile = [control.name for control in rig.controls].index("smile")
    silent = seen.values.copy()
    silent[:, smile] = 0.0
    base = carried(rig, subject)
    points = base.points(silent)
    found = RetargetNeuralRig(options=RetargetOptions(noise_mm=0.1))(rig, subject, points, silent).rig
    assert np.allclose(found.points(seen.values), base.points(seen.values), atol=0.05)


def test_no_noise_is_a_choice_too(rig: NeuralRig) -> None:
    subject, seen = Subject.of(second_face(), "second.usda"), motion(replace(FRAMES, spread=10))
    found = RetargetNeuralRig(options=RetargetOptions(noise_mm=0.0))(rig, subject, seen.points, seen.values)
    assert found.report.noise_mm == 0.0


def test_noise_keeps_chance_out() -> None:
    """Of thirty inputs two move a point; twenty noisy examples don't make the others move it as much."""
    random = np.random.default_rng(0)
    inputs = random.random((20, 30))
    strengths = np.full((30, 6), 0.02)
    strengths[:2] = 1.0
    true = np.zeros((30, 6, 3))
    true[:2] = random.normal(size=(2, 6, 3))
    moved = np.tensordot(inputs, true, axes=1) + 0.05 * random.normal(size=(20, 6, 3))
    examples = Examples(inputs=inputs, vectors=np.zeros((20, 6, 3)), strengths=strengths, moved=moved)
    others = random.random((200, 30))
    errors = [
        np.abs(examples.maps(noise)(others, np.zeros((200, 6, 3))) - np.tensordot(others, true, axes=1)).mean()
        for noise in (1e-6, examples.best_noise(10.0 ** np.arange(-3.0, 1.0, 0.5)))
    ]
    assert errors[1] < 0.7 * errors[0]


@pytest.mark.slow
def test_without_controls_they_are_found(rig: NeuralRig) -> None:
    """Frames alone: each way makes the held-out ones with the controls that are best for it, and ours comes nearest."""
    subject, seen = Subject.of(second_face(), "second.usda"), motion(FRAMES)
    found = RetargetNeuralRig()(rig, subject, seen.points)
    print(found.report)
    assert found.report.controls == "found"
    assert found.report.error_mean_mm < 0.7 * min(found.report.transfer_mean_mm, found.report.copy_mean_mm)


def test_what_does_not_fit_is_reported(rig: NeuralRig) -> None:
    subject, seen = Subject.of(second_face(), "second.usda"), motion(FRAMES)
    retarget = RetargetNeuralRig()
    with pytest.raises(InputError, match=r"second\.usda: 1 frames, expected two or more"):
        retarget(rig, subject, seen.points[:1], seen.values[:1])
    with pytest.raises(TopologyError, match=r"second\.usda -> controls: shape .* expected"):
        retarget(rig, subject, seen.points, seen.values[:5])
    points, values = (np.where(array == array.max(), np.nan, array) for array in (seen.points, seen.values))
    with pytest.raises(InputError, match=r"second\.usda -> points: .*NaN"):
        retarget(rig, subject, points, seen.values)
    with pytest.raises(InputError, match=r"second\.usda -> controls: .*NaN"):
        retarget(rig, subject, seen.points, values)
    with pytest.raises(TopologyError, match="other meshes than those of the neural rig"):
        retarget(replace(rig, topology="else"), subject, seen.points, seen.values)
    with pytest.raises(TopologyError, match="other meshes than those of the neural rig"):  # not of their points
        retarget(replace(rig, topology="else"), subject, seen.points[:, 1:], seen.values)
    with pytest.raises(TopologyError, match="joints that are not those of the neural rig"):
        retarget(rig, replace(subject, bones=None), seen.points, seen.values)


def test_the_command_carries_a_rig_to_a_face(
    rig: NeuralRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = motion(FRAMES)
    save_neural_rig(rig, tmp_path / "head.fpnr", {})
    save_parts(second_face(), tmp_path / "second.usda")
    bake(seen, tmp_path / "clip.usdc")
    words = ("neural-rig", "retarget", tmp_path / "head.fpnr", tmp_path / "second.usda", "--json")
    out = done(capsys, *words, "--frames", tmp_path / "clip.usdc", "-o", tmp_path / "second.fpnr")
    printed = json.loads(out)
    assert printed["controls"] == "given"
    assert printed["between"] > 0
    assert printed["frames"] + printed["held_out"] + printed["between"] == 60
    assert printed["error_mean_mm"] < 0.7 * min(printed["copy_mean_mm"], printed["transfer_mean_mm"])
    assert off(load_neural_rig(tmp_path / "second.fpnr"), motion(OTHERS)) < 2.0 * printed["error_mean_mm"]
    bake(seen, tmp_path / "mute.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "mute.usdc"))
    for prim in stage.Traverse():
        for name in [one for one in prim.GetPropertyNames() if one.startswith("facepipe:control:")]:
            prim.RemoveProperty(name)
    stage.Save()
    files = ("--frames", tmp_path / "mute.usdc", "-o", tmp_path / "mute.fpnr")
    out = done(capsys, *words, *files, "--rounds", "1")
    assert json.loads(out)["controls"] == "found"
    failed(capsys, *words, "--frames", tmp_path / "none.usdc", "-o", tmp_path / "other.fpnr", folder=tmp_path)
    save_parts(replace(second_face(), meshes=second_face().meshes[:1]), tmp_path / "less.usda")
    words = ("neural-rig", "retarget", tmp_path / "head.fpnr", tmp_path / "less.usda")
    err = failed(capsys, *words, "--frames", tmp_path / "clip.usdc", "-o", tmp_path / "other.fpnr", folder=tmp_path)
    assert "less.usda: other meshes than those of the neural rig" in err


@pytest.mark.slow
def test_the_published_network_learns_the_subject_too(rig: NeuralRig) -> None:
    """Of four controls and many frames; the composed rig is one neural rig, orthonormal again."""
    subject, unseen = Subject.of(second_face(), "second.usda"), motion(OTHERS)
    seen = motion(replace(FRAMES, spread=200))
    options = RetargetOptions(mode="network", steps=800)
    found = RetargetNeuralRig(options=options)(rig, subject, seen.points, seen.values)
    assert off(found.rig, unseen) < 0.5 * off(carried(rig, subject), unseen)
    assert len(found.rig.hidden) > len(rig.hidden)
    flat = found.rig.shapes.reshape(len(found.rig.shapes), -1)
    assert np.allclose(flat @ flat.T, np.eye(len(flat)), atol=1e-8)


def test_noise_that_is_taken_off_leaves_what_is_likely() -> None:
    """Far-off inputs come nearer to the middle, and on average noise moves none elsewhere."""
    import torch

    from facepipe.neural.learning.deformation_network import denoised

    inputs = torch.tensor([[0.0, 3.0]], dtype=torch.float64).repeat(20000, 1)
    random = torch.Generator().manual_seed(0)
    assert torch.equal(denoised(inputs, torch.ones(2), 0.0, random), inputs)
    found = [denoised(inputs, torch.ones(2), strength, random) for strength in (0.5, 2.0)]
    for one in found:
        assert abs(float(one[:, 0].mean())) < 0.03
        assert 0.0 < float(one[:, 1].mean()) < 3.0
    assert float(found[1][:, 1].mean()) < float(found[0][:, 1].mean())
    assert float(found[0][:, 0].std()) < 0.5  # less than the noise that was added
    uneven = denoised(inputs, torch.tensor([0.01, 10.0]), 0.5, random)
    assert float(uneven[:, 0].std()) < 0.02  # all of it where nothing is so far
    assert float(uneven[:, 1].mean()) == pytest.approx(3.0, abs=0.05)


def test_bones_that_go_further_are_reported_from_few_frames(rig: NeuralRig) -> None:
    """A person who opens 1.4 times as far beside other shapes; one control that no frame moves stays as it was."""
    jaw, eye = turning_face().sliders
    jaw = replace(jaw, channels=tuple((*channel[:2], 1.4 * channel[2]) for channel in jaw.channels))
    face = replace(second_face(), sliders=(jaw, eye))
    subject = Subject.of(face, "second.usda")
    seen, unseen = (SampleMotion(options=one)(face, "second.usda") for one in (replace(FRAMES, spread=20), OTHERS))
    look = [control.name for control in rig.controls].index("look")
    still = seen.values[:, look] == 0.0
    assert still.sum() >= 8
    base, values, points = carried(rig, subject), seen.values[still], seen.points[still]
    found, bones = with_own_gains(base, values, points), slice(len(base.shapes), None)
    gains = np.linalg.norm(found.linear[:, bones], axis=1) / np.linalg.norm(base.linear[:, bones], axis=1)
    names = dict(zip((control.name for control in rig.controls), gains, strict=True))
    assert names["open"] == pytest.approx(1.4, abs=0.03)
    assert names["look"] == pytest.approx(1.0, abs=1e-9)
    assert np.array_equal(found.linear[:, : bones.start], base.linear[:, : bones.start])
    whole = RetargetNeuralRig()(rig, subject, seen.points, seen.values).rig
    assert off(whole, unseen) < 0.2 * off(base, unseen)


def test_what_points_share_is_reported_beside_what_is_their_own() -> None:
    """What all points share is found, though maps of their own do almost the same; least squares mistakes it."""
    random = np.random.default_rng(1)
    inputs, ways = random.random((15, 4)), random.normal(size=(200, 3))
    slopes = inputs[:, 0, None, None] * ways + 0.1 * random.normal(size=(15, 200, 3))
    moved = 2.0 * inputs[:, 0, None, None] * ways - 0.7 * slopes
    examples = Examples(inputs=inputs, vectors=np.zeros((15, 200, 3)), strengths=np.full((4, 200), 3.0), moved=moved)
    matrix, away = examples.normal(slopes[:, None], 0.01)
    assert float(-away[0] / matrix[0, 0]) == pytest.approx(0.7, abs=0.02)
    assert float(-(slopes * moved).sum() / np.square(slopes).sum()) < -0.7
