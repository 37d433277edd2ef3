"""Stage one of photo fits: the landmarks of a posed face, and sliders, expressions and cameras from landmarks alone."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from faces import tiny_face
from recovery_landmarks import FaceLandmarks
from recovery_looks import Pose, camera_of
from recovery_targets import posed, random_sliders
from small_head import make
from with_torch import tensor, torch

from facepipe import heads
from facepipe.core.errors import InputError
from facepipe.parts import FaceParts, Slider, SliderNetwork
from facepipe.photo.descent.landmark_fit import LandmarkFit, Priors, State
from facepipe.photo.descent.landmark_rig import CONTOUR, LandmarkRig, front_axes, landmark_points
from facepipe.photo.descent.subject import FOCAL, PoseSpace, Subject
from facepipe.photo.renderer.camera import Camera
from facepipe.pictures import camera as render_camera
from facepipe.rig import slide

pytestmark = pytest.mark.needs_torch

SIZE = 256.0
INNER = slice(CONTOUR.stop, 68)
EYE = "root/neck/head/eyeLeft"  # moves no landmark
EXACT = Priors(landmark_sigma=1e-3, slider_sigma=3.0, expression_sparsity=0.1)


@cache
def sample() -> FaceParts:
    return make(0)


@cache
def subject() -> Subject:
    return Subject.of(sample())


def space_of(own: Subject) -> PoseSpace:
    """A square photo of `SIZE` pixels."""
    points, _ = landmark_points(own.parts)
    axes = np.stack(front_axes(own.parts, own.rig), axis=1)
    world = own.rig.points @ own.rig.parent_world[:3, :3].T + own.rig.parent_world[:3, 3]
    return PoseSpace(
        middle=world[points].mean(axis=0), size=float(np.ptp(axes[:, 1])), center=(SIZE / 2, SIZE / 2), side=SIZE
    )


def turned(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> Pose:
    """A portrait lens before a head that fills most of a picture; angles in degrees."""
    yaw, pitch, roll = np.radians((yaw, pitch, roll))
    return Pose(yaw=yaw, pitch=pitch, roll=roll, lens_mm=70.0, share=0.7, place=(0.3, -0.2))


@cache
def whole() -> Subject:
    """The head with all its triangles."""
    return Subject.of(heads.make(controls="bones"))


def seen(
    values: Mapping[str, float], pose: Pose, own: Subject | None = None
) -> tuple[np.ndarray, render_camera.Camera]:
    """World points of a face, if no other of the sample, with these sliders, and a camera before them."""
    own = own or subject()
    points = posed(own.parts, own.rig, values, {})
    return points, camera_of(pose, points, int(SIZE))


def torch_camera(camera: render_camera.Camera) -> Camera:
    return Camera.at(camera.axes, camera.eye, camera.focal, camera.center, dtype=torch.float64)


def found(
    rig: LandmarkRig, values: Mapping[str, float], camera: Camera, own: Subject | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks (68, 2) and directions across the contour (17, 2) of a face with sliders."""
    sliders = tensor([values.get(slider.name, slider.default) for slider in (own or subject()).parts.sliders])
    marks, outward = rig.landmarks(rig.rig(sliders), camera)
    return marks.numpy(), outward.numpy()


def some_state(fit: LandmarkFit, seed: int, views: int = 1, reach: float = 0.6) -> State:
    """Sliders all over their ranges, a few expressions, cameras near a portrait's."""
    rng = np.random.default_rng(seed)
    own = fit.subject
    shares = own.default_shares + reach * rng.uniform(-0.5, 0.5, len(own.sliders))
    expressions = np.zeros((views, len(own.expressions)))
    names = [own.rig.shapes[i] for i in own.expressions]
    for row, shape in itertools.product(expressions, ("jawOpen", "mouthSmileLeft", "mouthSmileRight")):
        if shape in names:
            row[names.index(shape)] = rng.uniform(0.2, 0.6)
    poses = np.zeros((views, 7))
    poses[:, :3] = rng.uniform(-1, 1, (views, 3)) * (0.15, 0.35, 0.1)
    poses[:, 3:5] = rng.uniform(0.45, 0.55, (views, 2))
    poses[:, 5] = np.log(0.7) + rng.uniform(-0.1, 0.1, views)
    poses[:, 6] = np.log(FOCAL) - poses[:, 5] + rng.uniform(-0.1, 0.1, views)
    return State(shares=shares.clip(0, 1), expressions=expressions, poses=poses)


