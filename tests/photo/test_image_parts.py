"""Camera, light, normals and textures of the differentiable face, against pictures' own and independent formulas."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_head import make
from with_torch import tensor, torch

from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.photo.renderer.camera import Camera, rotation_matrices
from facepipe.photo.renderer.face_model import PointNormals, bilinear
from facepipe.photo.renderer.light import ambient, basis, distant, shade
from facepipe.pictures import scene
from facepipe.pictures.camera import portrait

pytestmark = pytest.mark.needs_torch


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 0.0099, 0.0101, 1.0, 3.0, 7.0])
def test_rotations_of_every_angle(size: float) -> None:
    axis = np.array([0.6, -0.48, 0.64])
    vector = tensor(size * axis, requires_grad=True)
    expected = Rotation.from_rotvec(size * axis).as_matrix()
    np.testing.assert_allclose(rotation_matrices(vector).detach().numpy(), expected, atol=1e-12)
    assert torch.autograd.gradcheck(rotation_matrices, (vector,))


@pytest.mark.parametrize("view", ["front", "side", (0.4, -0.3)])
def test_cameras_see_as_those_of_pictures(view: str | tuple[float, float]) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)) * (8, 12, 9) + (3, 150, -20)
    own = portrait(points, view, 320, 200)
    found = Camera.at(own.axes, own.eye, own.focal, own.center, dtype=torch.float64).project(tensor(points)).numpy()
    expected = own.project(points)
    np.testing.assert_allclose(found[:, :2], expected[:, :2] / expected[:, 3:], atol=1e-9)
    np.testing.assert_allclose(found[:, 2], expected[:, 3], atol=1e-10)


def test_projection_has_gradients_in_pose_and_lens_for_a_batch() -> None:
    points = tensor(np.random.default_rng(0).normal(size=(2, 5, 3)), requires_grad=True)
    rotation, translation = tensor([[0, 0, 0], [0.1, -0.2, 0.3]]), tensor([[0, 0, -9], [0.2, 0.1, -8]])
    focal, center = tensor([100, 120]), tensor([[32, 30], [31, 33]])
    free = [points, *(one.requires_grad_() for one in (rotation, translation, focal, center))]

    def project(*values: torch.Tensor) -> torch.Tensor:
        return Camera(rotation=values[1], translation=values[2], focal=values[3], center=values[4]).project(values[0])

    assert project(*free).shape == (2, 5, 3)
    assert torch.autograd.gradcheck(project, free)


def test_points_beside_and_behind_the_camera_stay_finite() -> None:
    camera = Camera.at(np.eye(3), np.zeros(3), 100.0, (8, 8), dtype=torch.float64)
    points = tensor([[1, 2, 0], [1, 2, 5], [1, 2, -1e-9], [1, 2, -4]], requires_grad=True)
    screen = camera.project(points)
    screen.sum().backward()
    assert torch.isfinite(screen).all()
    assert torch.isfinite(points.grad).all()
    assert screen[:, 2].tolist() == [0, -5, 1e-9, 4]
    assert screen[3, :2].tolist() == [8 + 25, 8 - 50]


def sphere() -> tuple[np.ndarray, np.ndarray]:
    """Directions (m, 3) and weights (m,) that integrate over the unit sphere."""
    z, of_z = np.polynomial.legendre.leggauss(24)
    turn = (np.arange(48) + 0.5) * (2 * np.pi / 48)
    radius = np.sqrt(1 - z**2)[:, None]
    directions = np.stack(
        [radius * np.cos(turn), radius * np.sin(turn), np.broadcast_to(z[:, None], (24, 48))], axis=-1
    )
    return directions.reshape(-1, 3), np.repeat(of_z * 2 * np.pi / 48, 48)


def test_the_nine_harmonics_are_orthonormal() -> None:
    directions, weights = sphere()
    values = basis(tensor(directions)).numpy()
    np.testing.assert_allclose(values.T @ (weights[:, None] * values), np.eye(9), atol=1e-12)


def test_a_distant_light_falls_off_with_the_cosine() -> None:
    """Of all quadratic functions of the normal it is the nearest one to max(cosine, 0)."""
    directions, weights = sphere()
    towards = np.array([0.48, 0.6, 0.64])
    cosine = np.maximum(directions @ towards, 0)
    found = basis(tensor(directions)).numpy() @ distant(tensor(towards), tensor([1, 1, 1])).numpy()[:, 0]
    residual = cosine - found
    assert np.abs(basis(tensor(directions)).numpy().T @ (weights * residual)).max() < 2e-3, "the best fit"
    assert np.sqrt((weights * residual**2).sum() / (weights * cosine**2).sum()) < 0.1


def test_shading_is_linear_in_the_light_and_never_negative() -> None:
    normals = tensor(sphere()[0])
    grey = shade(normals, ambient(tensor([0.2, 0.5, 0.8])))
    np.testing.assert_allclose(grey.numpy(), np.broadcast_to((0.2, 0.5, 0.8), grey.shape), atol=1e-12)
    light = distant(tensor([0, 0, 1]), tensor([1, 0.5, 0.25]))
    assert shade(normals, light).min() == 0
    both = shade(normals, ambient(tensor([1, 1, 1])) + light)
    np.testing.assert_allclose(both.numpy(), (1 + basis(normals) @ light).numpy(), atol=1e-12)


def test_normals_as_those_of_meshes() -> None:
    mesh = make(0).meshes[0]
    triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    points = np.concatenate([mesh.points, [[0, 0, 0]]])  # the last point has no triangle
    found = PointNormals(triangles, len(points), dtype=torch.float64)(tensor(points)).numpy()
    np.testing.assert_allclose(found, point_normals(points, triangles), atol=1e-12)


def test_normals_have_gradients_and_flat_triangles_none() -> None:
    points = tensor(np.random.default_rng(0).normal(size=(6, 3)), requires_grad=True)
    normals = PointNormals(np.array([[0, 1, 2], [2, 1, 3]]), 6, dtype=torch.float64)
    assert torch.autograd.gradcheck(normals, (points,))
    flat = torch.zeros((6, 3), dtype=torch.float64, requires_grad=True)
    found = normals(flat)
    found.sum().backward()
    assert found.tolist() == [[0, 1, 0]] * 6
    assert (flat.grad == 0).all()


@pytest.mark.parametrize("wrap_s", ["repeat", "mirror", "clamp"])
@pytest.mark.parametrize("wrap_t", ["repeat", "mirror", "clamp"])
def test_textures_as_those_of_pictures(wrap_s: str, wrap_t: str) -> None:
    rng = np.random.default_rng(0)
    texels, uv = rng.random((5, 7, 3)).astype(np.float32), rng.uniform(-1.5, 2.5, (200, 2)).astype(np.float32)
    found = bilinear(torch.tensor(texels), torch.tensor(uv), wrap_s, wrap_t).numpy()
    np.testing.assert_allclose(found, scene.bilinear(texels, uv, wrap_s, wrap_t), atol=2e-5)


def test_textures_have_gradients_in_texels_and_places() -> None:
    rng = np.random.default_rng(0)
    texels, uv = tensor(rng.random((3, 4, 2)), requires_grad=True), tensor(rng.random((6, 2)), requires_grad=True)
    assert torch.autograd.gradcheck(bilinear, (texels, uv))
