"""What a bone fit authors: poses and clips within limits, residual shapes, and its report."""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bone_faces import clip, face_joints, head, pose, saved, small
from faces import replace_mesh, with_meshes

import facepipe
from facepipe import registry
from facepipe.checks import validate
from facepipe.core.errors import FacepipeError, FitError, InputError, TopologyError
from facepipe.importers import load
from facepipe.parts import Animation, BoneLimits, FaceParts, Skeleton
from facepipe.rig import CHANNELS, Rig, build, rest_coefficients
from facepipe.stage import Face
from facepipe.verbs.fit_bones import (
    FitBones,
    FitBonesReport,
    LimitRules,
    Target,
    initial_coefficients,
    read_targets,
    target_fits,
)
from facepipe.verbs.fit_bones.bone_fit import BoneFit
from facepipe.verbs.fit_bones.solver import Fitted

WIDE = {"t": (-0.11, 0.11), "r": (-0.65, 0.65), "s": (0.68, 1.42)}
BUILDERS = {"small": small, "makehuman": head}
kinds = pytest.mark.parametrize("kind", BUILDERS)


@functools.cache
def rig_of(kind: str) -> Rig:
    return build(BUILDERS[kind]())


def face_limits(rig: Rig) -> LimitRules:
    """A little wider than random poses; joints that these leave at rest are locked."""
    joints = {rig.joints[number] for number in face_joints(rig)}
    return LimitRules(
        joints=tuple((joint, WIDE) for joint in rig.joints if joint in joints),
        lock=tuple(f"{joint}:*" for joint in rig.joints if joint not in joints),
    )


def target(points: np.ndarray, name: str = "goal", **more: object) -> Target:
    return Target(name=name, points=points if points.ndim == 3 else points[None], **more)  # type: ignore[arg-type]


def fitted(parts: FaceParts, fit: FitBones, *targets: Target) -> tuple[Face, FitBonesReport]:
    """The result on a stage of its own."""
    face = Face.from_parts(parts)
    report = fit(face, targets)
    return Face(face.stage), report


def animation(face: Face, name: str) -> Animation:
    return next(one for one in face.animations if one.name == name)


def played(face: Face, name: str, frame: int = 0) -> np.ndarray:
    transforms, weights = face.sample(name, frame)
    return face.evaluate(weights, joint_transforms=transforms)


def off_mm(face: Face, name: str, goal: Target) -> float:
    """The largest distance of any point over all frames, as the stage gives it back."""
    frames = range(len(goal.points))
    return (
        max(float(np.linalg.norm(played(face, name, t) - goal.points[t], axis=1).max()) for t in frames)
        * face.mm_per_unit
    )


# --- known poses


@kinds
def test_known_poses_are_found_and_come_back_from_the_file(kind: str, tmp_path: Path) -> None:
    rig, file = rig_of(kind), saved(BUILDERS[kind](), tmp_path / "rig.usda")
    before, face = file.read_bytes(), facepipe.open(file)
    goals = [target(rig.evaluate(coefficients=pose(rig, seed)), f"p{seed}") for seed in range(2)]
    with face.deriving(tmp_path / "out.usda") as result:
        start = time.perf_counter()
        report = FitBones(threshold_mm=0.01, limits=face_limits(rig))(result, goals)
        assert 0.0 <= report.seconds <= time.perf_counter() - start
    assert file.read_bytes() == before
    again = facepipe.open(tmp_path / "out.usda")
    for goal in goals:
        one = report.targets[goal.name]
        assert one.reached
        assert one.distances.max_mm <= 0.01 < one.before.max_mm
        assert one.residual is None
        assert off_mm(again, goal.name, goal) == pytest.approx(one.distances.max_mm, abs=1e-9)
    assert report.missed == ()
    assert report.warnings == ()
    assert [finding for finding in validate(tmp_path / "out.usda") if finding.severity != "info"] == []