def problem(own: Subject, targets: Sequence[np.ndarray], priors: Priors = EXACT) -> LandmarkFit:
    return LandmarkFit(own, targets, [space_of(own)] * len(targets), priors)


def known(own: Subject, seed: int, views: int = 1, priors: Priors = EXACT) -> tuple[State, LandmarkFit]:
    """A state, and the problem to find it again from its exact landmarks."""
    blank = problem(own, [np.zeros((68, 2))] * views, priors)
    truth = some_state(blank, seed, views)
    return truth, problem(own, list(blank.landmarks(truth)), priors)


# The landmarks of a posed face


def test_landmarks_are_points_of_the_rig() -> None:
    """Bones, sliders, expressions and camera at once, against facepipe.rig and the renderer's camera."""
    own, rng = subject(), np.random.default_rng(4)
    rig, points = LandmarkRig.from_subject(own), landmark_points(sample())[0]
    for _ in range(3):
        values = random_sliders(sample(), rng)
        weights = rng.uniform(0, 1, len(own.rig.shapes)) * (rng.random(len(own.rig.shapes)) < 0.2)
        coefficients, driven = slide(sample().sliders, own.rig.joints, values)
        expected = own.rig.evaluate(own.rig.weight_vector(driven) + weights, coefficients=coefficients)
        sliders = tensor([values[slider.name] for slider in sample().sliders])
        placed = rig.rig(sliders, tensor(weights))
        assert np.abs(placed[:68].numpy() - expected[points]).max() < 1e-5 * np.ptp(own.rig.points[:, 1])
        camera = camera_of(turned(20, 10, -8), expected, int(SIZE))
        marks, _ = rig.landmarks(placed, torch_camera(camera))
        screen = camera.project(expected[points])
        np.testing.assert_allclose(marks[INNER], (screen[:, :2] / screen[:, 3:])[INNER], atol=1e-8)


def test_learned_networks_of_sliders_move_landmarks() -> None:
    rng = np.random.default_rng(0)
    network = SliderNetwork(
        sliders=("noseWidth", "jawWidth"),
        channels=tuple((joint, "ty") for joint in sample().skeleton.joints[3:12]),
        shapes=("jawOpen",),
        weights=(rng.normal(size=(10, 2)).astype(np.float32),),
        biases=(rng.normal(size=10).astype(np.float32),),
    )
    parts = replace(sample(), slider_network=network)
    own = Subject.of(parts)
    values = {"noseWidth": 0.7, "jawWidth": -0.4}
    coefficients, driven = slide(parts.sliders, own.rig.joints, values, network)
    expected = own.rig.evaluate(driven, coefficients=coefficients)[landmark_points(parts)[0]]
    rig = LandmarkRig.from_subject(own)
    placed = rig.rig(tensor([values.get(slider.name, slider.default) for slider in parts.sliders]))[:68].numpy()
    assert np.abs(placed - expected).max() < 1e-5 * np.ptp(own.rig.points[:, 1])
    assert np.abs(placed - LandmarkRig.from_subject(subject()).rig()[:68].numpy()).max() > 0.1


