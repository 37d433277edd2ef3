"""Registration of a deformable face with a scan."""

from __future__ import annotations

import numpy as np
import pytest
import scan_actors
from scan_actors import Actor, database_faces, ict
from scan_simulator import SimulatedScan, simulate, visible_triangles
from scipy.spatial.transform import Rotation

from facepipe.core.errors import FitError
from facepipe.geometry.identity_model import IdentityModel
from facepipe.geometry.registration import (
    Anchors,
    DeformableSurface,
    Registered,
    RegistrationOptions,
    ScanTarget,
    Shown,
    register,
)
from facepipe.geometry.registration.step import Membrane, Pull, solve_step
from facepipe.geometry.registration.surface import Matches
from facepipe.geometry.similarity import Similarity, fit_similarity

_HEAD = 14062  # points of the ICT head: face, neck, sockets


def _grid(count: int) -> tuple[np.ndarray, np.ndarray]:
    """A bumpy dome over 100 x 100 mm, and its triangles."""
    x, y = np.meshgrid(*[np.linspace(-50.0, 50.0, count)] * 2, indexing="ij")
    z = 40.0 * np.exp(-(x**2 + 1.4 * y**2) / 1500.0) + 6.0 * np.exp(-((x - 18) ** 2 + (y + 10) ** 2) / 60.0)
    number = np.arange(count * count).reshape(count, count)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return np.stack([x, y, z], axis=-1).reshape(-1, 3), triangles


def _modes(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T / 50.0
    zero = np.zeros_like(x)
    waves = [(zero, zero, np.exp(-4 * ((x - 0.4) ** 2 + y**2))), (zero, zero, np.exp(-4 * ((x + 0.3) ** 2 + y**2)))]
    return np.stack([np.stack(wave, axis=1) for wave in (*waves, (0.5 * z, zero, zero), (zero, y * z, zero))])


def _surface(count: int = 25, **changes: object) -> DeformableSurface:
    points, triangles = _grid(count)
    modes = _modes(points)
    given = {
        "base": points,
        "modes": modes,
        "expected": np.zeros(len(modes)),
        "precision": np.full(len(modes), 0.1),
        "triangles": triangles,
        "seen": np.arange(len(points)),
        "held": np.zeros(len(points)),
    }
    return DeformableSurface(**{**given, **changes})  # type: ignore[arg-type]


_UP = np.array([0.0, 0.0, 1.0])
_COEFFICIENTS = np.array([3.0, -2.0, 1.5, 1.0])
_POSE = Similarity(
    rotation=np.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, -0.6]]),
    translation=np.array([400.0, -30.0, 90.0]),
    scale=0.1,
)


def _scan(count: int = 61) -> tuple[np.ndarray, np.ndarray]:
    """The dome with coefficients, on a finer grid."""
    points, triangles = _grid(count)
    return points + np.tensordot(_COEFFICIENTS, _modes(points), 1), triangles


def _anchors() -> Anchors:
    """Every 37th point, where it truly is."""
    surface = _surface()
    chosen = np.arange(5, len(surface.base), 37)
    return Anchors.at_points(chosen, surface.points(_COEFFICIENTS)[chosen])


def _moved(anchors: Anchors, pose: Similarity) -> Anchors:
    return Anchors(corners=anchors.corners, shares=anchors.shares, targets=pose.apply(anchors.targets))


def _fitted(surface: DeformableSurface, pose: Similarity = _POSE, **options: float) -> Registered:
    points, triangles = _scan()
    anchors = _moved(_anchors(), pose)
    start = fit_similarity(anchors.targets, anchors.places(surface.base))
    return register(
        surface, ScanTarget.of_surface(pose.apply(points), triangles), anchors, start, RegistrationOptions(**options)
    )


def test_what_the_model_can_show_is_found() -> None:
    surface = _surface(held=np.full(625, 1e4))
    found = _fitted(surface)
    assert np.allclose(found.coefficients, _COEFFICIENTS, atol=0.1)
    assert np.abs(found.points - surface.points(_COEFFICIENTS)).mean() < 0.05
    assert np.abs(_fitted(_surface()).points - surface.points(_COEFFICIENTS)).mean() < 0.05
    assert found.place.scale == pytest.approx(1.0 / _POSE.scale, rel=2e-3)
    assert found.outliers == ()