@kinds
def test_coefficients_stay_within_limits_to_the_bit(kind: str) -> None:
    """Limits too narrow for the pose: many coefficients end on them."""
    rig = rig_of(kind)
    narrow = LimitRules(joints=(("*", {"t": (-0.03, 0.03), "r": (-0.1, 0.1), "s": (0.9, 1.1)}),))
    goal = target(rig.evaluate(coefficients=pose(rig, 5)))
    face, report = fitted(BUILDERS[kind](), FitBones(limits=narrow, rounds=0, max_iterations=20), goal)
    values = animation(face, "goal").coefficients
    assert values is not None
    assert values.shape == (1, len(rig.joints), 9)
    low = np.repeat([-0.03, -0.1, 0.9], 3)
    high = np.repeat([0.03, 0.1, 1.1], 3)
    stored = values[0].astype(np.float64)
    assert (stored >= low).all()
    assert (stored <= high).all()
    one = report.targets["goal"]
    assert not one.reached
    assert one.distances.max_mm < one.before.max_mm
    lower, upper = narrow.resolve(rig.joints, 1.0)
    stopped = {f"{rig.joints[j]}:{CHANNELS[c]}" for j, c in np.argwhere((stored == lower) | (stored == upper))}
    assert set(one.at_limits) == stopped
    assert stopped


def test_limits_of_the_rig_count_and_those_that_exclude_rest_hold() -> None:
    rig = rig_of("small")
    lower, upper = np.full((3, 9), -1.0), np.full((3, 9), 2.0)
    lower[1, 3], upper[1, 3] = 0.25, 0.5  # rx of the jaw can't be 0
    lower[:, 6:] = 0.5
    parts = replace(small(), bone_limits=BoneLimits(lower=lower, upper=upper))
    face, report = fitted(parts, FitBones(rounds=0), target(rig.evaluate()))
    values = animation(face, "goal").coefficients
    assert values is not None
    assert values[0, 1, 3] == 0.25
    assert "root/jaw:rx" in report.targets["goal"].at_limits
    assert (values[0] >= lower).all()
    free, found = fitted(
        small(),
        FitBones(limits=LimitRules(joints=(("jaw", {"rx": (0.25, 0.5)}),), lock=("lip:*",))),
        target(rig.evaluate()),
    )
    own = animation(free, "goal").coefficients
    assert own is not None
    assert 0.25 <= own[0, 1, 3] <= 0.5
    np.testing.assert_array_equal(own[0, 2], rest_coefficients(1)[0])
    assert not any(word.startswith("root/jaw/lip:") for word in found.targets["goal"].at_limits)


def test_fits_start_from_initial_coefficients_and_bytes_repeat(tmp_path: Path) -> None:
    rig = rig_of("small")
    truth = pose(rig, 7)
    goal = target(rig.evaluate(coefficients=truth))
    cold = fitted(small(), FitBones(threshold_mm=0.01), goal)[1].targets["goal"]
    warm = fitted(small(), FitBones(threshold_mm=0.01, initial=truth), goal)[1].targets["goal"]
    assert warm.steps == 0 < cold.steps
    file = saved(small(), tmp_path / "rig.usda")
    for name in ("a.usda", "b.usda"):
        with facepipe.open(file).deriving(tmp_path / name) as face:
            FitBones(residual=True, rounds=0, max_iterations=3)(face, [goal])
    assert (tmp_path / "a.usda").read_bytes() == (tmp_path / "b.usda").read_bytes()


def test_initial_coefficients_of_animations_with_and_without_them() -> None:
    rig = rig_of("small")
    exact = Animation(name="exact", joints=rig.joints[1:], coefficients=pose(rig, 2)[None, 1:])
    face = Face.from_parts(
        replace(small(), animations=(exact, replace(clip(rig), coefficients=None, joints=(), times=None)))
    )
    expected = pose(rig, 2)
    expected[0] = rest_coefficients(1)
    np.testing.assert_allclose(initial_coefficients(face, "exact"), expected, atol=1e-6)
    np.testing.assert_allclose(initial_coefficients(face, "talk"), rest_coefficients(3), atol=1e-9)
    with pytest.raises(InputError, match="initial frown: no such animation, expected one of exact, talk"):
        initial_coefficients(face, "frown")


# --- clips