def test_from_the_front_contour_landmarks_are_where_they_are_labelled() -> None:
    rig, rng = LandmarkRig.from_subject(subject()), np.random.default_rng(1)
    labelled = landmark_points(sample())[0][CONTOUR]
    for _ in range(3):
        values = random_sliders(sample(), rng)
        points, camera = seen(values, turned(0))
        marks, outward = found(rig, values, torch_camera(camera))
        screen = camera.project(points[labelled])
        off = marks[CONTOUR] - screen[:, :2] / screen[:, 3:]
        assert np.abs((off * outward).sum(axis=1)).max() < 0.3
        assert np.linalg.norm(off, axis=1).max() < 2.0


@pytest.mark.parametrize("yaw", [-25.0, -12.0, 12.0, 25.0])
def test_on_turned_heads_the_contour_is_the_outline_of_the_mesh(yaw: float) -> None:
    """As a cut through the whole mesh finds it: all but one nearer than 0.8 pixels, where labelled points are off."""
    own, rng = whole(), np.random.default_rng(2)
    rig, marked, labelled = (
        LandmarkRig.from_subject(own),
        FaceLandmarks.of(own.parts),
        landmark_points(own.parts)[0][CONTOUR],
    )
    largest = 0.0
    for pitch in (-8.0, 8.0):
        values = random_sliders(own.parts, rng)
        points, camera = seen(values, turned(yaw, pitch, 5.0), own)
        marks, outward = found(rig, values, torch_camera(camera), own)
        outline = marked.project(points, camera)
        off = np.abs(((marks - outline)[CONTOUR] * outward).sum(axis=1))
        near = np.sort(off)[:-1]
        assert near.max() < 0.8
        assert near.mean() < 0.1
        screen = camera.project(points[labelled])
        fixed = screen[:, :2] / screen[:, 3:] - outline[CONTOUR]
        largest = max(largest, float(np.abs((fixed * outward).sum(axis=1)).max()))
    assert largest > (2.0 if abs(yaw) > 20 else 0.2)


@pytest.mark.parametrize("yaw", [-60.0, -35.0, 35.0, 60.0])
def test_sliding_never_leads_inwards(yaw: float) -> None:
    rig, labelled = LandmarkRig.from_subject(subject()), landmark_points(sample())[0][CONTOUR]
    points, camera = seen({}, turned(yaw, 5.0))
    marks, outward = found(rig, {}, torch_camera(camera))
    screen = camera.project(points[labelled])
    reach = ((marks[CONTOUR] - screen[:, :2] / screen[:, 3:]) * outward).sum(axis=1)
    assert reach.min() >= -1e-9
    assert reach.max() > 3


def test_gradients_of_landmarks_are_those_of_finite_differences() -> None:
    rig = LandmarkRig.from_subject(subject())
    _, camera = seen({}, turned(18, 6))
    start = tensor([slider.default + 0.1 for slider in sample().sliders]).requires_grad_()

    def marks(own: torch.Tensor) -> torch.Tensor:
        return rig.landmarks(rig.rig(own), torch_camera(camera))[0]

    pull = tensor(np.random.default_rng(0).normal(size=(68, 2)))
    (marks(start) * pull).sum().backward()
    step = tensor(np.random.default_rng(1).normal(size=len(start)))
    with torch.no_grad():
        ahead, behind = ((marks(start + sign * 1e-6 * step) * pull).sum() for sign in (1, -1))
    assert float(start.grad @ step) == pytest.approx(float(ahead - behind) / 2e-6, rel=1e-5)


# Stage one


@pytest.mark.parametrize("seed", [0, 1])
def test_exact_landmarks_are_met(seed: int) -> None:
    truth, fit = known(subject(), seed)
    start = fit.start()
    solved = fit.solve(start)
    assert fit.errors(start).mean() > 1.0
    assert fit.errors(solved).mean() < 0.2
    assert (np.linalg.norm(fit.landmarks(solved) - fit.landmarks(truth), axis=2)[:, INNER] < 1.0).all()
    head = fit.subject.rig
    faces = [
        head.evaluate(driven, coefficients=coefficients)
        for coefficients, driven in (
            slide(sample().sliders, head.joints, dict(zip([s.name for s in sample().sliders], values, strict=True)))
            for values in (fit.subject.slider_values(one.shares) for one in (start, truth, solved))
        )
    ]
    moved, left = (np.linalg.norm(face - faces[1], axis=1)[landmark_points(sample())[0]].mean() for face in faces[::2])
    assert left < 0.5 * moved