def test_where_the_scan_lies_changes_nothing() -> None:
    at_home = Similarity(rotation=np.eye(3), translation=np.zeros(3))
    surface = _surface()
    assert np.abs(_fitted(surface).points - _fitted(surface, at_home).points).max() < 1e-6


def test_a_scan_of_known_size_is_not_scaled() -> None:
    pose = Similarity(rotation=_POSE.rotation, translation=_POSE.translation)
    surface = _surface()
    points, triangles = _scan()
    anchors = _moved(_anchors(), pose)
    start = fit_similarity(anchors.targets, anchors.places(surface.base), scale=False)
    target = ScanTarget.of_surface(pose.apply(points), triangles)
    found = register(surface, target, anchors, start, RegistrationOptions(scale=False))
    assert found.place.scale == 1.0
    assert np.abs(found.points - surface.points(_COEFFICIENTS)).mean() < 0.05


def test_what_the_model_lacks_is_left_to_the_residual() -> None:
    surface = _surface(modes=_modes(_grid(25)[0])[:1], expected=np.zeros(1), precision=np.ones(1))
    found = _fitted(surface)
    assert np.nanmean(found.distances) < 0.05
    assert np.linalg.norm(found.residual, axis=1).max() > 1.0


def test_an_anchor_on_the_wrong_place_is_reported() -> None:
    surface = _surface()
    points, triangles = _scan()
    anchors = _anchors()
    anchors.targets[4] += (25.0, 0.0, 0.0)
    start = Similarity(rotation=np.eye(3), translation=np.zeros(3))
    found = register(surface, ScanTarget.of_surface(points, triangles), anchors, start)
    assert found.outliers == (4,)
    assert np.abs(found.points - surface.points(_COEFFICIENTS)).mean() < 0.15


def test_points_where_the_scan_ends_find_no_place() -> None:
    surface = _surface()
    points, triangles = _scan()
    half = triangles[(points[triangles][:, :, 0] < 0.0).all(axis=1)]
    used, half = np.unique(half, return_inverse=True)
    target = ScanTarget.of_surface(points[used], half.reshape(-1, 3))
    start = Similarity(rotation=np.eye(3), translation=np.zeros(3))
    found = register(surface, target, _anchors(), start)
    truth = surface.points(_COEFFICIENTS)
    assert not found.matched[truth[:, 0] > 1.0].any()
    inner = (np.abs(truth[:, 1]) < 45.0) & (truth[:, 0] > -45.0) & (truth[:, 0] < -6.0)
    assert found.matched[inner].mean() > 0.95


def test_a_lip_never_takes_the_place_of_the_other() -> None:
    points, triangles = _grid(25)
    count = len(points)
    twin = np.concatenate([points, points + _UP * 1.5])  # two sheets: the scan shows the upper one
    both = np.concatenate([triangles, triangles + count])
    labels = np.repeat([-1, 1], count)
    changes = {"base": twin, "modes": np.zeros((0, 2 * count, 3)), "expected": np.zeros(0), "precision": np.zeros(0)}
    changes |= {"triangles": both, "seen": np.arange(2 * count), "held": np.full(2 * count, 1.0)}
    scan = ScanTarget.of_surface(points + _UP * 1.5, triangles)
    start = Similarity(rotation=np.eye(3), translation=np.zeros(3))
    anchors = Anchors.at_points(np.array([0, 24, 600]) + count, twin[np.array([0, 24, 600]) + count])
    labelled = register(_surface(**changes, labels=labels), scan, anchors, start)
    assert not labelled.matched[:count].any()
    assert labelled.matched[count:].mean() > 0.8
    assert register(_surface(**changes), scan, anchors, start).matched[:count].mean() > 0.5