@kinds
def test_clips_are_fitted_frame_after_frame(kind: str) -> None:
    """Each frame starts from the one before: one that is the same takes no step. Times stay."""
    rig = rig_of(kind)
    talk = clip(rig)
    assert talk.coefficients is not None
    assert talk.times is not None
    frames = np.stack([rig.evaluate(coefficients=coefficient) for coefficient in talk.coefficients])
    fit = FitBones(threshold_mm=0.01, limits=face_limits(rig))
    done: list[None] = []
    face = Face.from_parts(BUILDERS[kind]())
    report = fit(face, [target(frames, times=talk.times)], done=lambda: done.append(None))
    face = Face(face.stage)
    one = report.targets["goal"]
    assert (one.frames, one.reached, len(done)) == (5, True, 5)
    found = animation(face, "goal")
    assert found.times is not None
    np.testing.assert_allclose(found.times, talk.times, atol=1e-9)
    assert off_mm(face, "goal", target(frames, times=talk.times)) <= 0.01
    still = target(np.repeat(frames[-1:], 3, axis=0), times=np.arange(3.0))
    single, thrice = (
        fitted(BUILDERS[kind](), fit, one)[1].targets["goal"].steps for one in (target(frames[-1]), still)
    )
    assert single == thrice > 0


# --- residual

MAKEHUMAN_TARGETS = ("nose/nose-hump-incr", "mouth/mouth-scale-horiz-incr", "chin/chin-width-incr")


@pytest.mark.parametrize(
    "name", [MAKEHUMAN_TARGETS[0], *(pytest.param(one, marks=pytest.mark.slow) for one in MAKEHUMAN_TARGETS[1:])]
)
def test_the_residual_brings_shapes_that_bones_miss_within_the_threshold(name: str, tmp_path: Path) -> None:
    face = facepipe.open(saved(head(), tmp_path / "rig.usdc"))
    file = saved(head(((name, 1.0),)), tmp_path / "shape.usdc")
    (goal,) = read_targets(face, [str(file)])
    with face.deriving(tmp_path / "out.usda") as result:
        report = FitBones(residual=True, max_iterations=8)(result, [goal])
    one = report.targets["shape"]
    assert one.residual is not None
    assert one.reached
    assert one.distances.max_mm > 1.0
    again = facepipe.open(tmp_path / "out.usda")
    assert off_mm(again, "shape", goal) == pytest.approx(one.residual.distances.max_mm, abs=1e-9)
    assert off_mm(again, "shape", goal) <= 0.1
    check_sparse(again, "shape", goal)
    assert [finding for finding in validate(tmp_path / "out.usda") if finding.severity != "info"] == []


def check_sparse(face: Face, name: str, goal: Target, threshold_mm: float = 0.1) -> None:
    """Exactly the points that bones leave further off than the threshold, or all but, have offsets."""
    bones = face.evaluate(joint_transforms=face.sample(name)[0])
    off = np.linalg.norm(bones - goal.points[0], axis=1) * face.mm_per_unit
    moved, start = np.zeros(len(off), dtype=bool), 0
    for mesh in face.meshes:
        for shape in mesh.blendshapes:
            if shape.name == f"{name}_residual":
                moved[shape.point_indices + start] = True
        start += len(mesh.points)
    np.testing.assert_array_equal(moved, off > 0.99 * threshold_mm)
    assert moved.any()


def test_residuals_of_poses_with_shear_scale_and_loose_meshes(tmp_path: Path) -> None:
    """Mesh spaces of their own; the world difference goes back through scaled and sheared bones."""
    space = np.array([[0.0, -2.0, 0, 1], [0.5, 0, 0, 2], [0, 0, 3.0, -1], [0, 0, 0, 1]])
    back = np.linalg.inv(space)
    meshes = []
    for mesh in small().meshes:
        points = mesh.points @ back[:3, :3].T + back[:3, 3]
        skin = replace(mesh.skin, geom_bind_transform=space) if mesh.skin else None
        meshes.append(replace_mesh(mesh, points=points, skin=skin, transform=space, blendshapes=()))
    parts = replace(small(), meshes=tuple(meshes))
    rig, rng = build(parts), np.random.default_rng(0)
    goal = target(rig.evaluate(coefficients=pose(rig, 4)) + rng.normal(0, 0.2, (45, 3)))
    face, report = fitted(parts, FitBones(residual=True, threshold_mm=0.5), goal)
    assert report.targets["goal"].reached
    assert off_mm(face, "goal", goal) <= 0.5
    check_sparse(face, "goal", goal, 0.5)