@pytest.mark.parametrize(("up", "unit"), [("Z", 0.01), ("Y", 1.0), ("Z", 0.001)])
def test_axes_and_units_make_no_difference(up: str, unit: float) -> None:
    matrix = np.diag([0.01 / unit] * 3 + [1.0])
    if up == "Z":
        matrix = matrix @ np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    parts = sample()
    meshes = tuple(replace(mesh, transform=matrix @ mesh.transform) for mesh in parts.meshes)
    skeleton = replace(parts.skeleton, transform=matrix @ parts.skeleton.transform)
    moved = replace(parts, meshes=meshes, skeleton=skeleton, up_axis=up, meters_per_unit=unit)  # type: ignore[arg-type]
    _, fit = known(subject(), 3)
    other = problem(Subject.of(moved), fit.targets)
    assert [row.tolist() for row in other.rig.rows] == [row.tolist() for row in fit.rig.rows]
    start, start_there = fit.start(), other.start()
    np.testing.assert_allclose(other.landmarks(start_there), fit.landmarks(start), atol=1e-5)
    ends = [one.solve(begin, steps=4) for one, begin in ((fit, start), (other, start_there))]
    np.testing.assert_allclose(other.landmarks(ends[1]), fit.landmarks(ends[0]), atol=0.05)
    np.testing.assert_allclose(ends[1].shares, ends[0].shares, atol=0.02)


def test_several_photos_share_the_person() -> None:
    """Three views say more about sliders than one; expressions and cameras stay apart."""
    truth, fit = known(subject(), 5, views=3)
    solved = fit.solve(fit.start(), steps=12)
    alone = problem(subject(), fit.targets[:1])
    single = alone.solve(alone.start(), steps=12)
    assert solved.shares.shape == truth.shares.shape
    assert solved.expressions.shape == truth.expressions.shape
    assert (fit.errors(solved).mean(axis=1) < 0.3).all()
    acting = np.abs(truth.shares - fit.subject.default_shares) > 0.05
    errors = [np.abs(one.shares - truth.shares)[acting].mean() for one in (solved, single)]
    assert errors[0] < errors[1]
    assert np.abs(solved.poses[:, :3] - truth.poses[:, :3]).max() < 0.06


def test_sliders_without_effect_stay_at_their_defaults() -> None:
    idle = Slider(name="idle", default=0.3, channels=((EYE, "rx", 0.4),))
    own = Subject.of(replace(sample(), sliders=(*sample().sliders, idle)))
    _, fit = known(subject(), 1)
    solved = problem(own, fit.targets).solve(problem(own, fit.targets).start(), steps=6)
    values = dict(zip([own.parts.sliders[i].name for i in own.sliders], solved.shares, strict=True))
    assert values["idle"] == pytest.approx(0.3, abs=1e-6)
    assert np.ptp([abs(one - 0.5) for name, one in values.items() if name != "idle"]) > 0.1


def test_sliders_end_at_their_bounds_where_more_is_asked_for() -> None:
    """One slider, seen beyond its range: at its end, and the pose makes up for no more than it can."""
    wide = replace(next(slider for slider in sample().sliders if slider.name == "jawWidth"), minimum=-3.0, maximum=3.0)
    target = LandmarkRig.from_subject(Subject.of(replace(sample(), sliders=(wide,))))
    _, camera = seen({}, turned(5))
    marks, _ = target.landmarks(target.rig(tensor([2.0])), torch_camera(camera))
    narrow = replace(wide, minimum=-1.0, maximum=1.0)
    fit = problem(Subject.of(replace(sample(), sliders=(narrow,)), ()), [marks.numpy()])
    solved = fit.solve(fit.start())
    assert solved.shares.tolist() == [1.0]


