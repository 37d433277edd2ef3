"""Fits of many targets at once, what a viewer shows of a fit, and poses that SkelAnimation holds."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bone_faces import clip, head, pose, saved, small
from oracle import difference, played
from places import REPOSITORY

import facepipe
from facepipe.core.errors import FitError
from facepipe.parts import FaceParts
from facepipe.rig import Rig, build, rest_coefficients
from facepipe.stage import Face
from facepipe.stage.face import play
from facepipe.verbs.fit_bones import FitBones, FitBonesReport, LimitRules, Target, read_limits, read_targets
from facepipe.verbs.fit_bones.bone_fit import BoneFit
from facepipe.verbs.fit_bones.target_fits import half_scaled, with_half_scales

FACE_BONES = REPOSITORY / "docs" / "face_bones.json"


@functools.cache
def rig() -> Rig:
    return build(small())


def goal(seed: int, known: np.ndarray | None = None) -> Target:
    return Target(name=f"p{seed}", points=rig().evaluate(coefficients=pose(rig(), seed, 0.3))[None], known=known)


def talk() -> Target:
    """A clip."""
    own = clip(rig())
    assert own.coefficients is not None
    points = np.stack([rig().evaluate(coefficients=coefficient) for coefficient in own.coefficients])
    return Target(name="talk", points=points, times=own.times)


def fitted(fit: FitBones, *targets: Target, parts: FaceParts | None = None) -> tuple[Face, FitBonesReport, int]:
    """The result, the report, and how often progress was reported."""
    face, done = Face.from_parts(parts or small()), []
    report = fit(face, targets, done=lambda: done.append(None))
    return Face(face.stage), report, len(done)


def coefficients(face: Face, name: str) -> np.ndarray:
    found = next(animation.coefficients for animation in face.animations if animation.name == name)
    assert found is not None
    return found


# --- together


def test_targets_of_all_kinds_stay_in_their_order_and_each_is_as_if_alone() -> None:
    """Poses of two sessions with a clip among them, more than are fitted at a time."""
    part = np.arange(45) < 36
    targets = [goal(seed, part if seed % 3 == 1 else None) for seed in range(70)]
    targets.insert(40, talk())
    fit = FitBones(threshold_mm=0.01)
    face, report, done = fitted(fit, *targets)
    assert list(report.targets) == [one.name for one in targets] == [animation.name for animation in face.animations]
    assert (report.missed, done) == ((), 75)
    for number in (0, 1, 39, 40, 41, 69):
        target = targets[number]
        alone, single, _ = fitted(fit, target)
        one, other = report.targets[target.name], single.targets[target.name]
        assert (one.steps, one.frames) == (other.steps, other.frames)
        assert one.distances.points == (36 if target.known is not None else 45)
        np.testing.assert_allclose(coefficients(face, target.name), coefficients(alone, target.name), atol=1e-5)


def test_of_many_targets_the_one_that_shrinks_a_joint_is_named() -> None:
    limits = LimitRules(joints=(("root", {"s": (0.0, 1.0)}),), lock=("jaw:*", "lip:*"))
    flat = Target(name="flat", points=np.tile(rig().evaluate().mean(axis=0), (1, 45, 1)))
    still = Target(name="still", points=rig().evaluate()[None])
    assert fitted(FitBones(limits=limits), still)[1].missed == ()
    with pytest.raises(FitError, match=r"Tiny -> flat: the scale of a joint fell to 0"):
        fitted(FitBones(limits=limits), still, flat, replace(still, name="again"))


# --- what a viewer shows


@pytest.mark.parametrize("residual", [False, True], ids=["bones", "residual"])
def test_a_viewer_shows_a_single_target(residual: bool, tmp_path: Path) -> None:
    """UsdSkel on the file as it is, residual and all."""
    face = facepipe.open(saved(small(), tmp_path / "rig.usda"))
    target = read_targets(face, ["jawOpen"])[0] if residual else goal(1)
    with face.deriving(tmp_path / "out.usda") as result:
        report = FitBones(residual=residual)(result, [target])
    shown = played(tmp_path / "out.usda")[0]
    assert (report.targets[target.name].residual is not None) == residual
    off = np.linalg.norm(shown - target.points[0], axis=1).max() * face.mm_per_unit
    assert off <= 0.1 + (0 if residual else 0.05)  # without a residual scales are as they come: not half precision
    assert difference(face, shown, face.evaluate()) > 0.01
    np.testing.assert_array_equal(facepipe.open(tmp_path / "out.usda").evaluate(), face.evaluate())


def test_a_viewer_shows_a_clip_over_time(tmp_path: Path) -> None:
    face, target = facepipe.open(saved(small(), tmp_path / "rig.usda")), talk()
    rough = replace(target, points=target.points + np.random.default_rng(0).normal(0, 0.1, target.points.shape))
    assert rough.times is not None
    with face.deriving(tmp_path / "out.usda") as result:
        FitBones(residual=True, max_iterations=10)(result, [rough])
    off = np.linalg.norm(played(tmp_path / "out.usda", list(rough.times)) - rough.points, axis=2).max()
    assert off * face.mm_per_unit <= 0.1


def test_of_several_targets_none_is_shown(tmp_path: Path) -> None:
    """What the skeleton plays stays."""
    face = facepipe.open(saved(small(), tmp_path / "rig.usda"))
    with face.deriving(tmp_path / "out.usda") as result:
        FitBones()(result, [goal(1), goal(2)])
    assert difference(face, played(tmp_path / "out.usda")[0], face.evaluate()) < 1e-6
    with face.deriving(tmp_path / "talk.usda") as result:
        FitBones()(result, [talk()])
    own = facepipe.open(tmp_path / "talk.usda")
    with own.deriving(tmp_path / "more.usda") as result:
        FitBones()(result, [goal(1), goal(2)])
    one, other = (played(tmp_path / name, [0.4]) for name in ("talk.usda", "more.usda"))
    np.testing.assert_array_equal(one, other)
    play(own, "talk")


# --- half precision


def nose(name: str) -> tuple[FaceParts, Target]:
    """MakeHuman and a shape that its bones don't reach."""
    points = build(head(((f"nose/{name}", 1.0),))).evaluate()
    return head(), Target(name="nose", points=points[None])