def test_points_that_follow_no_joint_are_reported_where_a_residual_can_not_move_them() -> None:
    skin = small().meshes[0].skin
    assert skin is not None
    weights = np.array(skin.joint_weights)
    weights[:10] = 0.0
    head_mesh = replace_mesh(small().meshes[0], skin=replace(skin, joint_weights=weights))
    parts = replace(small(), meshes=(head_mesh, small().meshes[1]))
    locked = LimitRules(lock=("*:*",))
    goal = target(build(small()).evaluate())  # the other points are there already
    face, report = fitted(parts, FitBones(residual=True, limits=locked), goal)
    one = report.targets["goal"]
    assert "goal: 10 points are squashed flat by their bones, the residual can't move them" in report.warnings
    assert (one.reached, face.shapes) == (False, Face.from_parts(parts).shapes)
    assert one.residual is not None
    assert one.residual.shapes == 0


def test_clips_get_a_residual_for_each_frame_that_needs_one() -> None:
    rig, rng = rig_of("small"), np.random.default_rng(1)
    frames = np.stack([rig.evaluate(coefficients=pose(rig, 1, share)) for share in (0.0, 0.5, 1.0)])
    frames[1:] += rng.normal(0, 0.1, (2, 45, 3))
    goal = target(frames, times=np.array([0.0, 0.5, 1.0]))
    face, report = fitted(small(), FitBones(residual=True), goal)
    one = report.targets["goal"]
    assert one.residual is not None
    assert (one.reached, one.residual.shapes) == (True, 2)
    found = animation(face, "goal")
    assert found.shapes == ("goal_residual_2", "goal_residual_3")
    np.testing.assert_array_equal(found.shape_weights, [[0, 0], [1, 0], [0, 1]])
    assert off_mm(face, "goal", goal) <= 0.1


def test_reached_targets_get_no_residual() -> None:
    rig = rig_of("small")
    face, report = fitted(small(), FitBones(residual=True), target(rig.evaluate(coefficients=pose(rig, 1))))
    one = report.targets["goal"].residual
    assert one is not None
    assert (one.shapes, one.points) == (0, 0)
    assert face.shapes == Face.from_parts(small()).shapes


def test_poses_are_fitted_a_few_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(target_fits, "_TOGETHER", 2)
    fit_all, counts = BoneFit.fit_all, []

    def counted(fit: BoneFit, targets: Sequence[np.ndarray], start: np.ndarray) -> list[Fitted]:
        counts.append(len(targets))
        return fit_all(fit, targets, start)

    monkeypatch.setattr(BoneFit, "fit_all", counted)
    points = rig_of("small").evaluate()
    fitted(small(), FitBones(), *(target(points, f"p{number}") for number in range(5)))
    assert counts == [2, 2, 1]


def test_names_that_are_taken_get_numbers() -> None:
    talk = clip(rig_of("small"))
    parts = replace(small(), animations=(talk,))
    goals = [target(rig_of("small").evaluate() + 0.3, name) for name in ("talk", "jawOpen")]
    named = replace_mesh(
        small().meshes[0],
        blendshapes=tuple(
            replace(blendshape, name="talk_2_residual") if blendshape.name == "mouthSmileLeft" else blendshape
            for blendshape in small().meshes[0].blendshapes
        ),
    )
    parts = replace(parts, meshes=(named, small().meshes[1]))
    locked = LimitRules(lock=("*:*",))
    face, report = fitted(parts, FitBones(residual=True, limits=locked), *goals)
    assert list(report.targets) == ["talk_2", "jawOpen"]
    assert [one.name for one in face.animations] == ["talk", "talk_2", "jawOpen"]
    assert animation(face, "talk_2").shapes == ("talk_2_residual_2",)
    assert report.free == 0
    for goal, name in zip(goals, report.targets, strict=True):
        assert off_mm(face, name, goal) <= 0.1


# --- points that count


def test_points_that_do_not_count_change_nothing_and_get_no_residual() -> None:
    """Nonsense in a region of weight 0, and in meshes that the target lacks."""
    rig = rig_of("small")
    mesh = replace_mesh(
        small().meshes[0],
        regions={"neck": (np.arange(36) < 12).astype(np.float32), "mouth": (np.arange(36) >= 12).astype(np.float32)},
    )
    parts = replace(small(), meshes=(mesh, small().meshes[1]))
    points = rig.evaluate(coefficients=pose(rig, 6))
    points[:12] += 5.0
    points[36:] += 7.0
    known = np.arange(45) < 36
    fit = FitBones(regions={"neck": 0.0}, residual=True, threshold_mm=0.01)
    face, report = fitted(parts, fit, target(points, known=known))
    one = report.targets["goal"]
    assert one.reached
    assert one.distances.points == 24
    assert one.distances.max_mm <= 0.01
    assert one.regions["neck"].max_mm > 10.0
    assert one.regions["mouth"].max_mm <= 0.01
    assert one.residual is not None
    assert one.residual.points == 0
    np.testing.assert_allclose(played(face, "goal")[12:36], points[12:36], atol=1e-3)