@pytest.mark.parametrize("default", [0.0, 1.0])
def test_sliders_come_off_a_bound_that_is_their_default(default: float) -> None:
    """Half of what a slider can do, from its end: as exactly as from its middle."""
    wide = next(slider for slider in sample().sliders if slider.name == "jawWidth")
    (joint, channel, gain), *rest = wide.channels
    one_sided = replace(wide, minimum=0.0, default=default, channels=((joint, channel, gain), *rest))
    own = Subject.of(replace(sample(), sliders=(one_sided,)), ())
    truth, fit = known(own, 0)
    truth = replace(truth, shares=np.array([0.4]))
    fit = problem(own, list(fit.landmarks(truth)))
    solved = fit.solve(fit.start())
    assert solved.shares == pytest.approx([0.4], abs=0.01)


def test_one_wrong_landmark_hardly_matters() -> None:
    _, fit = known(subject(), 2, priors=Priors(landmark_sigma=0.01))
    solved = fit.solve(fit.start(), steps=12)
    wrong = fit.targets[0].copy()
    wrong[30] += (25.0, -20.0)
    spoilt = problem(subject(), [wrong], Priors(landmark_sigma=0.01))
    other = spoilt.solve(spoilt.start(), steps=12)
    others = np.delete(np.arange(68), [27, 28, 29, 30, 31, 32, 33, 34, 35])
    off = np.linalg.norm(fit.landmarks(other) - fit.landmarks(solved), axis=2)[0, others]
    assert off.max() < 2.0
    assert off.mean() < 0.7


def test_landmarks_count_by_their_confidence() -> None:
    """Half of them far off: without a word that is averaged, and unseen where they are known to be bad."""
    _, fit = known(subject(), 2, priors=Priors(landmark_sigma=0.01))
    solved = fit.solve(fit.start(), steps=12)
    wrong, trust = fit.targets[0].copy(), np.ones(68)
    bad = np.arange(17, 68, 2)
    wrong[bad] += np.random.default_rng(0).normal(scale=6.0, size=(len(bad), 2))
    trust[bad] = 1e-4
    off = []
    for confidences in (None, [trust]):
        priors = Priors(landmark_sigma=0.01)
        spoilt = LandmarkFit(subject(), [wrong], [space_of(subject())], priors, confidences=confidences)
        other = spoilt.solve(spoilt.start(), steps=12)
        off.append(np.linalg.norm(fit.landmarks(other) - fit.landmarks(solved), axis=2)[0, INNER].mean())
    assert off[1] < 0.5
    assert off[1] < 0.25 * off[0]


def test_the_same_twice() -> None:
    _, fit = known(subject(), 0)
    ends = [fit.solve(fit.start(), steps=3) for _ in range(2)]
    assert (ends[0].vector() == ends[1].vector()).all()


# What may move


def test_sliders_of_expressions_are_held() -> None:
    own = subject()
    held = [one.name for i, one in enumerate(sample().sliders) if i not in own.sliders]
    assert held == [slider.name for slider in sample().sliders if slider.shapes]
    assert {"smile", "viseme_PP", "lookLeft"} < {*held}
    assert len(own.expressions) == 52
    smiling = replace(sample(), sliders=tuple(replace(slider, value=slider.maximum / 2) for slider in sample().sliders))
    values = Subject.of(smiling).slider_values(np.zeros((2, len(own.sliders))))
    names = [slider.name for slider in sample().sliders]
    assert values.shape == (2, len(names))
    assert values[0, names.index("smile")] == 0.5
    assert values[0, names.index("noseWidth")] == -1.0