def test_a_scan_of_something_else_is_refused() -> None:
    points, triangles = _scan()
    target = ScanTarget.of_surface(points + _UP * 500.0, triangles)
    surface = _surface()
    start = Similarity(rotation=np.eye(3), translation=np.zeros(3))
    with pytest.raises(FitError, match=r"scan: 0 points of the face find a place on it, expected 50 or more"):
        register(surface, target, _anchors(), start)
    with pytest.raises(FitError, match=r"expected 6 or more"):  # half of them
        register(_surface(seen=np.arange(12)), target, _anchors(), start)


def test_a_cloud_does_as_well_as_a_surface() -> None:
    points, triangles = _scan(121)
    surface = _surface()
    normals = ScanTarget.of_surface(points, triangles).normals
    start = Similarity(rotation=np.eye(3), translation=np.zeros(3))
    found = register(surface, ScanTarget.of_cloud(points, normals), _anchors(), start)
    assert np.abs(found.points - surface.points(_COEFFICIENTS)).mean() < 0.08
    assert np.nanmean(found.distances) < 0.05  # the cloud's points are 0.8 mm apart


def _random_pull(surface: DeformableSurface, rng: np.random.Generator, shown: int, *, scale: bool) -> Pull:
    count = len(surface.base)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    places = surface.base + rng.normal(size=(count, 3))
    anchors = Anchors(
        corners=rng.integers(0, count, (5, 3)), shares=np.full((5, 3), 1 / 3), targets=rng.normal(size=(5, 3)) * 30
    )
    return Pull(
        seen=surface.seen,
        matches=Matches(places=places, normals=normals, distances=np.zeros(count), kept=np.ones(count, bool)),
        weights=rng.uniform(0, 3, count),
        anchors=anchors,
        anchor_weights=rng.uniform(1, 5, 5),
        spread=anchors.matrix(count),
        scale=scale,
        shown=Shown(
            modes=rng.normal(size=(shown, count, 3)),
            expected=rng.normal(size=shown),
            precision=rng.uniform(1, 3, shown),
        ),
    )


def _dense_rows(surface: DeformableSurface, pull: Pull, before: int, after: int) -> tuple[np.ndarray, ...]:
    """Rows, weights and right sides of one scan; columns: modes, `before`, own weights, place, `after`, residual."""
    count, normals, places, anchors = len(surface.base), pull.matches.normals, pull.matches.places, pull.anchors
    centre, spread = places.mean(axis=0), pull.anchors.matrix(len(surface.base)).toarray()

    def moves(points: np.ndarray) -> np.ndarray:
        turns = [np.cross(axis, points - centre) for axis in np.eye(3)]
        grown = [points - centre] if pull.scale else []
        return -np.stack([*turns, *(np.broadcast_to(axis, points.shape) for axis in np.eye(3)), *grown], -1)

    def whole(shared: np.ndarray, own: np.ndarray, place: np.ndarray, rest: np.ndarray) -> np.ndarray:
        zeros = np.zeros((len(shared), before)), np.zeros((len(shared), after))
        return np.concatenate([shared, zeros[0], own, place, zeros[1], rest], axis=1)

    def across(values: np.ndarray) -> np.ndarray:
        return np.einsum("kni,ni->nk", values, normals)

    def anchored(values: np.ndarray) -> np.ndarray:
        return np.einsum("ln,kni->lik", spread, values).reshape(15, -1)

    planes = whole(
        across(surface.modes),
        across(pull.shown.modes),
        np.einsum("niq,ni->nq", moves(places), normals),
        (np.eye(count)[:, :, None] * normals[:, None, :]).reshape(count, -1),
    )
    fixed = whole(
        anchored(surface.modes),
        anchored(pull.shown.modes),
        moves(anchors.targets).reshape(15, -1),
        np.kron(spread, np.eye(3)),
    )
    right = np.einsum("ni,ni->n", places - surface.base, normals), (anchors.targets - spread @ surface.base).ravel()
    weights = pull.weights, np.repeat(pull.anchor_weights, 3)
    return np.concatenate([planes, fixed]), np.concatenate(weights), np.concatenate(right)