def test_heavier_regions_come_nearer() -> None:
    rig, rng = rig_of("small"), np.random.default_rng(2)
    goal = target(rig.evaluate() + rng.normal(0, 0.3, (45, 3)))
    lips = [3, 5]

    def off(**options: object) -> float:
        face, _ = fitted(small(), FitBones(rounds=0, **options), goal)  # type: ignore[arg-type]
        return float(np.linalg.norm(played(face, "goal") - goal.points[0], axis=1)[lips].max())

    plain, heavy, alone = off(), off(regions={"lips": 1000.0}), off(mask=["lips"])
    assert heavy < 0.2 * plain
    assert alone <= 0.01  # the threshold, in units


def test_joints_that_move_nothing_stay_at_rest_and_are_named() -> None:
    skin = small().meshes[0].skin
    assert skin is not None
    weights = np.asarray(skin.joint_weights).copy()
    weights[:, 2] = 0.0
    weights /= weights.sum(axis=1, keepdims=True)
    parts = replace(
        small(), meshes=(replace_mesh(small().meshes[0], skin=replace(skin, joint_weights=weights)), small().meshes[1])
    )
    rig = build(parts)
    face, report = fitted(parts, FitBones(), target(rig.evaluate(coefficients=pose(rig, 1))))
    assert report.weightless == ("root/jaw/lip",)
    assert report.free == 2
    values = animation(face, "goal").coefficients
    assert values is not None
    np.testing.assert_array_equal(values[0, 2], rest_coefficients(1)[0])


# --- what can't be fitted


def with_bind(matrix: np.ndarray) -> FaceParts:
    bind = np.array(small().skeleton.bind_transforms)
    bind[1] = matrix
    return replace(small(), skeleton=replace(small().skeleton, bind_transforms=bind))


def unskinned(**changes: object) -> FaceParts:
    return replace(with_meshes(small(), skin=None), **changes)  # type: ignore[arg-type]


NEARLY_FLAT = np.eye(4)
NEARLY_FLAT[:2, :2] = [[1, 1], [1, 1 + 1e-14]]
UNFIT = {
    "no joints": (lambda: unskinned(skeleton=Skeleton()), InputError, "has no joints, expected a skinned face"),
    "no weights": (unskinned, InputError, "no point follows a joint"),
    "singular bind": (lambda: with_bind(np.diag([1.0, 1.0, 0.0, 1.0])), TopologyError, "root/jaw: singular matrix"),
    "nearly singular bind": (lambda: with_bind(NEARLY_FLAT), TopologyError, "root/jaw: singular"),
}


@pytest.mark.parametrize("kind", UNFIT)
def test_rigs_that_can_not_be_fitted_say_why_and_nothing_is_authored(kind: str) -> None:
    make, error, message = UNFIT[kind]
    face = Face.from_parts(make())
    before = face.stage.GetRootLayer().ExportToString()
    with pytest.raises(error, match=message):
        FitBones()(face, [target(np.zeros((45, 3)))])
    assert face.stage.GetRootLayer().ExportToString() == before


@pytest.mark.parametrize(
    ("fit", "goal", "message"),
    [
        (FitBones(), np.zeros((44, 3)), "target goal: 44 points, expected 45"),
        (FitBones(initial=np.zeros((2, 9))), np.zeros((45, 3)), r"initial: coefficients \(2, 9\), expected \(3, 9\)"),
        (FitBones(initial=np.full((3, 9), np.nan)), np.zeros((45, 3)), "initial: coefficients"),
        (FitBones(limits=LimitRules(lock=("chin:*",))), np.zeros((45, 3)), "lock -> chin:.*matches none of 3"),
        (FitBones(regions={"nose": 1.0}), np.zeros((45, 3)), "region nose: no such region"),
    ],
)
def test_options_that_do_not_fit_the_face(fit: FitBones, goal: np.ndarray, message: str) -> None:
    face = Face.from_parts(small())
    before = face.stage.GetRootLayer().ExportToString()
    with pytest.raises(InputError, match=message):
        fit(face, [target(goal)])
    with pytest.raises(InputError, match="targets: none given"):
        FitBones()(face, [])
    with pytest.raises(InputError, match="knows no point that counts"):
        FitBones()(face, [target(np.zeros((45, 3)), known=np.zeros(45, bool))])
    assert face.stage.GetRootLayer().ExportToString() == before