def test_expressions_are_those_that_are_named() -> None:
    own = Subject.of(sample(), ("jawOpen",))
    assert [own.rig.shapes[i] for i in own.expressions] == ["jawOpen"]
    assert [own.parts.sliders[i].name for i in own.sliders] == [
        slider.name for slider in sample().sliders if "jawOpen" not in dict(slider.shapes)
    ]
    weights = own.shape_weights(np.array([[0.4], [0.7]]))
    assert weights.sum(axis=1).tolist() == [0.4, 0.7]
    assert weights[1, own.rig.shapes.index("jawOpen")] == 0.7


def test_sliders_that_act_through_a_learned_network_alone_may_move() -> None:
    network = SliderNetwork(
        sliders=("deep",),
        channels=((sample().skeleton.joints[3], "ty"),),
        weights=(np.ones((1, 1), np.float32),),
        biases=(np.zeros(1, np.float32),),
    )
    own = Subject.of(replace(sample(), sliders=(Slider(name="deep"), Slider(name="none")), slider_network=network))
    assert [slider.name for slider in own.free_sliders] == ["deep"]


def learned_smile(weight: float) -> SliderNetwork:
    """The nose's width smiles, as far as the jaw's is wide too; the brows are taken and weighed with nothing."""
    return SliderNetwork(
        sliders=("noseWidth", "jawWidth", "browHeight"),
        channels=((EYE, "tx"),),
        shapes=("mouthSmileLeft",),
        activation="relu",
        weights=(np.float32([[1, 1, 0]]), np.float32([[0.1], [weight]])),
        biases=(np.float32([-1.5]), np.zeros(2, np.float32)),
    )


def test_sliders_that_smile_through_a_learned_network_are_no_persons() -> None:
    """As those that drive an expression themselves; nearly none is none."""
    names = [slider.name for slider in subject().free_sliders]

    def free(network: SliderNetwork, expressions: Sequence[str] | None = None) -> list[str]:
        own = Subject.of(replace(sample(), slider_network=network), expressions)
        return [slider.name for slider in own.free_sliders]

    assert {"noseWidth", "jawWidth", "browHeight"} < set(names)
    assert free(learned_smile(0.5)) == [name for name in names if name not in ("noseWidth", "jawWidth")]
    for nothing in (0.0, 1e-3):
        assert free(learned_smile(nothing)) == names
    assert free(learned_smile(0.5), ["jawOpen"]) == [
        slider.name for slider in Subject.of(sample(), ["jawOpen"]).free_sliders
    ]


def test_networks_of_other_faces_are_refused() -> None:
    with pytest.raises(InputError, match="slider network: no slider 'ear'"):
        Subject.of(replace(sample(), slider_network=replace(learned_smile(0.5), sliders=("ear", "jawWidth", "x"))))


def test_sliders_act_through_a_learned_network_that_weighs_them() -> None:
    idle = (Slider(name="noseWidth"), Slider(name="jawWidth"), Slider(name="browHeight"))
    own = Subject.of(replace(sample(), sliders=idle, slider_network=learned_smile(0.0)))
    assert [slider.name for slider in own.free_sliders] == ["noseWidth", "jawWidth"]


def test_bad_faces_are_refused() -> None:
    with pytest.raises(InputError, match="expression grin: no such shape, expected one of browDownLeft"):
        Subject.of(sample(), ("grin",))
    with pytest.raises(InputError, match="sliders: none that shape a person"):
        Subject.of(replace(sample(), sliders=sample().sliders[:4]))
    with pytest.raises(InputError, match="no scheme multipie68, expected its 68"):
        landmark_points(tiny_face())
    head = sample().meshes[0]
    few = replace(head.landmarks["multipie68"], indices=np.arange(60))
    with pytest.raises(InputError, match="Head -> landmarks multipie68: 60, expected 68 of its points"):
        LandmarkRig.from_subject(
            Subject.of(replace(sample(), meshes=(replace(head, landmarks={"multipie68": few}), *sample().meshes[1:])))
        )