def test_a_step_is_the_least_squares_solution() -> None:
    """Against all unknowns of two scans in one dense system."""
    rng = np.random.default_rng(4)
    surface = _surface(7, precision=np.full(4, 2.0), expected=rng.normal(size=4))
    first, second = _random_pull(surface, rng, 0, scale=True), _random_pull(surface, rng, 3, scale=False)
    membrane = Membrane.on_surface(surface, np.ones(len(surface.base)), 1.0, [first.spread, second.spread])
    step = solve_step(surface, membrane, [first, second])

    rows = _dense_rows(surface, first, 0, 9), _dense_rows(surface, second, 7, 0)
    planes, weights, right = (np.concatenate([one[i] for one in rows]) for i in range(3))
    matrix, right = planes.T @ (weights[:, None] * planes), planes.T @ (weights * right)
    matrix[:4, :4] += np.diag(surface.precision)
    right[:4] += surface.precision * surface.expected
    matrix[11:14, 11:14] += np.diag(second.shown.precision)
    right[11:14] += second.shown.precision * second.shown.expected
    matrix[20:, 20:] += np.kron(membrane.stiffness.toarray(), np.eye(3))
    whole = np.linalg.solve(matrix, right)
    assert np.allclose(step.coefficients, whole[:4], atol=1e-5)
    assert np.allclose(step.weights[1], whole[11:14], atol=1e-5)
    assert np.allclose(step.residual.ravel(), whole[20:], atol=1e-4)
    assert np.allclose(step.moves[0].scale, np.exp(whole[10]), rtol=1e-5)
    turned = Rotation.from_matrix(step.moves[1].rotation).as_rotvec()
    assert np.allclose(turned, whole[14:17], atol=1e-5)
    assert step.moves[1].scale == 1.0


def _registered(actor: Actor, scan: SimulatedScan, residual: bool = True) -> np.ndarray:
    """True errors (n,) of the head in millimetres, in the actor's own size and place."""
    model = IdentityModel.from_faces(database_faces()[:, :_HEAD])
    triangles = ict().triangles[(ict().triangles < _HEAD).all(axis=1)]
    seen = np.unique(visible_triangles(ict().neutral))
    modes = model.components * model.deviations[:, None, None]
    surface = DeformableSurface(
        base=model.mean,
        modes=modes,
        expected=np.zeros(len(modes)),
        precision=np.full(len(modes), 0.03),
        triangles=triangles,
        seen=seen[seen < _HEAD],
        held=np.full(_HEAD, 0.0 if residual else 1e6),
    )
    landmarks = ict().landmarks
    start = fit_similarity(scan.landmarks, model.mean[landmarks])
    target = ScanTarget.of_surface(scan.points, scan.triangles)
    found = register(surface, target, Anchors.at_points(landmarks, scan.landmarks), start)
    at_home = scan.pose.undo(found.place.undo(found.points))
    return np.asarray(np.linalg.norm(at_home - actor.neutral[:_HEAD], axis=1))


@pytest.mark.slow
def test_neutrals_of_people_that_the_database_cannot_show() -> None:
    """True errors of three identities in millimetres, over the face and its narrow part."""
    rows = []
    for seed in range(101, 104):
        actor = Actor(seed)
        scan = simulate(actor.neutral, seed)
        face, without = _registered(actor, scan), _registered(actor, scan, residual=False)
        full, narrow = face[: scan_actors.ict().full_face], face[: scan_actors.ict().narrow_face]
        rows.append((full.mean(), np.percentile(full, 95), narrow.mean(), np.percentile(narrow, 95)))
        model_alone = without[: scan_actors.ict().full_face].mean()
        print(seed, *(f"{value:.3f}" for value in rows[-1]), f"model alone {model_alone:.3f}")
        assert rows[-1][0] < model_alone
    mean, worst = np.mean(rows, axis=0), np.max(rows, axis=0)
    print("mean", mean.round(3), "worst", worst.round(3))
    assert mean[0] <= 0.6
    assert mean[1] <= 1.5
    assert mean[2] <= 0.5
    assert mean[3] <= 1.2
    assert worst[0] <= 0.8
    assert worst[1] <= 2.2