@pytest.mark.parametrize(
    "options", [{"threshold_mm": 0.0}, {"threshold_mm": np.nan}, {"max_iterations": 0}, {"rounds": -1}]
)
def test_numbers_out_of_range(options: dict[str, float]) -> None:
    with pytest.raises(InputError, match=f"option {next(iter(options))}"):
        FitBones(**options)  # type: ignore[arg-type]


def test_limits_that_let_a_joint_vanish() -> None:
    flat = LimitRules(joints=(("root", {"s": (0, 0)}),))
    with pytest.raises(FitError, match=r"Tiny -> goal: the scale of a joint fell to 0, expected limits"):
        fitted(small(), FitBones(limits=flat), target(np.ones((45, 3))))


def test_shear_is_reported_and_the_coefficients_hold_it() -> None:
    rest = np.array(small().skeleton.rest_transforms)
    rest[1, :3, :3] = rest[1, :3, :3] @ np.diag([1.0, 2.0, 1.0])
    bind = np.array(small().skeleton.bind_transforms)
    bind[1] = bind[0] @ rest[1]
    bind[2] = bind[1] @ rest[2]
    parts = replace(small(), skeleton=replace(small().skeleton, rest_transforms=rest, bind_transforms=bind))
    rig = build(parts)
    goal = target(rig.evaluate(coefficients=pose(rig, 1)))
    face, report = fitted(parts, FitBones(threshold_mm=0.01), goal)
    assert report.targets["goal"].reached
    assert report.warnings[0].startswith("rest scale of root/jaw differs by direction")
    assert report.warnings[1].startswith("goal: SkelAnimation can't hold the shear of root/jaw")
    assert off_mm(face, "goal", goal) <= 0.01


# --- what comes after


def test_exports_carry_the_fitted_poses(tmp_path: Path) -> None:
    rig = rig_of("small")
    talk = clip(rig)
    assert talk.coefficients is not None
    frames = np.stack([rig.evaluate(coefficients=coefficient) for coefficient in talk.coefficients])
    file = saved(small(), tmp_path / "rig.usda")
    with facepipe.open(file).deriving(tmp_path / "out.usda") as face:
        goals = [
            target(frames, "clip", times=talk.times),
            target(frames[-1] + np.linspace(0, 0.3, 45)[:, None], "pose"),
        ]
        FitBones(residual=True)(face, goals)
    exporter = registry.exporter("out.glb")
    exporter.export(
        facepipe.open(tmp_path / "out.usda"), tmp_path / "out.glb", exporter.Options(animations=True, influences=8)
    )
    assert [finding for finding in exporter.validate(tmp_path / "out.glb") if finding.severity == "error"] == []
    back = Face.from_parts(load("gltf", tmp_path / "out.glb").parts)
    assert [one.name for one in back.animations] == ["clip", "pose"]
    unit = back.mm_per_unit / 10.0
    for name, frame, goal in (("clip", 4, frames[4]), ("pose", 0, goals[1].points[0])):
        off = np.linalg.norm(played(back, name, frame) * unit - goal, axis=1).max() * 10.0
        assert off <= 0.11  # mm: the threshold, and float32
    author_again(tmp_path / "out.usda")


def author_again(file: Path) -> None:
    """A result is a rig as any other."""
    face = facepipe.open(file)
    (goal,) = read_targets(face, ["pose"])
    with face.deriving(file.with_name("again.usda")) as result:
        report = FitBones(residual=True)(result, [goal])
    assert list(report.targets) == ["pose_2"]
    assert report.targets["pose_2"].reached
    with pytest.raises(FacepipeError, match="is the input itself"), face.deriving(file) as result:
        FitBones()(result, [goal])