def off(rig: Rig, values: np.ndarray, target: Target, threshold: float) -> int:
    return int((np.linalg.norm(rig.evaluate(coefficients=values) - target.points[0], axis=1) > threshold).sum())


@pytest.mark.parametrize("name", [pytest.param("nose-hump-incr", marks=pytest.mark.slow), "nose-base-up"])
def test_half_scales_hardly_cost_points(name: str) -> None:
    """Of those that plain rounding adds to the residual of least squares, at most a fifth."""
    parts, target = nose(name)
    rig, limits = build(parts), read_limits(FACE_BONES)
    lower, upper = limits.resolve(rig.joints, parts.meters_per_unit)
    exact = coefficients(fitted(FitBones(limits=limits, rounds=0), target, parts=parts)[0], "nose")[0]
    threshold = 0.099 / (1000 * parts.meters_per_unit)
    plain = with_half_scales(rig, exact, lower, upper)
    face, report, _ = fitted(FitBones(limits=limits, residual=True), target, parts=parts)
    one, found = report.targets["nose"].residual, coefficients(face, "nose")[0]
    assert one is not None
    least, most = (off(rig, values, target, threshold) for values in (exact, plain))
    assert one.points == off(face.rig(), found, target, threshold)
    assert most > least + 100
    assert one.points - least <= 0.2 * (most - least)
    assert ((lower <= found) & (found <= upper)).all()
    sizes = np.linalg.norm(rig.local_transforms(found)[:, :3, :3], axis=1)
    np.testing.assert_allclose(sizes, sizes.astype(np.float16), rtol=3e-7)


@pytest.mark.parametrize("seed", range(4))
def test_half_scales_keep_to_limits_and_to_locked_channels(seed: int) -> None:
    """Narrow limits, channels at their limits, joints that are locked or hold still."""
    own, rng = rig(), np.random.default_rng(seed)
    values = pose(own, seed).astype(np.float32).astype(np.float64)
    width = rng.uniform(0, 3e-3, values.shape)
    width[rng.random(values.shape) < 0.3] = 0.0
    lower, upper = ((values + side * width).astype(np.float32).astype(np.float64) for side in (-1, 1))
    at = rng.random(values.shape) < 0.3
    values[at] = upper[at]
    session = BoneFit(own, lower=lower, upper=upper, threshold=1e-3)
    found = half_scaled(session, values, own.evaluate(coefficients=values))
    np.testing.assert_array_equal(found, found.astype(np.float32))
    assert ((lower <= found) & (found <= upper)).all()
    roomy = (upper - lower)[:, 6:] > 2.0**-8
    sizes = np.linalg.norm(own.local_transforms(found)[:, :3, :3], axis=1)
    np.testing.assert_allclose(sizes[roomy], sizes[roomy].astype(np.float16), rtol=3e-7)


def test_what_rests_in_a_sparse_fit_rests_in_half_precision_too() -> None:
    parts, target = nose("nose-hump-incr")
    fit = FitBones(limits=read_limits(FACE_BONES), sparsity=3.0, rounds=0)
    bones = coefficients(fitted(fit, target, parts=parts)[0], "nose")[0]
    whole = coefficients(fitted(replace(fit, residual=True), target, parts=parts)[0], "nose")[0]
    rest = rest_coefficients(len(bones))
    still = bones == rest
    assert 0 < (~still).sum() < 100
    np.testing.assert_array_equal(whole[still], rest[still])
    assert (whole != bones).any()
