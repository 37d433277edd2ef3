"""Deformation transfer against the paper's system solved densely, its invariances, and a real head."""

from __future__ import annotations

import numpy as np
import pytest
from import_data import arrays
from solids import sheet_and_tetrahedron

from facepipe.core.errors import InputError
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.geometry.polygons import point_triangles
from facepipe.geometry.similarity import fit_similarity

SIZE = 5
SHEET = SIZE * SIZE  # points 0..24: a sheet; 25..28: a loose tetrahedron; 29: in no triangle
COUNT = SHEET + 5


def triangles() -> np.ndarray:
    return sheet_and_tetrahedron(SIZE)


def neutral(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rows, columns = np.divmod(np.arange(SHEET), SIZE)
    sheet = np.stack([columns, rows, 0.3 * np.sin(columns + rows)], axis=1)
    loose = np.eye(5, 3) + np.array([1.0, 2.0, -2.0])
    return np.concatenate([sheet, loose]) + 0.15 * rng.normal(size=(COUNT, 3))


def fixed() -> np.ndarray:
    """The lowest row of the sheet."""
    return np.arange(COUNT) < SIZE


def moved(points: np.ndarray, seed: int, still: np.ndarray) -> np.ndarray:
    deformed = points + 0.4 * np.random.default_rng(seed).normal(size=points.shape)
    deformed[still] = points[still]
    return deformed


def turn(seed: int) -> np.ndarray:
    Q = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return Q * np.linalg.det(Q)


def spread(points: np.ndarray) -> float:
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def tetrahedra(points: np.ndarray) -> np.ndarray:
    """(t, 3, 3) columns v2 - v1, v3 - v1, v4 - v1 of the paper's section 3, eq. (1)."""
    frames = []
    for a, b, c in points[triangles()]:
        normal = np.cross(b - a, c - a)
        frames.append(np.stack([b - a, c - a, normal / np.sqrt(np.linalg.norm(normal))], axis=1))
    return np.array(frames)


def reference(points: np.ndarray, still: np.ndarray, neutrals: np.ndarray, deformed: np.ndarray) -> np.ndarray:
    """The paper's least squares with a fourth vertex for every triangle, all unknowns in one dense matrix."""
    gradients = np.zeros((len(triangles()), 3, 3))
    for a, b in zip(neutrals, deformed, strict=True):
        gradients += tetrahedra(b) @ np.linalg.inv(tetrahedra(a)) / len(neutrals)
    rows, right = [], []
    for number, (corners, V) in enumerate(zip(triangles(), tetrahedra(points), strict=True)):
        area = 0.5 * np.linalg.norm(np.cross(V[:, 0], V[:, 1]))
        select = np.zeros((3, COUNT + len(triangles())))
        select[[0, 1, 2], [corners[1], corners[2], COUNT + number]] = 1.0
        select[:, corners[0]] -= 1.0
        rows.append(np.sqrt(area) * np.linalg.inv(V).T @ select)
        right.append(np.sqrt(area) * gradients[number].T)
    A, b = np.concatenate(rows), np.concatenate(right)
    free = np.concatenate([~still, np.ones(len(triangles()), dtype=bool)])
    found = np.linalg.lstsq(A[:, free], b - A[:, :COUNT][:, still] @ points[still], rcond=None)[0]
    result = points.copy()
    result[~still] = found[: (~still).sum()]
    moves = [spread(points) / spread(n) * (d - n) for n, d in zip(neutrals, deformed, strict=True)]
    mean = np.mean(moves, axis=0)
    loose = slice(SHEET, SHEET + 4)
    result[loose] += (points[loose] + mean[loose]).mean(axis=0) - result[loose].mean(axis=0)
    result[-1] = points[-1] + mean[-1]
    return result


@pytest.mark.parametrize("seed", range(4))
def test_the_papers_dense_system_has_the_same_solution(seed: int) -> None:
    points = 1.7 * neutral(seed)
    neutrals = np.stack([neutral(10 * seed + k) for k in (1, 2, 3)])
    deformed = np.stack([moved(each, 50 + k, fixed()) for k, each in enumerate(neutrals)])
    found = Transfer(points, triangles(), fixed()).solve(neutrals, deformed)
    np.testing.assert_allclose(found, reference(points, fixed(), neutrals, deformed), atol=1e-9)


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("anchored", [False, True])
def test_its_own_deformation_comes_back(anchored: bool, flat: bool) -> None:
    points, still = neutral(0), fixed() & anchored
    if flat:  # every triangle of one point is a line
        points[[0, 1, 5, 6]] = points[0] + np.arange(4)[:, None] * [1.0, 0.0, 0.0]
    deformed = moved(points, 1, still)
    found = Transfer(points, triangles(), still).solve(points[None], deformed[None])
    np.testing.assert_allclose(found, deformed, atol=1e-9)


def test_several_deformations_of_one_neutral_are_averaged() -> None:
    points = neutral(0)
    deformed = np.stack([moved(points, k, fixed()) for k in range(3)])
    transfer, neutrals = Transfer(points, triangles(), fixed()), np.stack([points] * 3)
    np.testing.assert_allclose(transfer.solve(neutrals, deformed), deformed.mean(axis=0), atol=1e-9)


@pytest.mark.parametrize("anchored", [False, True])
def test_moving_or_scaling_a_neutral(anchored: bool) -> None:
    still = fixed() & anchored
    points, source = neutral(0), neutral(1)
    deformed = moved(source, 2, still)
    found = Transfer(points, triangles(), still).solve(source[None], deformed[None])
    shift = np.array([3.0, -20.0, 7.0])
    here = Transfer(2.5 * points + shift, triangles(), still).solve(source[None], deformed[None])
    np.testing.assert_allclose(here, 2.5 * found + shift, atol=1e-9)
    there = Transfer(points, triangles(), still).solve(0.1 * source[None] + shift, 0.1 * deformed[None] + shift)
    np.testing.assert_allclose(there, found, atol=1e-9)


@pytest.mark.parametrize("anchored", [False, True])
def test_the_result_turns_when_all_faces_turn(anchored: bool) -> None:
    still, Q = fixed() & anchored, turn(3)
    points, source = neutral(0), neutral(1)
    deformed = moved(source, 2, still)
    found = Transfer(points, triangles(), still).solve(source[None], deformed[None])
    turned = Transfer(points @ Q.T, triangles(), still).solve(source[None] @ Q.T, deformed[None] @ Q.T)
    np.testing.assert_allclose(turned, found @ Q.T, atol=1e-9)
    alone = Transfer(points @ Q.T, triangles(), still).solve(source[None], deformed[None])
    assert np.abs(alone - found @ Q.T).max() > 0.1  # the axes are shared


def test_an_in_plane_linear_map_comes_over_as_that_map_on_flat_sheets() -> None:
    """Flat sheets in one plane: the gradient of an affine map in that plane has nothing to do with their triangles."""
    points, source = neutral(0)[:SHEET], neutral(1)[:SHEET]
    points[:, 2] = source[:, 2] = 0.0
    A = np.array([[1.2, 0.3, 0.0], [-0.1, 0.8, 0.0], [0.5, 0.2, 1.0]])
    sheet = triangles()[: 2 * (SIZE - 1) ** 2]
    found = Transfer(points, sheet, np.zeros(SHEET, dtype=bool)).solve(source[None], source[None] @ A.T)
    edges = np.diff(points, axis=0) @ A.T
    np.testing.assert_allclose(np.diff(found, axis=0), edges, atol=1e-9)


def test_a_rotation_with_a_uniform_scale_comes_over_as_that() -> None:
    points, source, Q = neutral(0), neutral(1), turn(5)
    found = Transfer(points, triangles(), np.zeros(COUNT, dtype=bool)).solve(source[None], 1.3 * source[None] @ Q.T)
    for piece in (slice(0, SHEET), slice(SHEET, SHEET + 4)):
        moved_by = fit_similarity(points[piece], found[piece])
        np.testing.assert_allclose(moved_by.rotation, Q, atol=1e-9)
        assert moved_by.scale == pytest.approx(1.3, rel=1e-9)
        np.testing.assert_allclose(moved_by.apply(points[piece]), found[piece], atol=1e-9)


def test_fixed_points_keep_their_bits_and_same_input_gives_the_same_bits() -> None:
    points, source = neutral(0), neutral(1)
    points[0] = (-0.0, 1e-300, 0.1)
    still = fixed() | (np.arange(COUNT) == COUNT - 1) | (np.arange(COUNT) == SHEET + 1)
    deformed = moved(source, 2, np.zeros(COUNT, dtype=bool))  # the source moves them all
    given = [array.copy() for array in (points, source, deformed)]
    found = [Transfer(points, triangles(), still).solve(source[None], deformed[None]) for _ in range(2)]
    assert found[0][still].tobytes() == points[still].tobytes()
    assert found[0].tobytes() == found[1].tobytes()
    assert all(np.array_equal(a, b) for a, b in zip(given, (points, source, deformed), strict=True))
    assert (np.abs(found[0] - points).max(axis=1)[~still] > 0).all()


def test_nothing_moves_where_no_source_moves() -> None:
    points, source = neutral(0), neutral(1)
    still = Transfer(points, triangles(), fixed()).solve(source[None], source[None])
    assert np.array_equal(still, points)
    everything = Transfer(points, triangles(), np.ones(COUNT, dtype=bool))
    assert np.array_equal(everything.solve(source[None], 2 * source[None]), points)


def test_a_loose_piece_moves_by_the_sources_mean_displacement_at_this_faces_size() -> None:
    points, source = 3.0 * neutral(0), neutral(1)
    deformed = moved(source, 2, fixed())
    found = Transfer(points, triangles(), fixed()).solve(source[None], deformed[None])
    ratio = spread(points) / spread(source)
    for piece in (slice(SHEET, SHEET + 4), slice(COUNT - 1, COUNT)):
        expected = ratio * (deformed - source)[piece].mean(axis=0)
        np.testing.assert_allclose((found - points)[piece].mean(axis=0), expected, atol=1e-9)


def test_points_with_flat_triangles_alone_move_as_in_the_sources() -> None:
    points, source = neutral(0), neutral(1)
    points[SHEET : SHEET + 4] = points[SHEET] + np.arange(4)[:, None] * [0.5, 0.25, 0.0]
    deformed = moved(source, 2, fixed())
    found = Transfer(points, triangles(), fixed()).solve(source[None], deformed[None])
    ratio = spread(points) / spread(source)
    np.testing.assert_allclose((found - points)[SHEET:], ratio * (deformed - source)[SHEET:], atol=1e-9)


def test_a_triangle_flat_in_one_source_is_known_by_the_other() -> None:
    points, whole = neutral(0), neutral(1)
    whole_deformed = moved(whole, 2, fixed())
    flat = neutral(4)
    flat[SHEET : SHEET + 4] = flat[SHEET]
    neutrals, deformed = np.stack([whole, flat]), np.stack([whole_deformed, moved(flat, 3, fixed())])
    transfer = Transfer(points, triangles(), fixed())
    found, alone = transfer.solve(neutrals, deformed), transfer.solve(whole[None], whole_deformed[None])
    loose = slice(SHEET, SHEET + 4)
    shape, expected = (x[loose] - x[loose].mean(axis=0) for x in (found, alone))
    np.testing.assert_allclose(shape, expected, atol=1e-9)
    only_flat = transfer.solve(neutrals[1:], deformed[1:])  # no gradient at all: the displacements
    ratio = spread(points) / spread(flat)
    np.testing.assert_allclose((only_flat - points)[loose], ratio * (deformed[1] - flat)[loose], atol=1e-9)


def test_a_face_without_triangles_takes_the_displacements() -> None:
    points = neutral(0)
    deformed = moved(points, 1, fixed())
    found = Transfer(points, np.zeros((0, 3), dtype=int), fixed()).solve(points[None], deformed[None])
    np.testing.assert_allclose(found, deformed, atol=1e-12)


NAN = np.where(np.arange(COUNT * 3).reshape(COUNT, 3) == 7, np.nan, 1.0)


@pytest.mark.parametrize("which", ["points", "neutrals", "deformed"])
def test_numbers_that_are_not_finite_are_refused(which: str) -> None:
    given = {"points": neutral(0), "neutrals": neutral(0)[None], "deformed": neutral(1)[None]}
    given[which] = given[which] + NAN
    with pytest.raises(InputError, match=rf"^{which}: "):
        Transfer(given["points"], triangles(), fixed()).solve(given["neutrals"], given["deformed"])


def ict_case(shape: str, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Generic neutral, another identity, the model's own offsets of the shape (the same for all), triangles."""
    data = arrays("ict_facekit/ict_facekit.npz")
    offsets = data["expression_deltas"][data["expression_names"].tolist().index(shape)].astype(np.float64)
    offsets[np.linalg.norm(offsets, axis=1) <= 2e-4] = 0.0  # rounding of the model's files
    generic = data["neutral"].astype(np.float64)
    draws = np.random.Generator(np.random.PCG64(seed)).standard_normal(len(data["identity_deltas"]))
    person = generic + np.tensordot(draws, data["identity_deltas"].astype(np.float64), 1)
    return generic, person, offsets, point_triangles(data["face_vertex_counts"], data["face_vertex_indices"])


@pytest.mark.parametrize(
    ("shape", "seed", "rms", "largest"), [("jawOpen", 1, 0.6, 5.0), ("mouthSmile_L", 1, 0.15, 1.6)]
)
def test_a_real_heads_shape_is_close_to_the_models_own(shape: str, seed: int, rms: float, largest: float) -> None:
    """Errors in mm of points that move by up to 42 (jawOpen) and 16 mm (mouthSmile)."""
    generic, person, offsets, faces = ict_case(shape, seed)
    still = ~offsets.any(axis=1)
    found = Transfer(person, faces, still).solve(generic[None], (generic + offsets)[None])
    errors = 10.0 * np.linalg.norm(found - person - offsets, axis=1)
    print(f"{shape}: RMS {np.sqrt((errors**2).mean()):.3f} mm, max {errors.max():.3f} mm")
    assert np.sqrt((errors**2).mean()) < rms
    assert errors.max() < largest
    assert found[still].tobytes() == person[still].tobytes()


def test_a_real_heads_shape_comes_back() -> None:
    generic, _, offsets, faces = ict_case("jawOpen", 1)
    found = Transfer(generic, faces, ~offsets.any(axis=1)).solve(generic[None], (generic + offsets)[None])
    np.testing.assert_allclose(found, generic + offsets, atol=1e-9)
